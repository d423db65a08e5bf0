"""Draws the figures of an audit: the capture from above, its path, panoramas and suggestions.

Colors and letters are the same as in the point clouds.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke

from r3jax.apps.audit.audit import Audit, EvaluatedFrame
from r3jax.apps.audit.diagnosis import BLOCK, CAUSES, NOT_KNOWN, Diagnosis, Region, known_rows
from r3jax.apps.audit.directions import Way
from r3jax.apps.audit.sentences import region_letter
from r3jax.apps.audit.suggest import LOSS, LOSS_RANDOM, Suggestion, expected
from r3jax.captures.alignment import Alignment
from r3jax.captures.source import projected
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.plots.pictures import (
    empty_directions,
    floor_picture,
    panorama_picture,
    show_renderability,
)
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images

COLOR_OF_CAUSE = {
    "fine": "#a7c4a0",
    "angle": style.TOO_OBLIQUE,
    "rare": "#9333ea",
    "distance": style.TOO_FAR,
    "noise": style.INCONSISTENT,
    "unseen": style.NEVER_SEEN,
    NOT_KNOWN: "#9ca3af",
}
"""Hexadecimal, by cause."""

HIDDEN = "#9ca3af"
"""Color of voxels that no standpoint sees."""


def score_colors(value: np.ndarray) -> np.ndarray:
    """Colors renderabilities [n] in [0, 1] from red over yellow to green, RGB [n, 3] uint8."""
    rgba = colormaps[style.SCORE_MAP](np.clip(value, 0.0, 1.0))
    return np.rint(255.0 * np.asarray(rgba)[..., :3]).astype(np.uint8)


def cause_colors(diagnosis: Diagnosis) -> np.ndarray:
    """Returns the color of every voxel's cause, RGB [N, 3] uint8."""
    table = np.array([_rgb(COLOR_OF_CAUSE[name]) for name in CAUSES], np.uint8)
    return np.where(
        diagnosis.is_seen[:, None], table[diagnosis.cause], np.array(_rgb(HIDDEN), np.uint8)
    )


def _rgb(color: str) -> tuple[int, int, int]:
    value = int(color.removeprefix("#"), 16)
    return value >> 16, (value >> 8) & 255, value & 255


Extent = tuple[float, float, float, float]
"""Left, right, bottom and top of a picture."""

_HEADROOM = 0.35
"""As in `floor_picture`: anything higher than this above the cameras is left out [audit units]."""

_WEDGE = 0.45
"""Length of a suggested view's field of view [audit units]."""

_TOO_NEAR = 0.35
"""Minimum distance between letters, so that they do not overlap [audit units]."""

_WIDTH = 4.2
"""Width of a map [inch]; small enough for its letters to be legible on a phone."""

LETTERED, _DARK = 5, 3
"""Maximum numbers of bad regions and of unseen places labeled on the plan, to keep it readable."""

_MARKER = 0.3
"""Width of a numbered marker [inch]."""

_PUSHES = 200

_MOST_PIXELS = 2000
"""Maximum side of the image of renderability [px]; in larger places voxels share pixels."""

_HALO = withStroke(linewidth=2.0, foreground="white")

_PALE = 0.55
"""Opacity of the white layer between the colors and the marks."""


def plan_figure(audit: Audit) -> Figure:
    """Draws a map of regions, frames and suggested views, to be read on a phone."""
    height = _height(audit)
    picture, extent = floor_picture(audit.seen.state, audit.seen.grid, height)
    figure, axes, size = _map(audit, height)
    unit = 1.0 / audit.survey.alignment.scale
    pale = _PALE + (1.0 - _PALE) * picture
    axes.imshow(pale, origin="lower", extent=_scaled(extent, unit), interpolation="nearest")
    # Coordinates are in the tables; here a person only needs a scale.
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlabel("")
    axes.set_ylabel("")
    _draw_scale(axes, audit)
    _draw_path(axes, audit, unit)
    _draw_regions(axes, audit, unit)
    _draw_views(axes, audit, unit, float(_MARKER * max(size) / _WIDTH))
    return figure


def value_figure(audit: Audit) -> Figure:
    """Draws a map of the renderability of all surfaces."""
    height = _height(audit)
    figure, axes, _ = _map(audit, height)
    unit = 1.0 / audit.survey.alignment.scale
    values, where = _value_picture(audit, height)
    image = axes.imshow(
        values.T, origin="lower", extent=_scaled(where, unit), cmap=style.SCORE_MAP, vmin=0,
        vmax=1, interpolation="nearest",
    )  # fmt: skip
    style.color_bar(figure, image, [axes], "renderability R")
    return figure


def _scaled(extent: Extent, unit: float) -> Extent:
    left, right, bottom, top = extent
    return unit * left, unit * right, unit * bottom, unit * top


