"""Draws the figures of an audit, except the map from above."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from r3jax.apps.audit.audit import Audit, EvaluatedFrame
from r3jax.apps.audit.bad_regions import BLOCK, Region
from r3jax.apps.audit.diagnosis import known_rows
from r3jax.apps.audit.directions import Way
from r3jax.apps.audit.ground_plan import COLOR_OF_CAUSE
from r3jax.apps.audit.promise import LOSS, LOSS_RANDOM, expected
from r3jax.apps.audit.sentences import region_letter
from r3jax.apps.audit.suggest import Suggestion
from r3jax.captures.source import projected
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.plots.pictures import empty_directions, panorama_picture, show_renderability
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images

_FINE_BUFFER = 320
"""Longer side of images of the map [px]."""

_SIDE = 2.4
"""Width of a picture beside a view [inch]."""

_FILLED = 0.4
"""Minimum share of a view's pixels that the map must show; otherwise it is not recognizable."""

_NEAREST = 0.1
"""Near plane: points closer to a camera are not in its image [audit units]."""

_EMPTY = 0.93
"""Gray of pixels that show no voxel."""


def frames_figure(audit: Audit) -> Figure:
    """Draws the renderability of every frame along the path, and its histogram.

    The colors show the main cause of each frame's deficit.
    """
    figure = style.new_figure(10.0, 3.2)
    left, right = figure.subplots(1, 2, width_ratios=[2.6, 1.0], sharey=True)
    value = audit.renderability
    causes = [frame.score.cause for frame in audit.frames]
    label = "renderability R" + ("" if audit.source.is_complete else ", where known")
    style.dress(left, "Frame by frame", "frame", label)
    left.plot(value, color="#9ca3af", linewidth=1.0, zorder=1)
    colors = [COLOR_OF_CAUSE[cause] for cause in causes]
    left.scatter(np.arange(len(value)), value, c=colors, s=18, zorder=2)
    left.set_ylim(0.0, 1.0)
    handles = [
        Line2D([], [], marker="o", linestyle="none", markersize=5, color=COLOR_OF_CAUSE[cause],
               label=f"main cause: {cause}")
        for cause in dict.fromkeys(causes)
    ]  # fmt: skip
    left.legend(handles=handles, fontsize=8, frameon=False, loc="lower left", ncols=len(handles))
    style.dress(right, "Distribution", "frames")
    right.hist(value, bins=np.linspace(0.0, 1.0, 21).tolist(), orientation="horizontal",
               color=style.ACCENT, alpha=0.75)  # fmt: skip
    mean = audit.mean_renderability
    right.axhline(mean, color=style.SECOND, linewidth=1.5)
    right.annotate(f"mean {mean:.2f}", (0.98, mean), fontsize=9, ha="right",
                   xycoords=("axes fraction", "data"), va="bottom", color=style.SECOND)  # fmt: skip
    return figure


def gain_figure(audit: Audit) -> Figure:
    """Draws the share seen well enough after suggested pictures, and after random ones."""
    figure = style.new_figure(10.0, 2.7)
    axes = style.dress(figure.subplots(), "Expected gain", "pictures taken", "seen well enough [%]")
    before = audit.diagnosis.fine_share
    taken = np.arange(len(audit.plan.views) + 1)
    for shares, loss, color, label in (
        ([view.fine_after for view in audit.plan.ranked], LOSS, style.ACCENT,
         "suggested, the most useful first"),
        (audit.plan.random_fine, LOSS_RANDOM, "#9ca3af", "at random places and directions"),
    ):  # fmt: skip
        simulated = enumerate([before, *shares])
        line = 100 * np.array([expected(share, count, loss) for count, share in simulated])
        axes.plot(
            taken, line[:, 1], color=color, linewidth=2.0, marker="o", markersize=4, label=label
        )
        axes.fill_between(taken, line[:, 0], line[:, 2], color=color, alpha=0.18, linewidth=0)
    axes.set_xticks(taken)
    figure.legend(fontsize=8, frameon=False, ncols=2, loc="outside upper right")
    return figure


def panorama_strip(audit: Audit, count: int = 3) -> Figure:
    """Draws all directions from some standpoints: colors above, renderability below."""
    standpoints = audit.standpoints[:count]
    figure = style.new_figure(10.0, 2.55 * len(standpoints))
    grid = figure.subplots(len(standpoints), 2, squeeze=False)
    image = None
    for number, (line, position) in enumerate(zip(grid, standpoints, strict=True), start=1):
        pose = np.eye(4)
        pose[:3, 3] = position
        picture = panorama_picture(
            audit.seen.state, audit.seen.grid, audit.camera, pose, float(audit.config.max_range)
        )
        place = audit.survey.alignment.points_back(position[None])[0]
        where = ", ".join(f"{value:.2f}" for value in place)
        for axes, title in zip(line, (f"{number}: from ({where})", "renderability R"), strict=True):
            style.blank(axes, title)
            axes.title.set_fontsize(9)
        line[0].imshow(picture.rgb)
        image = show_renderability(line[1], picture)
    if image is not None:
        style.color_bar(figure, image, grid, shrink=0.4)
        figure.legend(handles=empty_directions(), fontsize=8, frameon=False, ncols=2,
                      loc="outside lower center")  # fmt: skip
    return figure


