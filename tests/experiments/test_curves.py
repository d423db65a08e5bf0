"""Sparsification and areas over budgets: laws, cases by hand, faults put in on purpose."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.curves import area_under, ause, common_range, sparsification

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


def test_ause() -> None:
    """By hand: errors 1, 2, 6 in the order predicted best, worst, middle."""
    found = sparsification(np.array([0.9, 0.1, 0.5]), np.array([1.0, 2.0, 6.0]))
    assert found.removed == pytest.approx([0.0, 1 / 3, 2 / 3])
    assert found.curve == pytest.approx([3.0, 3.5, 1.0])
    assert found.oracle == pytest.approx([3.0, 1.5, 1.0])
    assert found.area == pytest.approx(2.0 / 3.0)
    assert found.relative == pytest.approx(2.0 / 3.5)
    # The two views of equal quality leave in both orders: rest 3.5 or 1.5, 2.5 on average.
    tied = sparsification(np.array([0.9, 0.1, 0.1]), np.array([1.0, 2.0, 6.0]))
    assert tied.curve == pytest.approx([3.0, 2.5, 1.0])
    assert sparsification(np.zeros(3), np.array([1.0, 2.0, 6.0])).relative == pytest.approx(1.0)


def test_a_random_order_is_about_one_and_its_interval_says_so():
    quality, error = np.random.default_rng(0).normal(size=(2, 300))
    found = ause(quality, error, resamples=200)
    assert 0.8 < found.low < 1.0 < found.high < 1.2
    noisy = ause(-error + 0.3 * quality, error, resamples=200)
    assert 0.0 < noisy.low < noisy.value < noisy.high < 0.3
    gaps = ause(np.append(quality, np.nan), np.append(error, 1e9), resamples=200)
    assert gaps == found


def test_area() -> None:
    """By hand: (10, 20), (20, 24), (50, 27), whole and cut."""
    area = area_under
    x, y = np.array([10.0, 20.0, 50.0]), np.array([20.0, 24.0, 27.0])
    assert area(x, y) == pytest.approx((10 * 22 + 30 * 25.5) / 40)
    assert area(x, y, start=15.0, end=35.0) == pytest.approx((5 * 23 + 15 * 24.75) / 20)
    assert area(x, y, start=20.0) == pytest.approx(25.5)
    assert area(x, y, end=20.0) == pytest.approx(22.0)
    assert area(x, y, start=30.0, end=40.0) == pytest.approx(25.5)


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


def test_curves_with_other_ends_meet_on_their_common_range():
    long, short = np.array([0.0, 10.0, 20.0]), np.array([4.0, 16.0])
    start, end = common_range([long, short])
    assert (start, end) == (4.0, 16.0)
    assert area_under(long, 2.0 * long, start=start, end=end) == pytest.approx(20.0)
    assert area_under(short, 2.0 * short, start=start, end=end) == pytest.approx(20.0)


def test_mistakes_are_named():
    x = np.array([10.0, 20.0])
    with pytest.raises(ValueError, match="spans 10 to 20, so it has no area from 5 to 20"):
        area_under(x, x, start=5.0)
    with pytest.raises(ValueError, match="no area from 10 to 30; use the range"):
        area_under(x, x, end=30.0)
    with pytest.raises(ValueError, match="no area from 20 to 20"):
        area_under(x, x, start=20.0)
    for budget in ([10.0], [10.0, 10.0], [20.0, 10.0]):
        with pytest.raises(ValueError, match="two or more snapshots in increasing order"):
            area_under(np.array(budget), np.ones(len(budget)))
    with pytest.raises(ValueError, match=r"budgets \[10.0, 20.0\] and 3 values"):
        area_under(x, np.ones(3))
    with pytest.raises(ValueError, match="one starts at 30, one ends at 20"):
        common_range([x, x + 20.0])
    with pytest.raises(ValueError, match="no curves"):
        common_range([])
    with pytest.raises(ValueError, match=r"one length, got \(2,\), \(3,\)"):
        sparsification(x, np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        sparsification(x, np.array([np.inf, 1.0]))
