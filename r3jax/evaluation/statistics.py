"""Means over scenes, seeds and views, and differences of methods, with intervals.

Intervals are percentile bootstraps (Efron 1979) at 95 %. Scenes are the fixed set that a table
names: views and seeds are resampled, scenes never.

Shape symbols used throughout:
    S  seeds      V  test views of a scene      R  resamples
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from r3jax.errors import InputError

RESAMPLES = 1000
"""Drawn for an interval unless told."""

LEVEL = (2.5, 97.5)
"""Percentiles of the resamples that bound an interval."""

Scores = Mapping[str, np.ndarray]
"""Per scene the values [S, V] of one method: row by seed, column by view of the scene's test set,
the same views in the same order for all methods."""


@dataclass(frozen=True)
class Estimate:
    """An estimate from a sample, with its interval."""

    value: float
    """Value of the sample itself; NaN where it is not defined (a constant column, ...)."""

    low: float
    """Lower end of the 95 % interval."""

    high: float
    """Upper end of the 95 % interval."""

    count: int
    """Views (pairs of values) that entered."""


def mean_over_scenes(scores: Scores, *, seed: int = 0, resamples: int = RESAMPLES) -> Estimate:
    """Computes the mean over scenes, seeds and views, with a hierarchical interval.

    Every scene weighs the same, whatever its number of views. A resample draws, in each scene, its
    seeds and (independently) its views with replacement; all drawn seeds share the same drawn
    views, as in truth (the pigeonhole bootstrap, Owen 2007, over rows and columns). With few seeds
    the interval is too narrow: it includes (S - 1) / S of the variance of seeds, and none of it
    with one seed.

    Args:
        scores: per scene [S, V]. Views that are NaN for all seeds do not count.
        seed: of the bootstrap.
        resamples: R.

    Raises:
        ValueError: no scene, a scene without values, or a view that only some seeds have.
    """
    if not scores:
        raise InputError("there is no scene to average over")
    rng = np.random.default_rng(seed)
    means: list[float] = []
    drawn, count = np.zeros(resamples), 0
    for scene in sorted(scores):  # so that the order of the mapping does not matter
        values = _known_views(scene, scores[scene])
        num_seeds, num_views = values.shape
        # How often a resample holds each seed and each view, as weights: [R, S] and [R, V].
        seeds = rng.multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), resamples)
        views = rng.multinomial(num_views, np.full(num_views, 1 / num_views), resamples)
        drawn += ((seeds @ values) * views).sum(axis=1) / values.size / len(scores)
        means.append(values.mean())
        count += num_views
    low, high = np.percentile(drawn, LEVEL)
    return Estimate(float(np.mean(means)), float(low), float(high), count)


def paired_difference(
    first: Scores, second: Scores, *, seed: int = 0, resamples: int = RESAMPLES
) -> Estimate:
    """Computes the first minus second, as `mean_over_scenes` of the differences view by view.

    All methods are evaluated on the same test views, so that differences in difficulty cancel and
    the interval is much narrower than that of either mean. Seeds are paired row by row.

    Raises:
        ValueError: other scenes, seeds or views in one than in the other.
    """
    if set(first) != set(second):
        raise InputError(f"the methods were run in {sorted(first)} and in {sorted(second)}")
    for scene in first:
        if first[scene].shape != second[scene].shape:
            raise InputError(
                f"{scene}: [seeds, views] is {first[scene].shape} for one method and "
                f"{second[scene].shape} for the other; compare the seeds and views both have"
            )
    differences = {scene: first[scene] - second[scene] for scene in first}
    return mean_over_scenes(differences, seed=seed, resamples=resamples)


def _known_views(scene: str, values: np.ndarray) -> np.ndarray:
    unknown = np.isnan(values)
    if values.ndim != 2 or unknown.all():
        raise InputError(f"{scene}: needs values [seeds, views], got shape {values.shape}")
    if np.any(unknown.any(axis=0) != unknown.all(axis=0)):
        raise InputError(f"{scene}: a view has a value for some seeds only")
    return values[:, ~unknown.any(axis=0)]
