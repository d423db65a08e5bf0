"""Rank correlations with intervals: laws, scipy and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from experiments.rank_statistics import kendall, partial_spearman, spearman, with_interval

N = 60
FEW = {"resamples": 40}
seeds = st.integers(0, 2**32 - 1)


def columns(seed, count=3, ties=False):
    """Columns that share a part, so that all of them correlate."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(count, N)) + rng.normal(size=N)
    return np.round(table) if ties else table


def interval(estimate):
    return (estimate.low, estimate.high)


def monotone(x):
    return np.exp(x / 2.0) + x


@settings(max_examples=12)
@given(seeds, st.booleans())
def test_rank_coefficients_know_only_the_order(seed, ties):
    x, y, z = columns(seed, ties=ties)
    for coefficient in (spearman, kendall, lambda *xy, **k: partial_spearman(*xy, [z], **k)):
        plain = coefficient(x, y, **FEW)
        assert -1.0 <= plain.low <= plain.high <= 1.0
        assert -1.0 <= plain.value <= 1.0
        mapped = coefficient(monotone(x), y**3, **FEW)
        assert mapped.value == pytest.approx(plain.value, abs=1e-12)
        assert interval(mapped) == pytest.approx(interval(plain), abs=1e-12)
        turned = coefficient(-x, y, **FEW)
        assert turned.value == pytest.approx(-plain.value, abs=1e-12)
        assert coefficient(y, x, **FEW).value == pytest.approx(plain.value, abs=1e-12)
    assert spearman(x, monotone(x), **FEW).value == pytest.approx(1.0)
    assert kendall(x, -x, **FEW).value == pytest.approx(-1.0)


@settings(max_examples=12)
@given(seeds)
def test_coefficients_do_not_depend_on_the_order_of_the_views(seed):
    x, y, z = columns(seed)
    order = np.random.default_rng(seed + 1).permutation(N)
    for coefficient in (spearman, kendall):
        plain = coefficient(x, y, **FEW).value
        assert coefficient(x[order], y[order], **FEW).value == pytest.approx(plain)
    shuffled = partial_spearman(x[order], y[order], [z[order]], **FEW).value
    assert shuffled == pytest.approx(partial_spearman(x, y, [z], **FEW).value)


def test_values() -> None:
    """Ranks by hand: x = 1 ... 5 against 2 1 4 3 5, and against a column with a tie."""
    x, y, tied = np.arange(5.0), np.array([2.0, 1.0, 4.0, 3.0, 5.0]), np.array([1.0, 1, 2, 3, 4])
    assert spearman(x, y, **FEW).value == pytest.approx(1 - 6 * 4 / (5 * 24))
    assert kendall(x, y, **FEW).value == pytest.approx((8 - 2) / 10)
    assert kendall(x, tied, **FEW).value == pytest.approx(9 / math.sqrt(10 * 9))  # tau-b
    gap = np.array([np.nan, *y])
    assert spearman(np.arange(-1.0, 5.0), gap, **FEW).value == pytest.approx(0.8)
    assert spearman(np.arange(-1.0, 5.0), gap, **FEW).count == 5


def test_partial() -> None:
    """The closed form for one covariate, and none left where the covariate says it all."""
    partial = partial_spearman
    x, y, z = columns(7)
    xy, xz, yz = (stats.spearmanr(a, b).statistic for a, b in ((x, y), (x, z), (y, z)))
    expected = (xy - xz * yz) / math.sqrt((1 - xz**2) * (1 - yz**2))
    assert partial(x, y, [z], **FEW).value == pytest.approx(expected, abs=1e-12)
    assert partial(x, y, [], **FEW).value == pytest.approx(xy, abs=1e-12)
    assert partial(x, y, [np.ones(N)], **FEW).value == pytest.approx(xy, abs=1e-12)
    assert partial(x, y, [z, z], **FEW).value == pytest.approx(expected, abs=1e-12)
    assert math.isnan(partial(x, y, [monotone(x)], **FEW).value)


def test_interval() -> None:
    """As wide as Fisher's z says for normal data: +- 1.96 / sqrt(n - 3), here 1.03 of it."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 500))
    found = spearman(x, y, seed=1, resamples=600)
    expected = 1.96 / math.sqrt(497)
    assert 0.85 < (found.high - found.low) / (2 * expected) < 1.15
    assert found.low < found.value < found.high
    assert spearman(x, y, seed=1, resamples=600) == found
    assert interval(spearman(x, y, seed=2, resamples=600)) != interval(found)


def test_strata() -> None:
    """Resamples keep the number of views of every stratum."""
    labels = np.array(["a"] * 5 + ["b"] * 20 + ["c"])
    is_b = (labels == "b").astype(float)
    share = lambda strata: with_interval(lambda x: float(x.mean()), [is_b], strata=strata, **FEW)
    found = share(labels)
    assert (found.low, found.value, found.high) == pytest.approx((20 / 26,) * 3)
    assert share(None).low < 20 / 26 < share(None).high


def test_what_is_not_defined_is_nan():
    x = np.arange(6.0)
    for coefficient in (spearman, kendall):
        found = coefficient(np.ones(6), x)
        assert np.isnan([found.value, found.low, found.high]).all()
    rare = np.array([0.0] * 29 + [1.0])  # a third of the resamples are constant: left out
    found = spearman(rare, np.arange(30.0), resamples=200)
    assert 0.0 < found.low <= found.high <= 1.0
    rarely = with_interval(lambda c: 1.0 if c[0] == 0.0 else np.nan, [x], resamples=50)
    assert rarely.value == 1.0
    assert np.isnan(rarely.low)


@pytest.mark.parametrize(
    ("y", "strata"),
    [
        (np.arange(4.0), None),
        (np.array([np.nan, 1.0, np.nan, 2.0, np.nan]), None),
        (np.arange(5.0), np.arange(4)),
    ],
)
def test_columns_that_do_not_pair_are_refused(y, strata):
    with pytest.raises(ValueError, match="got"):
        spearman(np.arange(5.0), y, strata=strata)
