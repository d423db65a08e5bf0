"""Figures of single views: how their quality spreads."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from r3jax.apps.benchmark.policy_style import styles_of
from r3jax.apps.benchmark.tables import full_title, metric_named
from r3jax.evaluation.comparison import (
    Cell,
    check_equal_terms,
    methods_of,
    scores_by_method,
    snapshots_of,
    with_short_names,
)
from r3jax.evaluation.scores import POOR_PSNR
from r3jax.plots import style

_RIDGE_HEIGHT = 1.5
"""Height of the highest ridge, in distances between lines: ridges may overlap by half a line."""


def density(values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Returns Gaussian kernel density of the values [n] at the grid [g]; integrates to 1.

    The kernel's width is Silverman's rule (0.9 min(deviation, IQR / 1.34) n^-1/5), and at least
    the grid's spacing, so that equal values make a narrow peak and no division by 0.
    """
    low, high = np.percentile(values, [25, 75])
    width = 0.9 * min(values.std(), (high - low) / 1.34) * len(values) ** -0.2
    width = max(width, float(grid[1] - grid[0]))
    bumps = np.exp(-0.5 * ((grid[:, None] - values) / width) ** 2)
    return bumps.mean(axis=1) / (width * np.sqrt(2.0 * np.pi))


def ridge_figure(cells: Sequence[Cell], metric: str = "psnr") -> Figure:
    """Returns the distribution of a metric over all test views.

    A panel per snapshot, a ridge per method.

    Views of all scenes and seeds are pooled. All ridges have one scale (equal areas). A tick marks
    the median, a dot the 5th percentile (LPIPS: 95th).

    Raises:
        ValueError: records not on equal terms, or no such metric.
    """
    shown = metric_named(metric)
    check_equal_terms(cells, one_snapshot=False)
    cells = with_short_names(cells)
    methods, snapshots = methods_of(cells), snapshots_of(cells)
    looks = styles_of(methods)
    pooled: dict[tuple[str, str], np.ndarray] = {}
    for snapshot in snapshots:
        scores = scores_by_method([c for c in cells if c["snapshot"] == snapshot], metric)
        for method, scenes in scores.items():
            views = np.concatenate([values.ravel() for values in scenes.values()])
            pooled[snapshot, method] = views[~np.isnan(views)]
    if not pooled:
        raise ValueError(f"no record has a value of {metric}")
    everything = np.concatenate(list(pooled.values()))
    margin = 0.08 * np.ptp(everything) + 1e-3
    grid: np.ndarray = np.linspace(everything.min() - margin, everything.max() + margin, 300)
    heights = {key: density(views, grid) for key, views in pooled.items()}
    scale = _RIDGE_HEIGHT / max(height.max() for height in heights.values())
    figure = style.new_figure(max(5.0, 3.4 * len(snapshots)), 0.62 * len(methods) + 1.6)
    panels = figure.subplots(1, len(snapshots), squeeze=False, sharex=True, sharey=True)[0]
    for axes, snapshot in zip(panels, snapshots, strict=True):
        style.dress(axes, snapshot, full_title(shown))
        axes.grid(visible=False, axis="y")
        for place, method in enumerate(reversed(methods)):
            if (snapshot, method) not in pooled:
                continue
            views, color = pooled[snapshot, method], looks[method].color
            top = place + scale * heights[snapshot, method]
            axes.fill_between(
                grid, place, top, facecolor=color, alpha=0.55, zorder=len(methods) - place + 2
            )
            axes.plot(grid, top, color=color, linewidth=1.4, zorder=len(methods) - place + 2)
            middle, tail = np.percentile(views, [50, 95 if shown.lower_is_better else 5])
            above = len(methods) + 4
            axes.vlines(middle, place, place + 0.35, color=style.INK, linewidth=1.6, zorder=above)
            axes.plot(tail, place, ".", color=style.INK, markersize=5, zorder=above)
        if metric.startswith("psnr"):
            axes.axvline(POOR_PSNR, color=style.MUTED, linewidth=0.9, linestyle="--", zorder=1)
    panels[0].set_yticks(range(len(methods)), methods[::-1])
    panels[0].set_ylim(-0.25, len(methods) - 1 + _RIDGE_HEIGHT + 0.1)
    for label in panels[0].get_yticklabels():
        label.set_color(style.INK)
    tail = 95 if shown.lower_is_better else 5
    figure.supxlabel(
        f"line: median, dot: {tail}th percentile of the views of all scenes and seeds",
        fontsize=8, color=style.MUTED,
    )  # fmt: skip
    return figure
