"""Figures of a benchmark's page: quality over the budget, and the response to a swept setting."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from r3jax.apps.benchmark.policy_style import OKABE_ITO, PolicyStyle, legend_below, styles_of
from r3jax.apps.benchmark.tables import full_title, groups_on_equal_terms
from r3jax.errors import InputError
from r3jax.evaluation.comparison import (
    Cell,
    check_equal_terms,
    method_name,
    methods_of,
    scenes_of,
    snapshots_of,
    view_values,
    with_short_names,
)
from r3jax.evaluation.scores import METRICS
from r3jax.plots import style

EXPLORATION = {
    "views": "views",
    "seconds": "mission clock [s]",
    "metres": "path [m]",
    "known_share": "share of the box explored",
    "mean_renderability": "mean renderability",
}
"""Quantities of a record's exploration, and their names on axes."""

_PANELS_PER_LINE = 4


def curves_of(records: Sequence[Cell]) -> list[tuple[str, list[Cell]]]:
    """Groups records that may share curves, each with the quantity on its axis.

    Groups in which no method has two snapshots have no curve, and are left out.
    """
    axes = {"views": "views", "seconds": "seconds", "meters": "metres", "metres": "metres"}
    found: list[tuple[str, list[Cell]]] = []
    for kind, axis in axes.items():
        chosen = [record for record in records if snapshot_kind([record]) == kind]
        groups = groups_on_equal_terms(chosen, one_snapshot=False)
        found += [(axis, group) for group in groups if _has_curve(group)]
    return found


def _has_curve(group: Sequence[Cell]) -> bool:
    points = {(method_name(cell), cell["scene"], cell["snapshot"]) for cell in group}
    return len(points) > len({point[:2] for point in points})


def response_figures(cells: Sequence[Cell]) -> dict[str, Figure]:
    """Draws mean PSNR against each setting that varies, a line per policy and scene, by setting.

    Of several settings the others lie in the band.

    Args:
        cells: on equal terms, of one snapshot.
    """
    short = with_short_names(cells)
    figures: dict[str, Figure] = {}
    for name in sorted({name for cell in short for name in cell["settings"]}):
        scores: dict[str, dict[str, list[float]]] = {}
        values: dict[str, object] = {}
        for cell in short:
            psnr = view_values(cell, "psnr")
            if name not in cell["settings"] or psnr is None or np.isnan(psnr).all():
                continue
            value = cell["settings"][name]
            values[repr(value)] = value
            line = scores.setdefault(f"{cell['policy']}, {cell['scene']}", {})
            line.setdefault(repr(value), []).append(float(np.nanmean(psnr)))
        if len(values) > 1:
            padded = {line: _padded([found.get(v, []) for v in values])
                      for line, found in scores.items()}  # fmt: skip
            y = "mean PSNR of the test views [dB]"
            figures[name] = sweep_figure(name, list(values.values()), padded, y)
    return figures


def _padded(rows: Sequence[Sequence[float]]) -> np.ndarray:
    width = max(map(len, rows))
    return np.array([[*row] + [np.nan] * (width - len(row)) for row in rows])


def snapshot_kind(cells: Sequence[Cell]) -> str:
    """Returns what the snapshots count: views, seconds or meters.

    Raises:
        ValueError: the kinds differ; then they are no points of one curve.
    """
    kinds = sorted({snapshot.partition(":")[0] for snapshot in snapshots_of(cells)})
    if len(kinds) > 1:
        raise InputError(f"a curve has snapshots of one kind, got {' and '.join(kinds)}")
    return kinds[0]


def values_by_seed(cells: Sequence[Cell], quantity: str) -> np.ndarray:
    """Returns a quantity of one method in one scene, [seeds, snapshots]; NaN where there is none.

    Args:
        cells: of one method and scene.
        quantity: of `EXPLORATION`, or a column of the test views, then its mean.
    """
    seeds, snapshots = sorted({cell["seed"] for cell in cells}), snapshots_of(cells)
    values = np.full((len(seeds), len(snapshots)), np.nan)
    for cell in cells:
        place = seeds.index(cell["seed"]), snapshots.index(cell["snapshot"])
        if quantity in EXPLORATION:
            values[place] = cell["exploration"][quantity]
        elif (views := view_values(cell, quantity)) is not None and not np.isnan(views).all():
            values[place] = np.nanmean(views)
    return values


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
    figure, panels = panels_of(len(scenes))
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
        raise InputError(f"no quantity {quantity!r}; there are {', '.join(titles)}")
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
            raise InputError(
                f"{name}: needs scores [{len(values)} values, seeds], got shape {found.shape}"
            )
    if chosen is not None and chosen not in values:
        raise InputError(f"{setting}={chosen} was not tried; tried were {list(values)}")
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


def panels_of(count: int, *, share: bool = False) -> tuple[Figure, list[Axes]]:
    """Makes a figure with this number of panels, in lines of four."""
    columns = min(count, _PANELS_PER_LINE)
    lines = -(-count // columns)
    figure = style.new_figure(max(5.6, 3.6 * columns), 3.2 * lines)
    grid = figure.subplots(lines, columns, squeeze=False, sharex=share, sharey=share)
    panels = list(grid.flat)
    for axes in panels[count:]:
        axes.remove()
    return figure, panels[:count]
