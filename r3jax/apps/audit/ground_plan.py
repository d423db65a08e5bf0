"""Draws the capture from above: surfaces, their renderability, and where to go next.

Colors and letters are the same as in the point clouds and all other figures.
"""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke

from r3jax.apps.audit.audit import Audit
from r3jax.apps.audit.bad_regions import BLOCK, Region
from r3jax.apps.audit.diagnosis import CAUSES, NOT_KNOWN, Diagnosis
from r3jax.apps.audit.sentences import region_letter
from r3jax.captures.alignment import Alignment
from r3jax.plots import style
from r3jax.plots.pictures import floor_picture

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