def view_pictures(audit: Audit, view: Suggestion, way: Way) -> list[tuple[Figure, str]]:
    """Draws pictures that help to find a view, each with its caption.

    They are the picture taken where to stand, with an arrow for the turn; the picture that shows
    most of the target, with a ring around it; and the map rendered at the view, if it shows enough.
    """
    labels = audit.source.labels
    pictures: list[tuple[Figure, str]] = []
    if audit.source.has_images:
        start = _photo(audit, way.start)
        _draw_turn(start.axes[0], way.turn)
        pictures.append((start, f"stand where {labels[way.start]} was taken"))
        if way.target is not None:
            target = _photo(audit, way.target)
            _draw_target(target.axes[0], audit, view, way.target)
            pictures.append((target, f"take the ringed surface (here in {labels[way.target]})"))
    fine = ScoringConfig(max_range=audit.config.max_range, zbuffer_size=_FINE_BUFFER)
    colors, value = _pictures(audit.seen.state, audit, view.pose, fine)
    if float(np.isfinite(value).mean()) >= _FILLED:
        pictures.append((_picture(colors), "the map so far, from this view"))
        pictures.append((_picture(value), "how well it was seen so far: red to green"))
    return pictures


def _photo(audit: Audit, index: int) -> Figure:
    """Draws an image of the capture."""
    return _picture(audit.source.read(index)[0])


def _picture(picture: np.ndarray) -> Figure:
    """Draws one image, as colors or as renderability, without a frame."""
    figure = style.new_figure(_SIDE, _SIDE * picture.shape[0] / picture.shape[1])
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.axis("off")
    if picture.ndim == 2:
        figure.set_facecolor("#e5e7eb")
        axes.imshow(picture, cmap=style.SCORE_MAP, vmin=0.0, vmax=1.0, aspect="auto")
    else:
        axes.imshow(picture, aspect="auto")
    return figure


def _draw_turn(axes: Axes, turn: float) -> None:
    """Draws an arrow toward the side to turn to [deg], longer for a larger turn."""
    if abs(turn) < 10.0:
        return
    reach = 0.12 + 0.3 * min(abs(turn), 180.0) / 180.0
    end = 0.5 - reach if turn > 0 else 0.5 + reach
    for width, color in ((7.0, "white"), (4.0, "#0284c7")):
        axes.annotate(
            "", (end, 0.5), (0.5, 0.5), xycoords="axes fraction", textcoords="axes fraction",
            arrowprops={"arrowstyle": "-|>", "linewidth": width, "color": color,
                        "mutation_scale": 18},
        )  # fmt: skip


def _draw_target(axes: Axes, audit: Audit, view: Suggestion, index: int) -> None:
    """Draws a ring around the center of a view's visible surface, in an image of the capture."""
    pose = audit.survey.alignment.poses(audit.source.poses[[index]])[0]
    centers = np.asarray(audit.seen.state.center, np.float64).T[view.shown]
    found = projected(audit.source.camera(index), pose, centers, _NEAREST)
    column, row = (np.median(values[found.is_in]) for values in (found.column, found.row))
    height, width = audit.source.read(index)[0].shape[:2]
    for thick, color in ((5.0, "white"), (2.6, "#0284c7")):
        axes.add_patch(
            Circle((float(column), float(row)), 0.22 * min(height, width), fill=False,
                   edgecolor=color, linewidth=thick)
        )  # fmt: skip


def worst_frames(audit: Audit, count: int = 4) -> list[EvaluatedFrame]:
    """Returns the frames with the lowest renderability, the worst first."""
    order = np.argsort(audit.renderability, kind="stable")
    return [audit.frames[i] for i in order[:count].tolist()]


def worst_figure(audit: Audit, count: int = 4) -> Figure:
    """Draws the worst frames: the image (or the map if there is none) above its renderability."""
    fine = ScoringConfig(max_range=audit.config.max_range, zbuffer_size=_FINE_BUFFER)
    frames = worst_frames(audit, count)
    pictures: list[tuple[np.ndarray, np.ndarray]] = []
    for frame in frames:
        state = audit.seen.state
        if audit.is_own_path:
            place = int(np.searchsorted(audit.survey.chosen, frame.index))
            state = audit.seen.without(int(audit.seen.fold_of[place]))
        colors, value = _pictures(state, audit, frame.pose, fine)
        shown = audit.source.read(frame.index)[0] if audit.is_own_path else colors
        pictures.append((shown, value))
    aspect = audit.camera.height / audit.camera.width
    figure, grid = style.picture_grid(2, count, aspect, 0.16)
    for (upper, lower), frame, (shown, value) in zip(grid.T, frames, pictures, strict=False):
        upper.imshow(shown)
        style.caption(upper, _short(frame.label))
        lower.set_facecolor("#e5e7eb")
        lower.imshow(value, cmap=style.SCORE_MAP, vmin=0.0, vmax=1.0)
        beside = "" if audit.source.is_complete else f", {100 * frame.score.judged:.0f} % known"
        said = f"R {frame.score.renderability:.2f}, {frame.score.cause}{beside}"
        style.caption(lower, said, style.INK)
    return figure


