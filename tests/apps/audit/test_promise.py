"""A promise is what was measured, and lies between what there is and what is imagined."""

import json
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.audit import suggest as module

RESULT = Path(__file__).parents[3] / "experiments/results/audit_promise/promise.json"

share = st.floats(0.0, 1.0)


def test_the_numbers_are_those_of_the_result():
    record = json.loads(RESULT.read_text())
    assert tuple(record["loss"]) == module.LOSS
    assert tuple(record["loss_random"]) == module.LOSS_RANDOM


@given(share, st.integers(0, 30))
def test_a_promise_is_an_interval_below_what_is_simulated(simulated, pictures):
    low, middle, high = module.expected(simulated, pictures, module.LOSS)
    assert 0.0 <= low <= middle <= high <= 1.0
    assert simulated - low <= module.LOSS[2] + 1e-9
    if pictures == 0:
        assert low == high == simulated


@given(share, share, st.integers(1, 30))
def test_who_sees_more_is_promised_more(first, second, pictures):
    less, more = sorted((first, second))
    pairs = zip(*(module.expected(x, pictures, module.LOSS) for x in (less, more)), strict=True)
    assert all(a <= b for a, b in pairs)
