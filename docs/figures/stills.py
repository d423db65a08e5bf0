"""Pictures of points and lines without a browser, and the page on which such a picture stands.

Every point is a square that faces the camera, as large as its edge; the nearest one wins the
pixel. Then pixels are darkened by how far their neighbors stand out before them ("eye-dome
lighting", Boucheny 2009), which gives blocks and walls their shape without normals. The page round
it says what it shows: the view, numbers, a scale.

Shape symbols: n points; s segments; H W picture size.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from r3jax.apps.viewer.drawing import SCORES, UNSEEN, paint
from r3jax.apps.viewer.story import title_of
from r3jax.geometry.cameras import Camera, look_at
from r3jax.runs.reader import Run

NEAR = 0.05
"""What is closer is not drawn [m]."""

_PIXELS_AT_A_TIME = 1 << 21
_LARGEST = 48
"""Side of a square at most [px]: a point before the lens must not cover the picture."""

_EMPTY = np.uint64(0xFFFFFFFFFFFFFFFF)

_REACHES = (1, 2)
"""Distances of the neighbors that may take light from a pixel [px]."""

_FULL_STEP = 0.012
"""A neighbor nearer by this, as the logarithm (base 2) of depths, takes all that it can."""

_SPACING = 0.01
"""Distance between the squares along a line [m]."""

_MOST_DOTS = 300_000
"""Squares of all lines drawn alike; longer ones get fewer a meter."""

_MARGIN = 0.94
"""Share of the picture that an overview fills."""


@dataclass(frozen=True)
class Squares:
    """Points that are drawn alike."""

    points: np.ndarray
    """[n, 3] [m], world."""

    colors: np.ndarray
    """[n, 3] uint8."""

    edge: float
    """Side of a square in the world [m]."""

    least: float = 1.0
    """Side of a square in the picture at least [px]."""

    lift: float = 0.0
    """Drawn as if closer to the camera by this [m], so that lines are not lost in walls."""

    shaded: bool = True
    """Whether depth darkens it; lines keep their colors."""


def draw(
    camera: Camera,
    T_world_camera: np.ndarray,
    layers: Sequence[Squares],
    background: tuple[int, int, int] = (255, 255, 255),
    strength: float = 1.4,
) -> np.ndarray:
    """Returns a picture, [H, W, 3] uint8.

    Args:
        camera: intrinsics and size.
        T_world_camera: pose, [4, 4].
        layers: what to draw; nearer squares hide farther ones, whatever the order.
        background: color behind everything.
        strength: of the shading by depth; 0: none.
    """
    height, width = camera.height, camera.width
    keys = np.full(height * width, _EMPTY)
    begin = 0
    for layer in layers:
        _splat(keys, camera, np.asarray(T_world_camera, np.float64), layer, begin)
        begin += len(layer.points)
    is_hit = keys != _EMPTY
    item = np.where(is_hit, keys & np.uint64(0xFFFFFFFF), 0).astype(np.intp)
    depth = np.where(is_hit, keys >> np.uint64(32), 0).astype(np.uint32).view(np.float32)
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(x.colors for x in layers)])
    shaded = np.concatenate(
        [np.zeros(0, bool), *(np.full(len(x.points), x.shaded) for x in layers)]
    )
    picture = np.empty((height * width, 3), np.float32)
    picture[:] = background
    picture[is_hit] = colors[item[is_hit]]
    light = _light(depth.reshape(height, width), is_hit.reshape(height, width), strength)
    is_shaded = is_hit.copy()
    is_shaded[is_hit] = shaded[item[is_hit]]
    picture[is_shaded] *= light.reshape(-1)[is_shaded, None]
    return np.rint(picture).astype(np.uint8).reshape(height, width, 3)


def _splat(keys: np.ndarray, camera: Camera, pose: np.ndarray, layer: Squares, begin: int) -> None:
    """Puts a layer's squares into the depth buffer: depth in the high bits, number in the low."""
    in_camera = (np.asarray(layer.points, np.float64) - pose[:3, 3]) @ pose[:3, :3]
    ahead = np.flatnonzero(in_camera[:, 2] > NEAR)
    x, y, z = in_camera[ahead].T
    half = 0.5 * np.clip(layer.edge * float(camera.focal) / z, max(layer.least, 1.0), _LARGEST)
    left, right = _covered(float(camera.fx) * x / z + float(camera.cx), half, camera.width)
    top, bottom = _covered(float(camera.fy) * y / z + float(camera.cy), half, camera.height)
    across, down = np.maximum(right - left + 1, 0), np.maximum(bottom - top + 1, 0)
    drawn = np.flatnonzero((across > 0) & (down > 0))
    left, top, across, down = left[drawn], top[drawn], across[drawn], down[drawn]
    depth = np.maximum(z[drawn] - layer.lift, NEAR).astype(np.float32)
    # The bits of positive floats are in their order.
    packed = depth.view(np.uint32).astype(np.uint64) << np.uint64(32)
    packed |= (ahead[drawn] + begin).astype(np.uint64)
    ends = np.cumsum(across * down)
    start = 0
    while start < len(drawn):
        before = int(ends[start - 1]) if start else 0
        stop = int(np.searchsorted(ends, before + _PIXELS_AT_A_TIME, side="right"))
        stop = max(start + 1, stop)
        count = across[start:stop] * down[start:stop]
        number = np.repeat(np.arange(start, stop), count)
        place = np.arange(len(number)) - np.repeat(ends[start:stop] - count - before, count)
        row = top[number] + place // across[number]
        column = left[number] + place % across[number]
        np.minimum.at(keys, row * camera.width + column, packed[number])
        start = stop


