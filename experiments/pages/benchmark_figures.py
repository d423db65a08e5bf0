"""The benchmark's curves: quality over a budget, a swept setting, and what planning costs."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from experiments.curves import EXPLORATION, snapshot_kind, values_by_seed
from experiments.pages.policy_style import (
    OKABE_ITO,
    PolicyStyle,
    legend_below,
    styles_of,
)
from r3jax.apps.benchmark.tables import full_title
from r3jax.evaluation.comparison import (
    Cell,
    check_equal_terms,
    method_name,
    methods_of,
    scenes_of,
    with_short_names,
)
from r3jax.evaluation.scores import METRICS
from r3jax.plots import style

_PANELS_PER_LINE = 4


def curve_figure(cells: Sequence[Cell], x: str = "views", y: str = "psnr") -> Figure:
    """Returns one quantity against another along the snapshots.

    A panel per scene, a line per method.

    The line joins the means over seeds of both quantities at each snapshot that all seeds of the
    method have; the band spans the lowest and the highest seed. Where x differs between seeds
    (seconds, meters), each seed is a faint point too.

    Args:
        cells: records of one kind of snapshot (`views:N`, `seconds:S` or `meters:M`).
        x: of `curves.EXPLORATION`.
        y: of `curves.EXPLORATION`, or a metric, then its mean over the test views.

    Raises:
        ValueError: records not on equal terms, several kinds of snapshots, an unknown quantity.
    """
    check_equal_terms(cells, one_snapshot=False)
    snapshot_kind(cells)
    cells = with_short_names(cells)
    scenes, styles = scenes_of(cells), styles_of(methods_of(cells))
    x_label, y_label = _label(x), _label(y)
    figure, panels = _panels(len(scenes))
    for scene, axes in zip(scenes, panels, strict=True):
        style.dress(axes, scene, x_label, y_label)
        for method, look in styles.items():
            chosen = [c for c in cells if c["scene"] == scene and method_name(c) == method]
            _draw_curve(axes, method, look, values_by_seed(chosen, x), values_by_seed(chosen, y))
    legend_below(figure, list(styles))
    return figure


def _label(quantity: str) -> str:
    titles = EXPLORATION | {metric.name: full_title(metric) for metric in METRICS}
    if quantity not in titles:
        raise ValueError(f"no quantity {quantity!r}; there are {', '.join(titles)}")
    return titles[quantity]


def _draw_curve(axes: Axes, method: str, look: PolicyStyle, x: np.ndarray, y: np.ndarray) -> None:
    known = ~np.isnan(x + y)
    complete = known.all(axis=0)
    differs = not complete.all() or np.any(x != x[:1])
    if differs:
        axes.scatter(x[known], y[known], s=10, color=look.color, alpha=0.35, linewidths=0, zorder=2)
    if not complete.any():
        return
    x, y = x[:, complete], y[:, complete]
    middle = x.mean(axis=0)
    band = axes.fill_between(middle, y.min(axis=0), y.max(axis=0), color=look.color, alpha=0.15)
    band.set_linewidth(0)
    axes.plot(middle, y.mean(axis=0), label=method, **look.line())


def sweep_figure(
    setting: str,
    values: Sequence[object],
    scores: Mapping[str, np.ndarray],
    y_label: str,
    chosen: object = None,
) -> Figure:
    """Returns what a setting is good for.

    A line per group (scene, snapshot) with its band of seeds.

    Args:
        setting: its name, on the axis.
        values: that were tried, [k]. Numbers are placed by size (on a logarithmic axis if all are
            positive and span more than a factor of 20), anything else side by side.
        scores: per group [k, seeds]; NaN where a run is missing.
        y_label: what the scores are, with their unit.
        chosen: one of the values, marked by a line.

    Raises:
        ValueError: scores of another length than the values, or a choice that was not tried.
    """
    for name, found in scores.items():
        if found.ndim != 2 or len(found) != len(values):
            raise ValueError(
                f"{name}: needs scores [{len(values)} values, seeds], got shape {found.shape}"
            )
    if chosen is not None and chosen not in values:
        raise ValueError(f"{setting}={chosen} was not tried; tried were {list(values)}")
    figure = style.new_figure(6.4, 3.9)
    axes = style.dress(figure.subplots(), x=setting, y=y_label)
    x, is_number = _places(values)
    order = np.argsort(x, kind="stable")
    for i, (name, found) in enumerate(scores.items()):
        color = OKABE_ITO[i % len(OKABE_ITO)]
        kept = order[~np.isnan(found[order]).all(axis=1)]
        y = found[kept]
        band = axes.fill_between(
            x[kept], np.nanmin(y, axis=1), np.nanmax(y, axis=1), color=color, alpha=0.15
        )
        band.set_linewidth(0)
        axes.plot(
            x[kept], np.nanmean(y, axis=1), color=color, marker="o", markersize=4.5,
            linewidth=1.8, linestyle="-" if is_number else ":", label=name,
        )  # fmt: skip
    if is_number and x.min() > 0.0 and x.max() / x.min() > 20.0:
        axes.set_xscale("log")
    if not is_number:
        axes.set_xticks(x, [str(value) for value in values])
        axes.margins(x=0.15)
    if chosen is not None:
        axes.axvline(x[list(values).index(chosen)], color=style.INK, linewidth=1.0, linestyle="--")
        axes.set_title(f"chosen: {setting} = {chosen}", fontsize=9, loc="right", color=style.MUTED)
    legend_below(figure, list(scores))
    return figure


def _places(values: Sequence[object]) -> tuple[np.ndarray, bool]:
    """Returns where each value is on the axis, and whether that is its size."""
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(numbers) == len(values):
        return np.array(numbers, dtype=np.float64), True
    return np.arange(len(values), dtype=np.float64), False


Samples = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Per method the numbers of key frames in the map [k], and what was measured there."""


