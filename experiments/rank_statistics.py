"""Rank correlations of paired columns, each with a bootstrap interval over views.

Shape symbols: n paired values, one per view; m of them without NaN; R resamples.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

from r3jax.evaluation.statistics import LEVEL, RESAMPLES, Estimate


def spearman(
    x: np.ndarray,
    y: np.ndarray,
    *,
    strata: np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Returns Spearman's rank correlation of two columns [n], with an interval over views.

    Args:
        x: one value per view.
        y: another value per view. Views where either is NaN are left out.
        strata: scene of each view, [n]: resamples then keep the number of views of each scene.
            The coefficient is that of all views together, so it also holds the differences
            between scenes; call once per scene to see what holds within them.
        seed: of the bootstrap.
        resamples: of the bootstrap.

    Raises:
        ValueError: the columns differ in length or hold fewer than 3 complete pairs.
    """
    return with_interval(_spearman, (x, y), strata=strata, seed=seed, resamples=resamples)


def kendall(
    x: np.ndarray,
    y: np.ndarray,
    *,
    strata: np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Returns Kendall's tau-b (ties counted) of two columns [n]; arguments as in `spearman`."""
    return with_interval(_kendall, (x, y), strata=strata, seed=seed, resamples=resamples)


def partial_spearman(
    x: np.ndarray,
    y: np.ndarray,
    given: Sequence[np.ndarray],
    *,
    strata: np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Returns Spearman's correlation of x and y that remains once the columns `given` are known.

    All columns become ranks; x and y are regressed on the others (least squares, with a
    constant), and the residuals' Pearson correlation is the answer. For one column z this is

        (r_xy - r_xz r_yz) / sqrt((1 - r_xz^2) (1 - r_yz^2)).

    It is NaN where `given` determines the ranks of x or y. Other arguments as in `spearman`.
    """
    return with_interval(
        lambda x, y, *given: _partial(x, y, given), (x, y, *given),
        strata=strata, seed=seed, resamples=resamples,
    )  # fmt: skip


def with_interval(
    statistic: Callable[..., float],
    columns: Sequence[np.ndarray],
    *,
    strata: np.ndarray | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Returns the any statistic of paired columns, with its percentile interval over views.

    Rows with a NaN are left out. Resamples for which the statistic is not defined are left out of
    the interval; it is NaN where the statistic itself is, or fewer than half of them are left.

    Args:
        statistic: takes the columns, each [m], in any order of the rows.
        columns: each [n].
        strata: label of each row, [n]: every resample draws as many rows of each label as there
            are. None: all rows alike.
        seed: of the bootstrap.
        resamples: R.

    Raises:
        ValueError: columns of different lengths, or fewer than 3 complete rows.
    """
    table, labels = _complete(columns, strata)
    value = statistic(*table)
    rng = np.random.default_rng(seed)
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    found = np.empty(resamples)
    for i in range(resamples):
        rows = np.concatenate([rng.choice(group, len(group)) for group in groups])
        found[i] = statistic(*table[:, rows])
    known = found[~np.isnan(found)]
    if np.isnan(value) or 2 * len(known) < resamples:
        return Estimate(float(value), np.nan, np.nan, table.shape[1])
    low, high = np.percentile(known, LEVEL)
    return Estimate(float(value), float(low), float(high), table.shape[1])


def _complete(
    columns: Sequence[np.ndarray], strata: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows without NaN, [columns, m], and their strata, [m]."""
    arrays = [np.asarray(column, dtype=np.float64) for column in columns]
    labels = np.zeros(arrays[0].shape, int) if strata is None else np.asarray(strata)
    shapes = [array.shape for array in (*arrays, labels)]
    if len(set(shapes)) != 1 or len(shapes[0]) != 1:
        raise ValueError(f"paired columns must be vectors of one length, got shapes {shapes}")
    table = np.stack(arrays)
    keep = ~np.isnan(table).any(axis=0)
    if keep.sum() < 3:
        raise ValueError(f"needs at least 3 rows without NaN, got {keep.sum()} of {table.shape[1]}")
    return table[:, keep], labels[keep]


def _is_constant(x: np.ndarray) -> bool:
    return bool(np.all(x == x[0]))


def _spearman(x: np.ndarray, y: np.ndarray) -> float:
    if _is_constant(x) or _is_constant(y):
        return np.nan
    found = stats.spearmanr(x, y)
    return float(found.statistic)  # pyright: ignore[reportAttributeAccessIssue]


def _kendall(x: np.ndarray, y: np.ndarray) -> float:
    if _is_constant(x) or _is_constant(y):
        return np.nan
    found = stats.kendalltau(x, y, variant="b")
    return float(found.statistic)  # pyright: ignore[reportAttributeAccessIssue]


def _partial(x: np.ndarray, y: np.ndarray, given: Sequence[np.ndarray]) -> float:
    ranks = stats.rankdata(np.stack([x, y, *given]), axis=1)
    ranks -= ranks.mean(axis=1, keepdims=True)
    known = ranks[2:].T
    residuals = ranks[:2].T - known @ np.linalg.lstsq(known, ranks[:2].T, rcond=None)[0]
    norms = np.linalg.norm(residuals, axis=0)
    if np.any(norms <= 1e-9 * np.linalg.norm(ranks[:2].T, axis=0)):
        return np.nan  # nothing is left but rounding
    return float(np.clip(residuals[:, 0] @ residuals[:, 1] / norms.prod(), -1.0, 1.0))
