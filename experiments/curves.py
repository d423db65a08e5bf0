"""Areas that sum up a curve: AUSE, and quality over a budget."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sparsification:
    """Mean error of what remains when the views predicted worst are taken away one by one."""

    removed: np.ndarray
    """Share of the views removed, k / n for k = 0 ... n - 1, [n]."""

    curve: np.ndarray
    """Mean error of the others when they leave in the order of the prediction, [n]."""

    oracle: np.ndarray
    """The same when they leave in the order of their errors, [n]: no order is lower anywhere."""

    @property
    def area(self) -> float:
        """Area between the two curves (AUSE) in the error's unit: 0 for a perfect order."""
        return float(np.mean(self.curve - self.oracle))

    @property
    def relative(self) -> float:
        """`area` over that of a prediction that knows nothing: 0 perfect, 1 no better than chance.

        A random order leaves the mean error where it is, so this is mean(curve - oracle) /
        mean(curve[0] - oracle). NaN where all errors are equal: then no order is better.
        """
        chance = float(np.mean(self.curve[0] - self.oracle))
        return self.area / chance if chance > 1e-12 * (1.0 + abs(self.curve[0])) else np.nan


def sparsification(quality: np.ndarray, error: np.ndarray) -> Sparsification:
    """Removes the views (or pixels) of lowest predicted quality first: Ilg et al., ECCV 2018.

    With the n views ordered by predicted quality, worst first, and their errors e in this order,

        curve(k / n) = (e_k+1 + ... + e_n) / (n - k),     AUSE = mean over k of curve - oracle.

    Ilg et al. ("Uncertainty estimates and multi-hypotheses networks for optical flow") divide
    both curves by curve(0). A PSNR has no zero that would give this a meaning, so the area is
    kept in the error's unit here, and `relative` divides by the area of chance; for errors with a
    zero (1 - SSIM, LPIPS) theirs is `area / curve[0]`. Views of equal predicted quality leave in
    all orders at once (each has their mean error), so the result depends on no order of the
    input.

    Args:
        quality: predicted, [n], higher is better; only its order matters.
        error: what was measured, [n], lower is better: -PSNR, 1 - SSIM, LPIPS.

    Raises:
        ValueError: no views, different lengths, or a value that is not finite.
    """
    quality, error = np.asarray(quality, np.float64), np.asarray(error, np.float64)
    if quality.ndim != 1 or quality.shape != error.shape or not quality.size:
        raise ValueError(
            f"quality and error must be vectors of one length, got {quality.shape}, {error.shape}"
        )
    if not np.isfinite(quality).all() or not np.isfinite(error).all():
        raise ValueError("quality and error must be finite: leave such views out first")
    _, level = np.unique(quality, return_inverse=True)
    by_level = np.bincount(level, weights=error) / np.bincount(level)
    removed = np.arange(len(error)) / len(error)
    return Sparsification(
        removed=removed,
        curve=_mean_of_rest(by_level[np.sort(level)]),
        oracle=_mean_of_rest(np.sort(error)[::-1]),
    )


def _mean_of_rest(error: np.ndarray) -> np.ndarray:
    """Returns the mean of error[k:] for every k."""
    return np.cumsum(error[::-1])[::-1] / np.arange(len(error), 0, -1)


def area_under(
    budget: np.ndarray,
    quality: np.ndarray,
    *,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Returns the mean height of a curve between two budgets.

    Its area over the range, in quality's unit.

    The curve is piecewise linear (trapezoids); it is cut at `start` and `end` and never continued
    beyond its own ends. Curves with different ends are comparable only on `common_range`.

    Args:
        budget: views, seconds or meters of the snapshots, [k], k >= 2, increasing.
        quality: of each snapshot, [k], such as PSNR [dB].
        start: where the range starts; None: at the first snapshot.
        end: where the range ends; None: at the last snapshot.

    Raises:
        ValueError: fewer than two snapshots, not increasing, or a range the curve does not span.
    """
    x, y = np.asarray(budget, np.float64), np.asarray(quality, np.float64)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 2 or not np.all(np.diff(x) > 0.0):
        raise ValueError(
            f"needs two or more snapshots in increasing order of budget, got budgets {x.tolist()} "
            f"and {y.size} values"
        )
    low, high = (x[0] if start is None else start), (x[-1] if end is None else end)
    if not x[0] <= low < high <= x[-1]:
        raise ValueError(
            f"the curve spans {x[0]:g} to {x[-1]:g}, so it has no area from {low:g} to {high:g}; "
            "use the range that all curves share (`common_range`)"
        )
    inside = x[(x > low) & (x < high)]
    corners = np.concatenate([[low], inside, [high]])
    return float(np.trapezoid(np.interp(corners, x, y), corners) / (high - low))


def common_range(budgets: Sequence[np.ndarray]) -> tuple[float, float]:
    """Returns the widest range that every curve spans: the last start to the first end.

    Raises:
        ValueError: no curves, or they share no range.
    """
    if not budgets:
        raise ValueError("there are no curves")
    start, end = max(min(b) for b in budgets), min(max(b) for b in budgets)
    if start >= end:
        raise ValueError(
            f"the curves share no range of budgets: one starts at {start:g}, one ends at {end:g}"
        )
    return float(start), float(end)
