"""The objective, brought up to date frame by frame, is that of the map of just these frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.select.objective import Objective
from tests.apps.select.made_up import observed_of, renderability_of, targets_of

SEEDS = st.integers(0, 500)


@pytest.mark.parametrize("uses_kernel", [True, False])
@given(seed=SEEDS)
def test_after_each_frame_it_is_the_renderability_on_the_map_of_these_frames(uses_kernel, seed):
    observed = observed_of(seed)
    targets = targets_of(observed, seed)
    objective = Objective(observed, targets, uses_kernel=uses_kernel)
    order = np.random.default_rng(seed).permutation(len(observed))
    for count, frame in enumerate(order.tolist(), start=1):
        gain, before = float(objective.gains(np.array([frame]))[0]), objective.value
        objective.add(frame)
        assert objective.value - before == pytest.approx(gain, abs=1e-6)
        if count in (1, 3, len(order)):
            oracle = renderability_of(observed, targets, order[:count].tolist())
            np.testing.assert_allclose(objective.per_target, oracle, atol=1e-5)


@given(seed=SEEDS)
def test_machine_code_gives_what_the_formula_gives(seed):
    observed = observed_of(seed)
    targets = targets_of(observed, seed)
    every = np.arange(len(observed))
    both = [Objective(observed, targets, uses_kernel=way) for way in (True, False)]
    for frame in (0, 4, 2):
        np.testing.assert_allclose(*(one.gains(every) for one in both), atol=1e-5)
        for one in both:
            one.add(frame)
