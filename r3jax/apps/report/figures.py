"""The figures of a run. Each function makes one `matplotlib` figure from what was recorded."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from r3jax.apps.forecast.forecast import Outlook
from r3jax.apps.report.summary import map_row_bytes, stage_times
from r3jax.exploration.config import check_voxel_size
from r3jax.exploration.taken_views import StepRow, name_of, unit_of
from r3jax.formats.posed_images import PosedImages
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning.planner import Planner
from r3jax.plots import style
from r3jax.plots.pictures import floor_picture
from r3jax.runs.reader import Run
from r3jax.runs.replay import explain_run
from r3jax.runs.rows import paths_to
from r3jax.scoring.explain import CAUSES
from r3jax.scoring.renderability import renderability


@dataclass(frozen=True)
class FrameReport:
    """One frame of a recording."""

    index: int

    renderability: float
    """Renderability of the frame's view, on the map before the frame."""

    new_voxels: int
    """Number of voxels that the frame added."""

    voxels: int
    """Number of voxels in the map after the frame."""

    metres: float
    """Path of the camera so far [m]."""


def follow_recording(
    recording: PosedImages, *, voxel_size: float = 0.05, max_range: float = 5.0
) -> Iterator[tuple[FrameReport, MapState]]:
    """Integrates a recording and reports the renderability of each frame before it is mapped.

    Args:
        recording: the recording.
        voxel_size: edge of a voxel [m].
        max_range: depth beyond it is ignored [m].

    Yields:
        The report of a frame, and the map after it.

    Raises:
        ValueError: an invalid voxel size, or one above a fifth of the range.
    """
    check_voxel_size(voxel_size, max_range)
    score = jax.jit(renderability)
    state = empty_map(voxel_size=voxel_size)
    metres = 0.0
    for index, frame in enumerate(recording.frames()):
        before = float(score(state, frame.camera, frame.T_world_camera))
        known = int(state.num_occupied)
        state = integrate_growing(state, frame, max_range)
        if index > 0:
            step = recording.poses[index, :3, 3] - recording.poses[index - 1, :3, 3]
            metres += float(np.linalg.norm(step))
        voxels = int(state.num_occupied)
        yield FrameReport(index, before, voxels - known, voxels, metres), state


def revisit_figure(recording: PosedImages, reports: list[FrameReport]) -> Figure:
    """Draws the renderability before integration along the recording, and the path from above."""
    figure = style.new_figure(11.0, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1.0])
    index = np.array([report.index for report in reports])
    before = np.array([report.renderability for report in reports])
    new = np.array([report.new_voxels for report in reports])
    style.dress(left, "Renderability of each frame before it is mapped", "frame", "renderability")
    left.plot(index, before, color=style.ACCENT, linewidth=2.0, marker="o", markersize=3.5)
    left.fill_between(index, before, color=style.ACCENT, alpha=0.12, linewidth=0)
    left.set_ylim(0.0, 1.0)
    beside = left.twinx()
    beside.bar(index, new, color=style.SECOND, alpha=0.35, width=0.7)
    beside.set_ylabel("new voxels (bars)", fontsize=9, color=style.SECOND)
    beside.tick_params(labelsize=8, colors=style.MUTED, length=3)
    beside.set_ylim(0.0, 2.5 * max(1, int(new.max())))
    for side, spine in beside.spines.items():
        spine.set_visible(side == "right")
        spine.set_color("#9ca3af")
    style.dress(right, "Path from above", "x [m]", "y [m]")
    right.set_aspect("equal", adjustable="datalim")
    path = recording.poses[:, :3, 3]
    right.plot(path[:, 0], path[:, 1], color="#cbd5e1", linewidth=1.5, zorder=1)
    dots = right.scatter(
        path[: len(before), 0],
        path[: len(before), 1],
        c=before,
        cmap=style.SCORE_MAP,
        vmin=0.0,
        vmax=1.0,
        s=42,
        edgecolors=style.INK,
        linewidths=0.5,
        zorder=2,
    )
    right.annotate("start", path[0, :2], xytext=(6, 6), textcoords="offset points", fontsize=9)
    style.color_bar(figure, dots, right, "renderability", shrink=0.8)
    return figure


