"""Coefficients and means with intervals: laws, scipy and closed forms, faults put in on purpose."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from r3jax.evaluation.statistics import (
    kendall,
    mean_over_scenes,
    paired_difference,
    partial_spearman,
    spearman,
    with_interval,
)
from tests.mutants import Mutant, assert_caught, each, load

CHAIN = ("r3jax.evaluation.statistics",)
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


def law_values(modules) -> None:
    """Ranks by hand: x = 1 ... 5 against 2 1 4 3 5, and against a column with a tie."""
    m = modules["statistics"]
    x, y, tied = np.arange(5.0), np.array([2.0, 1.0, 4.0, 3.0, 5.0]), np.array([1.0, 1, 2, 3, 4])
    assert m.spearman(x, y, **FEW).value == pytest.approx(1 - 6 * 4 / (5 * 24))
    assert m.kendall(x, y, **FEW).value == pytest.approx((8 - 2) / 10)
    assert m.kendall(x, tied, **FEW).value == pytest.approx(9 / math.sqrt(10 * 9))  # tau-b
    gap = np.array([np.nan, *y])
    assert m.spearman(np.arange(-1.0, 5.0), gap, **FEW).value == pytest.approx(0.8)
    assert m.spearman(np.arange(-1.0, 5.0), gap, **FEW).count == 5


def law_partial(modules) -> None:
    """The closed form for one covariate, and none left where the covariate says it all."""
    partial = modules["statistics"].partial_spearman
    x, y, z = columns(7)
    xy, xz, yz = (stats.spearmanr(a, b).statistic for a, b in ((x, y), (x, z), (y, z)))
    expected = (xy - xz * yz) / math.sqrt((1 - xz**2) * (1 - yz**2))
    assert partial(x, y, [z], **FEW).value == pytest.approx(expected, abs=1e-12)
    assert partial(x, y, [], **FEW).value == pytest.approx(xy, abs=1e-12)
    assert partial(x, y, [np.ones(N)], **FEW).value == pytest.approx(xy, abs=1e-12)
    assert partial(x, y, [z, z], **FEW).value == pytest.approx(expected, abs=1e-12)
    assert math.isnan(partial(x, y, [monotone(x)], **FEW).value)


def law_interval(modules) -> None:
    """As wide as Fisher's z says for normal data: +- 1.96 / sqrt(n - 3), here 1.03 of it."""
    m, rng = modules["statistics"], np.random.default_rng(3)
    x, y = rng.normal(size=(2, 500))
    found = m.spearman(x, y, seed=1, resamples=600)
    expected = 1.96 / math.sqrt(497)
    assert 0.85 < (found.high - found.low) / (2 * expected) < 1.15
    assert found.low < found.value < found.high
    assert m.spearman(x, y, seed=1, resamples=600) == found
    assert interval(m.spearman(x, y, seed=2, resamples=600)) != interval(found)


def law_strata(modules) -> None:
    """Resamples keep the number of views of every stratum."""
    labels = np.array(["a"] * 5 + ["b"] * 20 + ["c"])
    is_b = (labels == "b").astype(float)
    share = lambda strata: modules["statistics"].with_interval(
        lambda x: float(x.mean()), [is_b], strata=strata, **FEW
    )
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


def scores(seed, shape=(3, 25), scenes=("flat", "house")):
    rng = np.random.default_rng(seed)
    return {scene: rng.normal(25.0, 3.0, shape) for scene in scenes}


def law_mean(modules) -> None:
    """Scenes weigh the same; missing views do not count; the order of scenes does not matter."""
    mean = modules["statistics"].mean_over_scenes
    uneven = {"a": np.full((2, 10), 20.0), "b": np.full((2, 90), 30.0)}
    found = mean(uneven)
    assert (found.value, found.low, found.high) == pytest.approx((25.0, 25.0, 25.0))
    assert found.count == 100
    some = scores(4)
    assert mean(dict(reversed(some.items()))) == mean(some)
    holes = {k: np.concatenate([v, np.full((3, 2), np.nan)], axis=1) for k, v in some.items()}
    assert mean(holes) == mean(some)
    low, high = interval(mean(some))
    assert low < np.mean([v.mean() for v in some.values()]) < high


def law_crossed(modules) -> None:
    """Views that are hard for all seeds: the interval is that of the views, not of S x V values."""
    mean, rng = modules["statistics"].mean_over_scenes, np.random.default_rng(5)
    views, by_seed = rng.normal(25.0, 3.0, 300), rng.normal(0.0, 2.0, 12)
    same = mean({"a": np.tile(views, (12, 1))}, resamples=2000)
    expected = 2 * 1.96 * views.std() / math.sqrt(300)
    assert same.high - same.low == pytest.approx(expected, rel=0.1)
    moved = mean({"a": np.tile(by_seed[:, None], (1, 300))}, resamples=2000)
    expected = 2 * 1.96 * by_seed.std() / math.sqrt(12)
    assert moved.high - moved.low == pytest.approx(expected, rel=0.1)