def _covered(middle: np.ndarray, half: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last pixel whose center lies within `half` of `middle`, inside the picture."""
    # What lies far outside must not overflow when it becomes a whole number.
    middle = middle.clip(-2.0 * _LARGEST, size + 2.0 * _LARGEST)
    first = np.ceil(middle - half - 0.5).astype(np.int64)
    last = np.floor(middle + half - 0.5).astype(np.int64)
    return np.maximum(first, 0), np.minimum(last, size - 1)


def _light(depth: np.ndarray, is_hit: np.ndarray, strength: float) -> np.ndarray:
    """Returns how much light each pixel keeps, [H, W] in (0, 1].

    Less where its neighbors are nearer.
    """
    level = np.where(is_hit, np.log2(np.where(is_hit, depth, 1.0)), 1e3).astype(np.float32)
    hidden = np.zeros(level.shape, np.float32)
    height, width = level.shape
    for reach in _REACHES:
        padded = np.pad(level, reach, mode="edge")
        for i in (0, reach, 2 * reach):
            for j in (0, reach, 2 * reach):
                step = level - padded[i : i + height, j : j + width]
                hidden += np.clip(step / _FULL_STEP, 0.0, 1.0)
    return np.exp(-strength * hidden / (8 * len(_REACHES)))


def lines(
    segments: np.ndarray, colors: np.ndarray, width: float, least: float = 2.0, lift: float = 0.05
) -> Squares:
    """Segments as rows of small squares.

    Args:
        segments: ends, [s, 2, 3] [m].
        colors: of each segment [s, 3], or one for all [3]; uint8.
        width: of the line [m].
        least: its width in the picture at least [px].
        lift: as in `Squares`.
    """
    ends = np.asarray(segments, np.float64).reshape(-1, 2, 3)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    spacing = max(_SPACING, float(length.sum()) / _MOST_DOTS)
    count = np.ceil(length / spacing).astype(np.int64) + 1
    number = np.repeat(np.arange(len(ends)), count)
    place = np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count)
    share = (place / np.maximum(count[number] - 1, 1))[:, None]
    points = ends[number, 0] * (1.0 - share) + ends[number, 1] * share
    each = np.broadcast_to(np.asarray(colors, np.uint8), (len(ends), 3))
    return Squares(points, each[number], width, least, lift, shaded=False)


def overview(
    points: np.ndarray,
    width: int,
    height: int,
    azimuth: float,
    elevation: float,
    fov: float = 32.0,
) -> tuple[Camera, np.ndarray]:
    """Returns a camera outside that has all points in view.

    Args:
        points: [n, 3] [m].
        width: of the picture [px].
        height: of the picture [px].
        azimuth: where the camera stands, from the world's x axis [deg].
        elevation: how high it stands above the horizon [deg], below 90.
        fov: horizontal field of view [deg].

    Returns:
        Intrinsics and `T_world_camera` [4, 4] float64.
    """
    camera = Camera.from_fov(width, height, fov)
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    target = 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64)
    slopes = _MARGIN * np.array([float(camera.cx / camera.fx), float(camera.cy / camera.fy)])
    pose = np.asarray(look_at(outward, np.zeros(3)), np.float64)  # turned the right way, for now
    offset = (points - target) @ pose[:3, :3]
    fitting = lambda: float((np.abs(offset[:, :2]) / slopes - offset[:, 2:]).max())
    for _ in range(4):  # what is in the middle of the picture depends on the distance
        distance = max(fitting(), NEAR)
        seen = offset[:, :2] / (offset[:, 2:] + distance)
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance
        offset[:, :2] -= middle
        target = target + pose[:3, :2] @ middle
    pose[:3, 3] = target + fitting() * outward
    return camera, pose


_INK, _MUTED, _PAPER = (31, 41, 55), (107, 114, 128), (255, 255, 255)
_LINE, _ACCENT, _NOW = (229, 231, 235), (15, 118, 110), (220, 38, 38)
_COLUMN = 320
"""Width of the column of facts [px]."""

_EDGE = 20
"""Empty space round the column [px]."""

_TITLES = {
    "renderability": "Renderability R, mean over places that see the voxel",
    "bias": "Angle term b: how near to a direction it was seen from",
    "noise": "Consistency term: do its colors agree?",
    "resolution": "Resolution term: was it seen from close enough?",
    "color": "Mean color of the voxels",
}


@dataclass(frozen=True)
class Sheet:
    """What stands beside a picture."""

    title: str
    """Policy and scene."""

    subtitle: str
    """What the colors mean."""

    image: np.ndarray
    """The view that was taken, [H, W, 3] uint8."""

    facts: tuple[tuple[str, str], ...]
    """Names and values."""

    curve: np.ndarray
    """Mean renderability after each view so far, in [0, 1]."""

    num_views: int
    """Views of the whole run: where the curve will end."""

    has_scale: bool
    """Whether the colors are those of a score."""

    @staticmethod
    def scene_width(width: int) -> int:
        """Returns what is left for the picture beside the column [px]."""
        return width - _COLUMN

    @staticmethod
    def of_run(run: Run, step: int, image: np.ndarray, quantity: str) -> "Sheet":
        """Returns the sheet of a view of a run.

        Args:
            run: the run.
            step: the view.
            image: its image, [H, W, 3] uint8.
            quantity: what the colors show, one of `drawing.QUANTITIES`.
        """
        row = run.rows[step]
        facts = (
            ("view", f"{step + 1} of {len(run.rows)}"),
            ("mission clock", f"{row.seconds:.1f} s"),
            ("path", f"{row.metres:.1f} m"),
            ("explored", f"{100 * row.coverage.known_share:.0f} %"),
            ("mean renderability", f"{row.coverage.mean_renderability:.2f}"),
            ("R before this view", f"{row.coverage.arrival_renderability:.2f}"),
        )
        curve = [r.coverage.mean_renderability for r in run.rows[: step + 1]]
        return Sheet(
            title=title_of(run.header),
            subtitle=_TITLES[quantity],
            image=image,
            facts=facts,
            curve=np.asarray(curve),
            num_views=len(run.rows),
            has_scale=quantity != "color",
        )


def compose(picture: np.ndarray, sheet: Sheet) -> np.ndarray:
    """Returns the picture with its sheet at the right, [H, W + 320, 3] uint8."""
    height, width = picture.shape[:2]
    canvas = Image.new("RGB", (width + _COLUMN, height), _PAPER)
    canvas.paste(Image.fromarray(np.ascontiguousarray(picture)), (0, 0))
    pen = ImageDraw.Draw(canvas)
    pen.text((_EDGE, 14), _cut(sheet.title, 60), fill=_INK, font=font(24))
    pen.text((_EDGE, 46), sheet.subtitle, fill=_MUTED, font=font(16))
    if sheet.has_scale:
        _scale(canvas, pen, _EDGE, height - 48)
    left, side = width, _COLUMN - _EDGE
    photo = ImageOps.pad(Image.fromarray(sheet.image), (side, side), color=_PAPER)
    canvas.paste(photo, (left, _EDGE))
    top = _EDGE + side + 16
    for name, value in sheet.facts:
        pen.text((left, top), name, fill=_MUTED, font=font(16))
        pen.text((left + side, top), value, fill=_INK, font=font(16), anchor="ra")
        top += 25
    _curve(pen, sheet, (left, top + 34, left + side - 6, height - 30))
    return np.asarray(canvas)


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Returns the letters of all pictures."""
    return ImageFont.load_default(size)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def _scale(canvas: Image.Image, pen: ImageDraw.ImageDraw, left: int, top: int) -> None:
    """The colors from 0 to 1, and that of what no place sees."""
    colors = np.repeat(paint(np.linspace(0.0, 1.0, 220), SCORES)[None], 12, axis=0)
    canvas.paste(Image.fromarray(colors), (left, top))
    for share, word, anchor in ((0.0, "0", "la"), (0.5, "0.5", "ma"), (1.0, "1", "ra")):
        pen.text((left + 220 * share, top + 15), word, fill=_MUTED, font=font(14), anchor=anchor)
    pen.rectangle([left + 250, top, left + 262, top + 11], fill=UNSEEN)
    pen.text((left + 270, top - 3), "seen from none of the places", fill=_MUTED, font=font(14))


def _curve(pen: ImageDraw.ImageDraw, sheet: Sheet, box: tuple[int, int, int, int]) -> None:
    """Mean renderability over the views, its axis from 0 to 1."""
    left, top, right, bottom = box
    pen.text((left, top - 26), "mean renderability over views", fill=_MUTED, font=font(14))
    for share in (0.0, 0.5, 1.0):
        y = bottom + (top - bottom) * share
        pen.line([(left, y), (right, y)], fill=_LINE)
    x = left + (right - left) * np.arange(len(sheet.curve)) / max(sheet.num_views - 1, 1)
    y = bottom + (top - bottom) * sheet.curve.clip(0.0, 1.0)
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    if len(points) > 1:
        pen.line(points, fill=_ACCENT, width=3, joint="curve")
    u, v = points[-1]
    pen.ellipse([u - 5, v - 5, u + 5, v + 5], fill=_NOW)