def _height(audit: Audit) -> float:
    """Returns the typical height of the cameras."""
    return float(np.median([frame.pose[2, 3] for frame in audit.frames]))


def _map(audit: Audit, height: float) -> tuple[Figure, Axes, np.ndarray]:
    """Creates an empty map of the place; also returns its size [2] [audit units]."""
    low, high = _used(audit, height)
    size = high - low
    figure = style.new_figure(_WIDTH, float(np.clip(_WIDTH * size[1] / size[0] + 0.5, 3.0, 11.0)))
    axes = figure.subplots()
    labels = [ground_label(audit, axis) for axis in (0, 1)]
    style.dress(axes, "", *labels).grid(visible=False)
    unit = 1.0 / audit.survey.alignment.scale
    axes.set_xlim(unit * low[0], unit * high[0])
    axes.set_ylim(unit * low[1], unit * high[1])
    axes.set_aspect("equal")
    axes.set_facecolor("#eef0f3")
    return figure, axes, size


def ground_label(audit: Audit, axis: int) -> str:
    """Names a horizontal axis of the map, by the capture's own axis where they are parallel."""
    name = axis_name(audit.survey.alignment, axis)
    return f"{name or ('along the ground', 'across')[axis]} [{audit.survey.unit}]"


def axis_name(alignment: Alignment, axis: int) -> str | None:
    """Returns the capture's axis along an axis of the audit, such as `-z`, or None."""
    direction = alignment.rotation[axis]
    best = int(np.argmax(np.abs(direction)))
    if abs(direction[best]) < 0.9999 or np.any(alignment.origin != 0.0):
        return None
    return ("-" if direction[best] < 0.0 else "") + "xyz"[best]


def _used(audit: Audit, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns two corners of the rectangle around nearly all surfaces and all cameras.

    Each corner is [2] [audit units].
    """
    centers = _below(audit, height)[0][:, :2]
    marks = [np.stack([frame.pose[:2, 3] for frame in audit.frames])]
    marks += [view.pose[None, :2, 3] for view in audit.plan.views]
    marks.append(np.percentile(centers, [0.5, 99.5], axis=0))
    points = np.concatenate(marks)
    return points.min(axis=0) - 0.4, points.max(axis=0) + 0.4


def _below(audit: Audit, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Selects the evaluated voxels below the cut: centers [m, 3] and renderability [m]."""
    state, found = audit.seen.state, audit.diagnosis
    centers = np.asarray(state.center, np.float64).T
    is_below = found.is_seen & (centers[:, 2] < height + _HEADROOM)
    if not is_below.any():
        is_below = np.asarray(state.occupied)
    return centers[is_below], found.value[is_below]


def _value_picture(audit: Audit, height: float) -> tuple[np.ndarray, Extent]:
    """Averages renderability over columns of voxels, [x, y], NaN if empty; also returns extents."""
    centers, values = _below(audit, height)
    low, high = np.percentile(centers[:, :2], [0.2, 99.8], axis=0)
    size = max(audit.survey.voxel_size, float((high - low).max()) / _MOST_PIXELS)
    pixel = np.floor(centers[:, :2] / size).astype(np.int64)
    low, high = (np.floor(end / size).astype(np.int64) for end in (low, high))
    shape = high - low + 1
    pixel -= low
    inside = np.all((pixel >= 0) & (pixel < shape), axis=1)
    flat = np.ravel_multi_index(tuple(pixel[inside].T), tuple(shape))
    count = np.bincount(flat, minlength=int(np.prod(shape)))
    total = np.bincount(flat, weights=values[inside], minlength=int(np.prod(shape)))
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)
    corner, end = low * size, (low + shape) * size
    return mean, (corner[0], end[0], corner[1], end[1])


