"""Rank statistics of many models evaluated by the same views, with intervals over both.

A statistic belongs to one model (scene, policy, seed, snapshot); a scene's number is its mean over
models. Its interval is a bootstrap that resamples views and explorations independently (the
pigeonhole bootstrap, Owen 2007): a view that is hard for one model is hard for all, so all models
of a resample are evaluated by the same drawn views, and an exploration (policy and seed) brings all
its snapshots along, which share their first frames. Drawing models x views one by one would take a
hundred views evaluated fifty times for five thousand independent ones.

A resample is a row of weights, how often it holds each view: ranks and correlations have
closed forms in them, so that a thousand resamples are a few array operations. The first row holds
every view once: the sample itself.

Shape symbols: V views; D draws, one more than there are resamples; M models; E explorations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r3jax.evaluation.comparison import LEVEL, RESAMPLES, Estimate

_NOTHING_LEFT = 1e-9
"""A variance below this share of the whole is rounding."""


@dataclass(frozen=True)
class Draws:
    """Resamples of a scene."""

    views: np.ndarray
    """How often each draw holds each view, [D, V]; ones in the first row."""

    explorations: np.ndarray
    """The same of explorations, [D, E]."""


def draw(
    num_views: int, num_explorations: int, *, seed: int = 0, resamples: int = RESAMPLES
) -> Draws:
    """Draws views and explorations with replacement, as many as there are."""
    rng = np.random.default_rng(seed)

    def weights(count: int) -> np.ndarray:
        drawn = rng.multinomial(count, np.full(count, 1.0 / count), resamples)
        return np.concatenate([np.ones((1, count)), drawn])

    return Draws(weights(num_views), weights(num_explorations))


def mean_over_models(samples: np.ndarray, explorations: np.ndarray, draws: Draws) -> Estimate:
    """Returns the mean over models of a statistic, with its interval; NaN are left out.

    Args:
        samples: the statistic of every model and draw, [M, D].
        explorations: number of each model's exploration, [M].
        draws: that made the samples.

    Returns:
        The estimate; its count is the number of models. NaN where no model has a value, and
        without an interval where most draws have none.
    """
    weights = draws.explorations[:, explorations].T * ~np.isnan(samples)
    total, num = np.nansum(weights * samples, axis=0), weights.sum(axis=0)
    means = np.where(num > 0.0, total / np.maximum(num, 1.0), np.nan)
    known = means[1:][~np.isnan(means[1:])]
    count = int(np.sum(~np.isnan(samples[:, 0])))
    if np.isnan(means[0]) or 2 * len(known) < len(means) - 1 or len(known) == 0:
        return Estimate(float(means[0]), np.nan, np.nan, count)
    low, high = np.percentile(known, LEVEL)
    return Estimate(float(means[0]), float(low), float(high), count)


def _known(weights: np.ndarray, columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the columns without the views where one is NaN, and the weights of the others."""
    table = np.stack([np.asarray(column, np.float64) for column in columns])
    keep = ~np.isnan(table).any(axis=0)
    return table[:, keep], weights[:, keep]


def ranks(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns the rank of every view in every draw, [D, V].

    Ties, and views drawn twice, share their mean.
    """
    _, level = np.unique(values, return_inverse=True)
    order = np.argsort(level, kind="stable")
    starts = np.flatnonzero(np.diff(level[order], prepend=-1))
    if not len(starts):
        return np.zeros_like(weights)
    drawn = np.add.reduceat(weights[:, order], starts, axis=1)
    return (np.cumsum(drawn, axis=1) - 0.5 * drawn + 0.5)[:, level]


def _pearson(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns the correlation of columns [D, V] in every draw; NaN where one is constant."""
    num = np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    center = lambda a: a - (weights * a).sum(axis=1, keepdims=True) / num
    moment = lambda a, b: np.einsum("dv,dv,dv->d", weights, a, b)
    x, y = center(x), center(y)
    spread = moment(x, x) * moment(y, y)
    safe = np.where(spread > 1e-9, spread, 1.0)
    return np.where(spread > 1e-9, np.clip(moment(x, y) / np.sqrt(safe), -1.0, 1.0), np.nan)


def spearman(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns Spearman's rank correlation of two columns [V] in every draw, [D]."""
    (x, y), weights = _known(weights, (x, y))
    return _pearson(ranks(x, weights), ranks(y, weights), weights)


def partial_spearman(
    x: np.ndarray, y: np.ndarray, given: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Returns Spearman's correlation of x and y that remains once `given` is known, [D].

    (r_xy - r_xz r_yz) / sqrt((1 - r_xz^2) (1 - r_yz^2)); what is constant explains nothing; NaN
    where `given` determines the ranks of x or y.
    """
    (x, y, z), weights = _known(weights, (x, y, given))
    x, y, z = (ranks(column, weights) for column in (x, y, z))
    xy = _pearson(x, y, weights)
    xz, yz = (np.nan_to_num(_pearson(column, z, weights)) for column in (x, y))
    left = (1.0 - xz**2) * (1.0 - yz**2)
    is_left = np.minimum(1.0 - xz**2, 1.0 - yz**2) > _NOTHING_LEFT
    found = (xy - xz * yz) / np.sqrt(np.where(is_left, left, 1.0))
    return np.where(is_left, np.clip(found, -1.0, 1.0), np.nan)
