"""Statistics of weighted views: laws, scipy on repeated views, faults put in on purpose."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from experiments import error_statistics

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


def partial(a, b, c):
    """Correlation of the residuals of ranks, once the ranks of c are regressed out."""
    x, y, z = (stats.rankdata(column) for column in (a, b, c))
    rest = lambda v: v - np.polyval(np.polyfit(z, v, 1), z)
    return stats.pearsonr(rest(x), rest(y)).statistic


@settings(max_examples=15)
@given(seeds, st.booleans())
def test_weights_are_repeats(seed, ties):
    """Every statistic of weighted views is that of the same views written out."""
    (x, y, z), weights = sample(seed, ties)
    ranks = error_statistics.ranks(x, weights)
    plain = error_statistics.spearman(x, y, weights)
    given_z = error_statistics.partial_spearman(x, y, z, weights)
    for d in (0, 3):
        a, b, c, r = repeated(weights[d], x, y, z, ranks[d])
        np.testing.assert_allclose(r, stats.rankdata(a), atol=1e-9)
        assert plain[d] == pytest.approx(stats.spearmanr(a, b).statistic, abs=1e-9)
        assert given_z[d] == pytest.approx(partial(a, b, c), abs=1e-6)


def test_undefined() -> None:
    """NaN, without a warning: nothing varies, or what is given says it all."""
    (x, y, _), weights = sample(1, ties=False)
    flat, nothing = np.ones(VIEWS), np.full(VIEWS, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(error_statistics.spearman(flat, y, weights)).all()
        assert np.isnan(error_statistics.spearman(nothing, y, weights)).all()
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