def _draw_scale(axes: Axes, audit: Audit) -> None:
    """Draws a scale bar, one unit of the capture long or a round multiple."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    length = 10.0 ** np.floor(np.log10(max(right - left, 1e-9) / 2.0))
    x, y = left + 0.04 * (right - left), bottom + 0.04 * (top - bottom)
    axes.plot([x, x + length], [y, y], color=style.INK, linewidth=3.0, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} {audit.survey.unit}", (x + 0.5 * length, y), (0, 4), fontsize=10,
        textcoords="offset points", ha="center", color=style.INK, path_effects=[_HALO],
    )  # fmt: skip


def _draw_path(axes: Axes, audit: Audit, unit: float) -> None:
    """Draws the evaluated frames as a line with a dot for each, colored by renderability."""
    places = unit * np.stack([frame.pose[:2, 3] for frame in audit.frames])
    ahead = np.stack([frame.pose[:2, 2] for frame in audit.frames])
    axes.plot(*places.T, color=style.INK, linewidth=0.8, alpha=0.35, zorder=2)
    axes.quiver(
        *places.T, *(0.16 * unit * ahead.T), angles="xy", scale_units="xy", scale=1.0,
        width=0.0025, color=style.INK, alpha=0.5, headwidth=0, headlength=0, headaxislength=0,
        zorder=3,
    )  # fmt: skip
    axes.scatter(
        *places.T, c=audit.renderability, cmap=style.SCORE_MAP, vmin=0.0, vmax=1.0, s=16,
        edgecolors=style.INK, linewidths=0.4, zorder=4,
    )  # fmt: skip


def _draw_regions(axes: Axes, audit: Audit, unit: float) -> None:
    """Draws bad regions as lettered circles in the color of their cause; unseen ones dotted."""
    numbered = list(enumerate(audit.all_regions))
    named = [
        *[item for item in numbered if item[1].is_known][:LETTERED],
        *[item for item in numbered if not item[1].is_known][:_DARK],
    ]
    for _, region in named:
        is_unseen = not region.is_known
        center, color = unit * region.center[:2], COLOR_OF_CAUSE[region.cause]
        radius = 0.5 * unit * BLOCK
        axes.add_patch(
            Circle(
                (center[0], center[1]),
                radius,
                facecolor="none" if is_unseen else color,
                edgecolor=color,
                alpha=0.5 if is_unseen else 0.3,
                linewidth=1.2,
                linestyle=":" if is_unseen else "-",
                zorder=3,
            )
        )
    for center, names, color in _labels(named):
        axes.annotate(
            names, tuple(unit * center), ha="center", va="center", fontsize=12,
            fontweight="bold", color=color, zorder=5, path_effects=[_HALO],
        )  # fmt: skip


def _labels(regions: list[tuple[int, Region]]) -> list[tuple[np.ndarray, str, str]]:
    """Chooses position, text and color of each label; regions above each other share one."""
    places: list[tuple[np.ndarray, str, str]] = []
    for number, region in regions:
        center = region.center[:2]
        for i, (place, names, color) in enumerate(places):
            if np.linalg.norm(place - center) < _TOO_NEAR:
                places[i] = place, f"{names} {region_letter(number)}", color
                break
        else:
            places.append((center, region_letter(number), COLOR_OF_CAUSE[region.cause]))
    return places


def apart(places: np.ndarray, least: float) -> np.ndarray:
    """Moves places [n, 2] as little as needed so that any two are about `least` apart.

    Pairs that are too close repel each other, iteratively; coincident ones separate sideways.
    """
    moved = np.array(places, dtype=np.float64)
    for _ in range(_PUSHES):
        gap = moved[:, None] - moved[None]
        distance = np.linalg.norm(gap, axis=-1)
        is_near = (distance < least) & ~np.eye(len(moved), dtype=bool)
        if not is_near.any():
            break
        order = np.sign(np.arange(len(moved))[:, None] - np.arange(len(moved))[None])
        aside = np.stack([order.astype(float), np.zeros_like(distance)], axis=-1)
        safe = np.maximum(distance, 1e-9)[..., None]
        direction = np.where(distance[..., None] > 1e-9, gap / safe, aside)
        push = np.where(is_near, 0.5 * (least - distance), 0.0)[..., None] * direction
        moved += push.sum(axis=1)
    return moved


def _draw_views(axes: Axes, audit: Audit, unit: float, least: float) -> None:
    """Draws suggested views: a wedge over the field of view, and numbers that do not overlap."""
    camera = audit.camera
    half = float(np.arctan(0.5 * camera.width / float(camera.fx)))
    eyes = np.array([view.pose[:2, 3] for view in audit.plan.views]).reshape(-1, 2)
    labels = apart(eyes, least)
    for number, (view, label) in enumerate(zip(audit.plan.views, labels, strict=True), start=1):
        eye, ahead = view.pose[:2, 3], view.pose[:2, 2]
        azimuth, level = np.arctan2(ahead[1], ahead[0]), float(np.linalg.norm(ahead))
        angles = azimuth + np.linspace(-half, half, 9)
        reach = _WEDGE * max(level, 0.35)  # shorter if the view looks up or down
        rim = eye + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        corners = unit * np.concatenate([eye[None], rim])
        axes.add_patch(
            Polygon(corners, closed=True, facecolor="#0ea5e9", edgecolor="#075985", alpha=0.65,
                    linewidth=0.9, zorder=6)
        )  # fmt: skip
        axes.annotate(
            str(number), tuple(unit * eye), tuple(unit * label), ha="center", va="center",
            fontsize=11, fontweight="bold", color="white", zorder=7,
            arrowprops={"arrowstyle": "-", "color": "#075985", "linewidth": 0.8},
            bbox={"boxstyle": "circle,pad=0.18", "facecolor": "#075985", "edgecolor": "white",
                  "linewidth": 0.8},
        )  # fmt: skip


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