def law_paired(modules) -> None:
    """What both methods share cancels; the exchange of the methods turns the sign."""
    difference = modules["statistics"].paired_difference
    first, noise = scores(8), scores(9)
    second = {scene: first[scene] - 1.0 for scene in first}
    found = difference(first, second)
    assert (found.value, found.low, found.high) == pytest.approx((1.0, 1.0, 1.0))
    there, back = difference(first, noise, seed=3), difference(noise, first, seed=3)
    assert (back.value, back.low, back.high) == pytest.approx(
        (-there.value, -there.high, -there.low), abs=1e-12
    )
    close = {scene: first[scene] - 0.1 * noise[scene] for scene in first}
    tight, loose = difference(first, close), mean_over_scenes(first)
    assert tight.high - tight.low < 0.2 * (loose.high - loose.low)


@given(seeds, st.integers(1, 3), st.integers(1, 20))
def test_the_interval_of_symmetric_data_holds_its_mean(seed, num_seeds, half):
    rng = np.random.default_rng(seed)
    side = rng.uniform(0.5, 3.0, (num_seeds, half))
    values = {"scene": 25.0 + np.concatenate([side, -side], axis=1)}
    found = mean_over_scenes(values, resamples=400)
    assert found.low <= 25.0 + 1e-9
    assert found.high >= 25.0 - 1e-9
    assert found.value == pytest.approx(25.0)


def test_mistakes_are_named():
    x = np.arange(5.0)
    with pytest.raises(ValueError, match=r"one length, got shapes \[\(5,\), \(4,\)"):
        spearman(x, x[:4])
    with pytest.raises(ValueError, match="at least 3 rows without NaN, got 2 of 5"):
        kendall(x, np.array([np.nan, 1.0, np.nan, 2.0, np.nan]))
    with pytest.raises(ValueError, match="one length"):
        spearman(x, x, strata=np.arange(4))
    with pytest.raises(ValueError, match="no scene"):
        mean_over_scenes({})
    with pytest.raises(ValueError, match="flat: a view has a value for some seeds only"):
        mean_over_scenes({"flat": np.array([[1.0, np.nan], [1.0, 2.0]])})
    with pytest.raises(ValueError, match=r"flat: needs values \[seeds, views\]"):
        mean_over_scenes({"flat": np.full((2, 2), np.nan)})
    with pytest.raises(ValueError, match=r"run in \['a'\] and in \['b'\]"):
        paired_difference(scores(0, scenes=("a",)), scores(0, scenes=("b",)))
    with pytest.raises(ValueError, match=r"a: \[seeds, views\] is \(3, 25\) .* \(2, 25\)"):
        paired_difference(scores(0, scenes="a"), scores(0, (2, 25), "a"))


MUTANTS = [
    Mutant("statistics", "stats.spearmanr(x, y)", "stats.pearsonr(np.exp(x), y)", law_values),
    Mutant("statistics", 'variant="b"', 'variant="c"', law_values),
    Mutant("statistics", "~np.isnan(table).any(axis=0)", "table[0] == table[0]", law_values),
    Mutant("statistics", "ranks -= ranks.mean(axis=1, keepdims=True)", "pass", law_partial),
    Mutant("statistics", "stats.rankdata(np.stack([x, y, *given]), axis=1)",
           "np.stack([x, y, *given])", law_partial),
    Mutant("statistics", "ranks[:2].T - known @", "ranks[:2].T + known @", law_partial),
    Mutant("statistics", "norms <= 1e-9", "norms <= 1e9", law_partial),
    Mutant("statistics", "LEVEL = (2.5, 97.5)", "LEVEL = (5.0, 95.0)", law_crossed),
    Mutant("statistics", "rng = np.random.default_rng(seed)\n    groups",
           "rng = np.random.default_rng()\n    groups", law_interval),
    Mutant("statistics", "rng.choice(group, len(group))", "rng.permutation(group)", law_interval),
    Mutant("statistics", "statistic(*table[:, rows])", "statistic(*table[:, rows[::2]])",
           law_interval),
    Mutant("statistics", "np.unique(labels)]", "[labels[0]]]", law_strata),
    Mutant("statistics", "/ values.size / len(scores)", "/ values.size", law_mean),
    Mutant("statistics", "np.mean(means)", "np.mean(means[:1])", law_mean),
    Mutant("statistics", "in sorted(scores)", "in scores", law_mean),
    Mutant("statistics", "~unknown.any(axis=0)]", ":1]", law_mean),
    Mutant("statistics", "((seeds @ values) * views)",
           "(np.full(num_seeds, 1) @ values * views)", law_crossed),
    Mutant("statistics", "((seeds @ values) * views)", "(seeds @ values)", law_crossed),
    Mutant("statistics", "first[scene] - second[scene] for", "second[scene] - first[scene] for",
           law_paired),
]  # fmt: skip
LAWS = [
    law_values, law_partial, law_interval, law_strata, law_mean, law_crossed, law_paired,
]  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_laws_hold_without_a_fault(law):
    law(load(CHAIN))


@each(MUTANTS)
def test_mutant_is_caught(mutant):
    assert_caught(CHAIN, mutant)
