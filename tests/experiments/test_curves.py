"""Sparsification and areas over budgets: laws, cases by hand, faults put in on purpose."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.curves import area_under, common_range, sparsification

errors = st.lists(st.floats(-50.0, 50.0).map(lambda x: round(x, 2)), min_size=2, max_size=30)


@given(errors, st.randoms(use_true_random=False))
def test_ause_laws(values, random):
    error = np.array(values)
    oracle, reverse = sparsification(-error, error), sparsification(error, error)
    assert oracle.area == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(oracle.curve, oracle.oracle, atol=1e-9)
    if len(set(values)) == 1:
        assert math.isnan(oracle.relative)
        return
    assert reverse.area > 0.0
    assert reverse.relative > 1.0
    quality = np.array([random.choice(range(5)) for _ in values], float)
    found = sparsification(quality, error)
    assert -1e-9 <= found.area <= reverse.area + 1e-9
    assert np.all(found.curve >= found.oracle - 1e-9)
    order = np.array(random.sample(range(len(values)), len(values)))
    assert sparsification(quality[order], error[order]).area == pytest.approx(found.area, abs=1e-9)
    assert sparsification(np.exp(quality), error).area == pytest.approx(found.area)
    moved = sparsification(quality, 3.0 * error + 7.0)
    assert moved.area == pytest.approx(3.0 * found.area, abs=1e-9)
    assert moved.relative == pytest.approx(found.relative, abs=1e-6)


@given(st.lists(st.integers(1, 50), min_size=2, max_size=8), st.floats(-40, 40), st.floats(0, 9))
def test_area_laws(steps, height, slope):
    x = np.cumsum(steps).astype(float)
    assert area_under(x, np.full(len(x), height)) == pytest.approx(height)
    line = area_under(x, height + slope * x)
    assert line == pytest.approx(height + slope * (x[0] + x[-1]) / 2)
    y = np.sin(x) * 10.0
    assert area_under(3.0 * x + 1.0, y) == pytest.approx(area_under(x, y))  # unit of the budget
    middle = (x[0] + x[-1]) / 2
    halves = area_under(x, y, end=middle) + area_under(x, y, start=middle)
    assert area_under(x, y) == pytest.approx(halves / 2)


def test_mistakes_are_refused():
    x = np.array([10.0, 20.0])
    for start, end in ((5.0, None), (None, 30.0), (20.0, None)):
        with pytest.raises(ValueError, match="10 to 20"):
            area_under(x, x, start=start, end=end)
    for budget, size in (([10.0], 1), ([10.0, 10.0], 2), ([20.0, 10.0], 2), ([10.0, 20.0], 3)):
        with pytest.raises(ValueError, match=f"{size} values"):
            area_under(np.array(budget), np.ones(size))
    for budgets in ([x, x + 20.0], []):
        with pytest.raises(ValueError):
            common_range(budgets)
    for quality, error in ((x, np.ones(3)), (x, np.array([np.inf, 1.0]))):
        with pytest.raises(ValueError):
            sparsification(quality, error)