_DOT, _CAPTURED_DOT = 26, 8
"""Areas of the marks of views, and of frames captured while moving [pt^2]."""


def progress_figure(run: Run) -> Figure:
    """Draws coverage and mean renderability against views, or frames, and against seconds."""
    figure = style.new_figure(10.0, 5.6)
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    numbers = np.arange(1, len(run.rows) + 1)
    unit = unit_of(run.rows)
    seconds = np.array([row.seconds for row in run.rows])
    known = np.array([100.0 * row.coverage.known_share for row in run.rows])
    mean = np.array([row.coverage.mean_renderability for row in run.rows])
    arrival = np.array([row.coverage.arrival_renderability for row in run.rows])
    for column, (x, label) in enumerate([(numbers, unit), (seconds, "mission clock [s]")]):
        top = style.dress(axes[0, column], y="explored [% of the box]" if column == 0 else "")
        top.plot(x, known, color=style.ACCENT, linewidth=2.0, marker="o", markersize=2.5)
        top.set_ylim(0.0, max(10.0, 1.12 * known.max()))
        below = style.dress(axes[1, column], x=label, y="renderability" if column == 0 else "")
        below.plot(
            x, mean, color=style.ACCENT, linewidth=2.0, label="mean of probe views in free space"
        )
        below.plot(
            x,
            arrival,
            color=style.SECOND,
            linestyle="none",
            marker="o",
            markersize=3.5,
            alpha=0.8,
            label="each view just before it was mapped",
        )
        below.set_ylim(0.0, 1.0)
    axes[0, 0].set_title(f"Against {unit}", fontsize=11, loc="left", fontweight="bold")
    axes[0, 1].set_title("Against time", fontsize=11, loc="left", fontweight="bold")
    # Below the axes: inside, it would cover the curves of some runs.
    figure.legend(*axes[1, 0].get_legend_handles_labels(), fontsize=8, frameon=False, ncols=2,
                  loc="outside lower center")  # fmt: skip
    return figure


def plan_figure(run: Run, map_state: MapState, grid: OccupancyGrid) -> Figure:
    """Draws the scene from above, with the path colored by acquisition order."""
    positions = np.array([row.pose[:3, 3] for row in run.rows])
    picture, extent = floor_picture(map_state, grid, float(np.median(positions[:, 2])))
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    figure = style.new_figure(9.0, float(np.clip(9.0 * height / width, 4.0, 12.0)))
    axes = style.dress(figure.subplots(), x="x [m]", y="y [m]")
    axes.grid(visible=False)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
    _draw_path(axes, run.rows)
    dots = _draw_views(axes, run.rows)
    for place, text, offset in (
        (positions[0], "start", (-34, -16)),
        (positions[-1], "end", (8, 8)),
    ):
        axes.annotate(
            text,
            place[:2],
            xytext=offset,
            textcoords="offset points",
            fontsize=9,
            fontweight="bold",
            color=style.INK,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "alpha": 0.85, "lw": 0},
        )
    style.color_bar(figure, dots, axes, "order of acquisition", shrink=0.6)
    return figure


def _draw_path(axes: Axes, rows: Sequence[StepRow]) -> None:
    """Draws the paths from view to view in the order of acquisition."""
    segments: list[np.ndarray] = []
    colors: list[int] = []
    for row, path in zip(rows, paths_to(rows), strict=True):
        if path is not None:
            segments.append(path[:, :2])
            colors.append(row.step)
    edge = LineCollection(segments, linewidths=4.0, colors="white", capstyle="round")
    lines = LineCollection(segments, linewidths=2.0, cmap=style.PATH_MAP, capstyle="round")
    lines.set_array(np.asarray(colors, dtype=float))
    lines.set_clim(*_span(rows))
    axes.add_collection(edge)
    axes.add_collection(lines)