def latency_figure(latency: Samples, title: str = "") -> Figure:
    """Returns milliseconds of planning against key frames: a panel per method, all on one scale.

    Line: median; band: to the 95th percentile; dotted: 99th percentile.

    Args:
        latency: milliseconds [k, repeats] per method, NaN where there are fewer repeats.
        title: above all, such as the machine.
    """
    styles = styles_of(list(latency))
    figure, panels = _panels(len(latency), share=True)
    for axes, (method, (frames, samples)) in zip(panels, latency.items(), strict=True):
        style.dress(axes, x="key frames", y="planning [ms]").label_outer()
        axes.set_title(method, fontsize=11, color=style.INK, loc="left", fontweight="bold", pad=16)
        p50, p95, p99 = np.nanpercentile(samples, [50, 95, 99], axis=1)
        color = styles[method].color
        band = axes.fill_between(frames, p50, p95, color=color, alpha=0.2, label="to p95")
        band.set_linewidth(0)
        axes.plot(frames, p50, color=color, linewidth=2.0, label="p50")
        axes.plot(frames, p99, color=color, linewidth=1.0, linestyle=":", label="p99")
        overall = [
            f"p{p} {value:.0f}" if value >= 100.0 else f"p{p} {value:.3g}"
            for p, value in zip((50, 95, 99), np.nanpercentile(samples, (50, 95, 99)), strict=True)
        ]
        axes.annotate(
            f"all: {', '.join(overall)} ms", (0.0, 1.0), xycoords="axes fraction", xytext=(0, 4),
            textcoords="offset points", fontsize=8, color=style.MUTED,
        )  # fmt: skip
    panels[0].set_yscale("log")
    panels[0].yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panels[0].yaxis.set_major_formatter("{x:g}")
    panels[0].yaxis.set_minor_locator(NullLocator())
    legend_below(figure, ["p50", "to p95", "p99"])
    figure.suptitle(title, fontsize=11, color=style.INK, fontweight="bold")
    return figure


def memory_figure(memory: Samples, title: str = "", limit: float | None = None) -> Figure:
    """Returns bytes that planning needs against key frames: a line per method.

    Args:
        memory: bytes [k] per method.
        title: what was measured (device memory, process memory).
        limit: bytes that must not be passed, as a line.
    """
    figure = style.new_figure(6.8, 4.0)
    axes = style.dress(figure.subplots(), title, "key frames", "memory [MB]")
    for method, look in styles_of(list(memory)).items():
        frames, used = memory[method]
        every = max(1, len(frames) // 12)  # markers, not beads
        axes.plot(frames, np.asarray(used) / 1e6, label=method, markevery=every, **look.line())
    if limit is not None:
        axes.axhline(limit / 1e6, color=style.INK, linewidth=1.0, linestyle="--")
        axes.annotate(
            f"{limit / 1e6:g} MB", (0.01, limit / 1e6), xycoords=("axes fraction", "data"),
            xytext=(0, 3), textcoords="offset points", fontsize=8, color=style.INK,
        )  # fmt: skip
    axes.set_ylim(0.0, 1.08 * axes.get_ylim()[1])
    legend_below(figure, list(memory))
    return figure


def _panels(count: int, *, share: bool = False) -> tuple[Figure, list[Axes]]:
    """Makes a figure with this number of panels, in lines of four."""
    columns = min(count, _PANELS_PER_LINE)
    lines = -(-count // columns)
    figure = style.new_figure(max(5.6, 3.6 * columns), 3.2 * lines)
    grid = figure.subplots(lines, columns, squeeze=False, sharex=share, sharey=share)
    panels = list(grid.flat)
    for axes in panels[count:]:
        axes.remove()
    return figure, panels[:count]