def _pictures(
    state: MapState, audit: Audit, pose: np.ndarray, config: ScoringConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Renders mean colors [h, w, 3] and renderability [h, w] (NaN elsewhere) of a view of a map."""
    seen = term_images(state, audit.camera, jnp.asarray(pose, dtype=jnp.float32), config)
    row = np.asarray(seen.row)
    is_hit = row < state.capacity
    row = np.where(is_hit, row, 0)
    is_hit &= known_rows(audit.seen.state, audit.source.is_complete)[row]
    colors = np.where(is_hit[..., None], np.asarray(state.mean).T[row], _EMPTY)
    return colors, np.where(is_hit, np.asarray(seen.value), np.nan)


def _short(name: str) -> str:
    return name if len(name) <= 24 else f"…{name[-23:]}"


_TRIED = 6
"""Maximum number of images whose depth is checked."""

_SLACK = 0.5
"""Tolerance between a region's depth and the image's depth at its pixel: beyond it the image shows
something else there [audit units]."""

_BEST_DISTANCE = 2.0
"""Distance from which an image shows a region with its surroundings [audit units]."""

_PER_LINE = 5


@dataclass(frozen=True)
class _Shown:
    """An image that shows a region."""

    index: int
    """Index of the image in the capture."""

    column: float
    """Column of the region's center in the thinned image [px]."""

    row: float
    """Row of the region's center in the thinned image [px]."""

    radius: float
    """Radius of the region [px]."""


def best_picture(audit: Audit, region: Region) -> _Shown | None:
    """Finds the image with the region near its center, at a good distance, and not occluded.

    Only depth images can show occlusion. Returns None if no image contains the region's center.
    """
    poses = audit.survey.alignment.poses(audit.source.poses[audit.survey.chosen])
    found: list[tuple[float, float, _Shown]] = []
    for index, pose in zip(audit.survey.chosen.tolist(), poses, strict=True):
        camera = audit.source.camera(index)
        (column,), (row,), (z,), (is_in,) = projected(camera, pose, region.center[None], _NEAREST)
        if not is_in:
            continue
        aside = np.hypot(column / camera.width - 0.5, row / camera.height - 0.5)
        penalty = float(aside + 0.3 * abs(np.log(z / _BEST_DISTANCE)))
        radius = 0.5 * BLOCK * float(camera.focal) / z
        found.append((penalty, float(z), _Shown(index, column, row, radius)))
    found.sort(key=lambda entry: entry[0])
    for _, z, finding in found[:_TRIED]:
        if _shows(audit, finding, z):
            return finding
    return None


def _shows(audit: Audit, finding: _Shown, z: float) -> bool:
    """Returns False if the depth image measures another surface there."""
    if not audit.source.is_dense:
        return True
    depth = audit.source.read(finding.index)[1][int(finding.row), int(finding.column)]
    return depth == 0.0 or abs(float(depth) * audit.survey.alignment.scale - z) <= _SLACK


def region_figure(audit: Audit) -> Figure | None:
    """Draws the worst regions in images of the capture; returns None if no image shows one."""
    shown = [
        (number, region, finding)
        for number, region in enumerate(audit.regions)
        if (finding := best_picture(audit, region)) is not None
    ]
    if not shown or not audit.source.has_images:
        return None
    lines = -(-len(shown) // _PER_LINE)
    aspect = audit.camera.height / audit.camera.width
    figure, grid = style.picture_grid(lines, _PER_LINE, aspect, 0.22)
    for axes, (number, region, finding) in zip(grid.flat, shown, strict=False):
        photo, _ = audit.source.read(finding.index)
        axes.imshow(photo)
        radius = min(finding.radius, 0.45 * photo.shape[0])
        color = COLOR_OF_CAUSE[region.cause]
        for width, ring in ((3.2, "white"), (1.8, color)):
            axes.add_patch(
                Circle((finding.column, finding.row), radius, fill=False, edgecolor=ring,
                       linewidth=width)
            )  # fmt: skip
        axes.set_xlim(0, photo.shape[1])
        axes.set_ylim(photo.shape[0], 0)
        axes.set_title(
            f"{region_letter(number)}: {region.cause}", fontsize=9, color=color, loc="left", pad=2,
            fontweight="bold",
        )  # fmt: skip
    return figure