def _draw_views(axes: Axes, rows: Sequence[StepRow]) -> PathCollection:
    """Draws positions (smaller for frames captured while moving) and viewing directions."""
    x, y, _ = np.array([row.pose[:3, 3] for row in rows]).T
    u, v, _ = np.array([row.pose[:3, 2] for row in rows]).T
    order, (low, high) = np.arange(len(rows)), _span(rows)
    axes.quiver(
        x,
        y,
        u,
        v,
        order,
        cmap=style.PATH_MAP,
        clim=(low, high),
        angles="xy",
        scale_units="xy",
        scale=3.0,
        width=0.0028,
    )
    return axes.scatter(
        x,
        y,
        c=order,
        cmap=style.PATH_MAP,
        vmin=low,
        vmax=high,
        s=[_CAPTURED_DOT if row.captured else _DOT for row in rows],
        edgecolors="white",
        linewidths=0.8,
        zorder=3,
    )


def _span(rows: Sequence[StepRow]) -> tuple[int, int]:
    return 0, max(1, len(rows) - 1)


def cost_figure(run: Run) -> Figure:
    """Draws the step times by stage, and the memory of the map."""
    figure = style.new_figure(10.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=[1.4, 1.0])
    table = stage_times(run)
    style.dress(left, "Step times: median, and 95th percentile as a line", "time [ms]")
    names = [stage.name for stage in table]
    median = np.array([1e3 * stage.median for stage in table])
    p95 = np.array([1e3 * stage.p95 for stage in table])
    colors = [style.ACCENT if stage.on_clock else "#cbd5e1" for stage in table]
    left.barh(names, median, color=colors, height=0.62)
    left.hlines(names, np.minimum(median, p95), p95, color=style.INK, linewidth=1.4)
    left.set_xscale("log")
    left.set_xlim(left=0.5)
    left.invert_yaxis()
    left.tick_params(axis="y", labelcolor=style.INK)
    left.grid(visible=False, axis="y")
    style.dress(right, "Memory of the map", unit_of(run.rows), "memory [MB]")
    views = np.arange(1, len(run.rows) + 1)
    used = np.array([row.coverage.voxels * map_row_bytes(run) for row in run.rows]) / 1e6
    allocated = np.array([row.coverage.map_bytes for row in run.rows]) / 1e6
    right.fill_between(views, used, color=style.ACCENT, alpha=0.18, linewidth=0)
    right.plot(views, used, color=style.ACCENT, linewidth=2.0, label="rows in use")
    right.step(views, allocated, color=style.SECOND, where="post", label="allocated")
    right.set_ylim(0.0, 1.15 * allocated.max())
    # Below the axes: inside it would cover a curve, above them the title.
    handles = right.get_legend_handles_labels()
    figure.legend(*handles, fontsize=8, frameon=False, ncols=2, loc="outside lower right")
    return figure


