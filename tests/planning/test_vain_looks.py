"""Surfaces that no view mends are given up, and nothing else is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.planning import vain_looks
from r3jax.planning.config import PlannerConfig
from r3jax.planning.vain_looks import SLOTS, count_vain_looks, no_looks
from r3jax.scoring.config import ScoringConfig
from tests.mutants import Modules, Mutant, assert_caught, each

CAMERA = r3jax.Camera.from_fov(64, 64, 80.0)
SCORING = ScoringConfig(zbuffer_size=64)
EYE, FAR_SIDE = np.array([0.0, 0.0, 1.0]), np.array([4.0, 0.0, 1.0])
POSE = jnp.asarray(r3jax.look_at(EYE, np.array([2.0, 0.0, 1.0])), jnp.float32)


def wall(y: tuple[float, float], x: float = 2.05) -> np.ndarray:
    """Points of a wall across the line of sight [400, 3] [m]."""
    y_z = np.meshgrid(np.linspace(*y, 20), np.linspace(0.5, 1.5, 20))
    points = np.stack([np.full(400, x), *(axis.ravel() for axis in y_z)], axis=1)
    return points.astype(np.float32)


SEEN, UNSEEN, HIDDEN = wall((-1.0, -0.1)), wall((0.1, 1.0)), wall((-0.5, 0.5), 2.55)


def map_of():
    """Half of a wall was observed from where the camera stands; the other half, and what the wall
    hides, from behind only."""
    state = r3jax.empty_map(1 << 12, num_bins=40)  # no multiple of 32: bits are left over
    for points, eye in ((SEEN, EYE), (UNSEEN, FAR_SIDE), (HIDDEN, FAR_SIDE)):
        color = np.full_like(points, 0.5)
        state = r3jax.integrate_points(state, points, color, eye.astype(np.float32), 64.0)
    return state


def lack(state, points) -> np.ndarray:
    terms = r3jax.voxel_renderability(state, POSE[:3, 3], CAMERA.focal)
    return 1.0 - np.asarray(terms.value[r3jax.lookup(state, jnp.asarray(points))])


def looked(modules: Modules, times: int):
    counts, state = jnp.asarray(no_looks()), map_of()
    for _ in range(times):
        counts = modules["vain_looks"].count_vain_looks(counts, state, CAMERA, POSE, SCORING)
    return state, counts


def law_only_what_was_not_observed_counts(modules: Modules) -> None:
    state, counts = looked(modules, 2)
    given_up = modules["vain_looks"].without_hopeless(state, counts, jnp.uint8(2))
    assert lack(state, SEEN).max() < 0.2  # observed from here: all but the width of a bin
    assert lack(state, UNSEEN).min() > 0.9
    assert (lack(given_up, UNSEEN) < 0.2).mean() > 0.8  # all but those at its rim
    assert (lack(given_up, HIDDEN) > 0.9).mean() > 0.8
    assert set(np.unique(counts)) == {0, 2}


def law_patience_is_counted_in_looks(modules: Modules) -> None:
    state, counts = looked(modules, 2)
    waits = modules["vain_looks"].without_hopeless(state, counts, jnp.uint8(3))
    assert jax.tree.all(jax.tree.map(np.array_equal, waits, state))


def law_what_is_given_up_still_hides_and_is_sound(modules: Modules) -> None:
    state, counts = looked(modules, 1)
    given_up = modules["vain_looks"].without_hopeless(state, counts, jnp.uint8(1))
    np.testing.assert_array_equal(given_up.key, state.key)
    np.testing.assert_array_equal(given_up.count, state.count)
    last = np.asarray(given_up.visited)[-1] >> np.uint32(state.num_bins % 32)
    assert not last.any()  # no bit beyond the last bin
    assert 0.0 <= float(r3jax.renderability(given_up, CAMERA, POSE)) <= 1.0


LAWS = (
    law_only_what_was_not_observed_counts,
    law_patience_is_counted_in_looks,
    law_what_is_given_up_still_hides_and_is_sound,
)
MUTANTS = [
    Mutant("vain_looks", "(terms.value < LACKING)", "(terms.value >= LACKING)", LAWS[0]),
    Mutant("vain_looks", "is_vain = is_visible & ", "is_vain = ", LAWS[0]),
    Mutant("vain_looks", ">= patience", "> 0", LAWS[1]),
    Mutant("vain_looks", "bits[:num_bins] = 1", "bits[:] = 1", LAWS[2]),
]


@pytest.mark.parametrize("law", LAWS)
def test_the_laws_hold(law):
    law({"vain_looks": vain_looks})


@each(MUTANTS)
def test_faults_are_noticed(mutant):
    assert_caught(("r3jax.planning.vain_looks",), mutant)


def test_a_full_counter_stays_full():
    full = jnp.full(SLOTS, 255, jnp.uint8)
    assert np.all(np.asarray(count_vain_looks(full, map_of(), CAMERA, POSE, SCORING)) == 255)


def test_patience_must_be_a_count():
    with pytest.raises(ValueError, match="patience must lie between 0 and 255"):
        PlannerConfig(patience=-1)
