"""Statistics of weighted views: laws, scipy on repeated views, faults put in on purpose."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from experiments import error_statistics
from experiments.curves import sparsification
from experiments.error_statistics import Draws
from experiments.rank_statistics import partial_spearman

VIEWS, DRAWS = 25, 8
seeds = st.integers(0, 2**32 - 1)


def sample(seed, ties=True):
    """Three columns that share a part, [3, V], and weights of draws, [D, V]."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(3, VIEWS)) + rng.normal(size=VIEWS)
    weights = rng.multinomial(VIEWS, np.full(VIEWS, 1 / VIEWS), DRAWS).astype(float)
    weights[0] = 1.0
    return (np.round(2.0 * table) / 2.0 if ties else table), weights


def repeated(weights, *columns):
    """The columns as a draw would list them: each view as often as it was drawn."""
    return [np.repeat(column, weights.astype(int)) for column in columns]


def test_repeats() -> None:
    """Every statistic of weighted views is that of the same views written out."""
    for seed in range(6):
        (x, y, z), weights = sample(seed, ties=seed % 2 == 0)
        found = {
            "spearman": error_statistics.spearman(x, y, weights),
            "kendall": error_statistics.kendall(x, y, weights),
            "partial": error_statistics.partial_spearman(x, y, z, weights),
            "ause": error_statistics.ause(x, y, weights),
        }
        for d in range(DRAWS):
            a, b, c = repeated(weights[d], x, y, z)
            expected = {
                "spearman": stats.spearmanr(a, b).statistic,
                "kendall": stats.kendalltau(a, b).statistic,
                "partial": partial_spearman(a, b, [c], resamples=1).value,
                "ause": sparsification(a, b).relative,
            }
            for name, value in expected.items():
                assert found[name][d] == pytest.approx(value, abs=1e-9), name


@settings(max_examples=15)
@given(seeds, st.booleans())
def test_weights_are_repeats(seed, ties):
    (x, y, _), weights = sample(seed, ties)
    for d in (0, 3):
        a, b = repeated(weights[d], x, y)
        ranks = error_statistics.ranks(x, weights)[d]
        np.testing.assert_allclose(*repeated(weights[d], ranks), stats.rankdata(a), atol=1e-9)
        tau = error_statistics.kendall(x, y, weights)[d]
        assert tau == pytest.approx(stats.kendalltau(a, b).statistic, abs=1e-9)


def test_gaps() -> None:
    """A view without a value is as if it were not there."""
    (x, y, z), weights = sample(3)
    holes = np.r_[np.full(3, np.nan), x], np.r_[y[:3], y], np.r_[z[:3], z]
    padded = np.concatenate([np.ones((DRAWS, 3)), weights], axis=1)
    for name, columns, whole in (
        ("spearman", holes[:2], (x, y)),
        ("kendall", holes[:2], (x, y)),
        ("ause", holes[:2], (x, y)),
        ("partial_spearman", holes, (x, y, z)),
    ):
        statistic = getattr(error_statistics, name)
        np.testing.assert_allclose(statistic(*columns, padded), statistic(*whole, weights))


def test_undefined() -> None:
    """NaN, without a warning: nothing varies, or what is given says it all."""
    (x, y, _), weights = sample(1, ties=False)
    flat, nothing = np.ones(VIEWS), np.full(VIEWS, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for statistic in (error_statistics.spearman, error_statistics.kendall):
            assert np.isnan(statistic(flat, y, weights)).all()
            assert np.isnan(statistic(nothing, y, weights)).all()
        assert np.isnan(error_statistics.ause(x, flat, weights)).all()
        assert np.isnan(error_statistics.partial_spearman(x, y, np.exp(x), weights)).all()
        kept = error_statistics.partial_spearman(x, y, flat, weights)
    np.testing.assert_allclose(kept, error_statistics.spearman(x, y, weights))


def interval(samples, explorations, num_views, num, resamples=3000):
    draws = error_statistics.draw(num_views, num, resamples=resamples)
    return error_statistics.mean_over_models(samples(draws), np.asarray(explorations), draws)


def test_drawn_alike() -> None:
    """All models share one draw of views: a hundred copies of a model are no evidence."""
    rng, num = np.random.default_rng(0), 60
    views = rng.normal(size=num)
    mean_of = lambda draws: (draws.views * views).mean(axis=1)
    one = interval(lambda d: mean_of(d)[None], [0], num, 1)
    copies = interval(lambda d: np.tile(mean_of(d), (100, 1)), range(100), num, 100)
    width = 2 * 1.96 * views.std() / math.sqrt(num)
    assert one.high - one.low == pytest.approx(width, rel=0.1)
    assert copies.high - copies.low == pytest.approx(width, rel=0.1)
    assert copies.value == pytest.approx(views.mean())


def test_explorations() -> None:
    """An exploration brings all its budgets along: they are not drawn one by one."""
    by_exploration = np.random.default_rng(1).normal(size=20)
    numbers = np.repeat(np.arange(20), 5)
    found = interval(
        lambda d: np.tile(by_exploration[numbers][:, None], len(d.views)), numbers, 10, 20
    )
    width = 2 * 1.96 * by_exploration.std() / math.sqrt(20)
    assert found.high - found.low == pytest.approx(width, rel=0.1)
    assert found.count == 100
    assert found.low < found.value < found.high


def test_means() -> None:
    """By hand: three models of two explorations, drawn as they are, then the first one twice."""
    draws = Draws(np.ones((3, 4)), np.array([[1.0, 1.0], [2.0, 0.0], [0.0, 2.0]]))
    samples = np.array([[1.0] * 3, [2.0] * 3, [6.0, 6.0, np.nan]])
    found = error_statistics.mean_over_models(samples, np.array([0, 0, 1]), draws)
    assert (found.value, found.count) == (3.0, 3)
    assert found.low == found.high == 1.5  # the third draw has no value, the second is all
    some = error_statistics.mean_over_models(
        samples, np.array([0, 0, 1]), draws, models=np.array([False, True, True])
    )
    assert (some.value, some.low, some.count) == (4.0, 2.0, 2)
    none = error_statistics.mean_over_models(np.full((1, 3), np.nan), np.array([0]), draws)
    assert np.isnan([none.value, none.low, none.high]).all()


def test_draws_are_repeatable_and_start_with_the_sample():
    draws = error_statistics.draw(7, 3, seed=2, resamples=50)
    assert draws.views.shape == (51, 7)
    assert draws.explorations.shape == (51, 3)
    np.testing.assert_array_equal(draws.views[0], np.ones(7))
    assert set(draws.views.sum(axis=1)) == {7.0}
    assert set(draws.explorations.sum(axis=1)) == {3.0}
    again = error_statistics.draw(7, 3, seed=2, resamples=50)
    np.testing.assert_array_equal(again.views, draws.views)
    assert np.any(error_statistics.draw(7, 3, seed=3, resamples=50).views != draws.views)