def strip_figure(run: Run, count: int = 12) -> Figure:
    """Draws some of the recorded images, evenly spread over the run."""
    from PIL import Image

    steps = np.unique(np.linspace(0, len(run.rows) - 1, count).round().astype(int))
    columns = min(6, len(steps))
    lines = -(-len(steps) // columns)
    aspect = run.camera.height / run.camera.width
    figure, grid = style.picture_grid(lines, columns, aspect, 0.25)
    for axes, step in zip(grid.flat, steps, strict=False):
        image = Image.fromarray(run.images(int(step))[0])
        image.thumbnail((256, 256))
        axes.imshow(np.asarray(image))
        style.caption(axes, name_of(run.rows[int(step)], run.rows))
    return figure


LEVEL = 0.8
"""Level of the intervals."""

_SHOWN = (("mean", "mean of all views"), ("p10", "all but the worst tenth"))


def outlook_figure(outlook: Outlook) -> Figure:
    """Draws mean and p10 of the PSNR of free-space views, with intervals, by views taken."""
    figure = style.new_figure(10.0, 3.6)
    axes = figure.subplots()
    style.dress(
        axes, "Forecast of a model trained on the views so far", "views", "PSNR of free views [dB]"
    )
    for (name, label), color in zip(_SHOWN, (style.ACCENT, style.SECOND), strict=True):
        values = np.array([forecast.value(name) for forecast in outlook.forecasts])
        bounds = np.array([forecast.interval(name, LEVEL) for forecast in outlook.forecasts])
        axes.fill_between(outlook.views, *bounds.T, color=color, alpha=0.15, linewidth=0)
        axes.plot(outlook.views, values, color=color, marker="o", markersize=4, label=label)
    axes.legend(fontsize=9, frameon=False, loc="lower right")
    return figure


def outlook_lines(outlook: Outlook) -> list[str]:
    """Describes the last forecast, and the views that one more decibel would take, a line each."""
    last = outlook.forecasts[-1]
    if not last.mixture.size:
        return ["No free space is known yet, so there is no forecast."]
    lines: list[str] = []
    for name, label in _SHOWN:
        low, high = last.interval(name, LEVEL)
        line = f"{label} ({name}): {last.value(name):.1f} dB ({low:.1f} to {high:.1f})"
        more = outlook.more_views(name)
        if more is not None:
            line += f"; about {more} more views for +1 dB at the recent rate"
        elif len(outlook.forecasts) > 1:
            line += "; the last views added almost nothing"
        lines.append(line)
    return lines


_MANY = 60
"""From this number of views on, bars touch: gaps would be narrower than a pixel."""


def utility_by_cause(run: Run, states: Iterable[Planner] | None = None) -> np.ndarray:
    """Computes the predicted utility of each view of a run when it was chosen, by cause.

    Args:
        run: the run.
        states: as `explain_run` takes them.

    Returns:
        [views, 4] float64, in the order of `CAUSES`; NaN for views that no policy chose.

    Raises:
        RunError: as `explain_run`.
    """
    unknown = np.full(len(CAUSES), np.nan)
    rows = [unknown if reason is None else reason.totals for reason in explain_run(run, states)]
    return np.stack(rows) if rows else np.zeros((0, len(CAUSES)))


def shares_of(utility: np.ndarray) -> np.ndarray:
    """Divides each view's utility by its total, [views, 4].

    The shares are 0 if the utility is 0, and NaN if it is not known.
    """
    total = utility.sum(axis=1, keepdims=True)
    return np.where(total == 0.0, 0.0, utility / np.where(total == 0.0, 1.0, total))


def reasons_figure(utility: np.ndarray) -> Figure:
    """Draws the utility of each chosen view by cause: shares above, amounts below.

    The amounts have a logarithmic axis, as unexplored space may hide the other causes in the
    shares. Only chosen views count: the start and the frames captured while moving are left out.

    Args:
        utility: by view and cause, [views, 4]; NaN for views that no policy chose.
    """
    utility = utility[~np.isnan(utility).any(axis=1)]
    figure = style.new_figure(10.0, 5.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.6, 1.0])
    views = np.arange(1, len(utility) + 1)
    percent = 100.0 * np.nan_to_num(shares_of(utility))
    width = 1.0 if len(views) >= _MANY else 0.86
    style.dress(upper, "Causes of the utility of each chosen view", y="share of its utility [%]")
    base = np.zeros(len(views))
    for name, color, height in zip(CAUSES, style.CAUSE_COLORS, percent.T, strict=True):
        upper.bar(views, height, width, bottom=base, color=color, label=name, linewidth=0)
        base = base + height
    upper.set_ylim(0.0, 100.0)
    upper.grid(visible=False)
    figure.legend(
        *upper.get_legend_handles_labels(), fontsize=9, frameon=False, ncols=4,
        loc="outside lower center",
    )  # fmt: skip
    style.dress(lower, "Predicted utility", "chosen views, in order", "part of its utility U")
    lower.set_yscale("log")
    for color, amount in zip(
        style.CAUSE_COLORS, np.where(utility > 0.0, utility, np.nan).T, strict=True
    ):
        lower.plot(views, amount, color=color, linewidth=1.6, marker="o", markersize=2.5)
    lower.set_xlim(0.4, len(views) + 0.6)
    lower.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure
