"""Checks whether depth images and poses agree, and finds the common mistake that would explain it.

Mistakes can be detected without knowing the room: a point of one depth image must lie on a surface
seen by another, unless it is occluded. With a wrong unit, a wrong focal length, or depth along the
ray instead of z, it lies elsewhere. Each mistake in `MISTAKES` is therefore undone, with each of
its possible values, and the images are compared again. The mistake whose correction makes most
points agree is reported, if it clearly explains the contradiction. (A wrong unit is equivalent to
the unknown scale of monocular reconstruction.)

Shape symbols: n points; h, w size of an image.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from r3jax.captures.alignment import evenly_spaced
from r3jax.captures.source import lens_of, ray_lengths, taken, thinned
from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera

_TOLERANCE = 0.05
"""Surfaces this close agree, as a share of their distance: noise, edges, drift of poses."""

_POINTS, _PICTURES, _SIDE = 100, 24, 160
"""Points of each image, images, and pixels along the longer side: 50,000 comparisons."""

_FEWEST_POINTS = 400
"""Minimum number of comparisons; with fewer, the images hardly overlap."""

_SHARED = 0.1
"""Minimum share of points that other images see or see through, or the images show separate rooms:
all points are behind the walls of others."""

_RARELY = 0.05
"""With fewer points that others see through than this, for each that they see, all is right."""

_SEE_THROUGH_RATIO = 0.8
"""Points that other images see through, for each that they see: 0.01 to 0.03 in good captures, 0.4
if the poses are off by 5 cm, 1 and more if the poses belong to other images."""

_MIN_SCORE, _GAIN, _EXPLAINED = 0.3, 0.1, 0.25
"""Minimum score after undoing a mistake, minimum gain, and minimum gain as a share of the missing
score. Where the cameras are right no mistake adds more than 0.03, with noise of 1 % of the
depth, 5 mm and 0.3 degrees; a focal length 1.25 times too long takes 0.2 to 0.4 of 0.65 to 0.94."""

_CLIMBS = 4
"""Number of refinements of a size for each step."""

_SIMPLER = 0.03
"""Margin by which a mistake further down the list must explain more than one before it."""


@dataclass(frozen=True)
class DepthImage:
    """One depth image."""

    depth: np.ndarray
    """z-depth [h, w]; 0 no measurement, inf nothing within range."""

    camera: Camera
    """Its pinhole."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64, in the unit of the depth."""

    def points(self, most: int, rng: np.random.Generator) -> np.ndarray:
        """Samples points of the depth image, in the camera's frame, [n, 3]."""
        return _points(self.depth, lens_of(self.camera), most, rng)


class _Image(NamedTuple):
    """A depth image of few pixels."""

    depth: np.ndarray
    """As in `DepthImage`."""

    lens: np.ndarray
    """fx, fy, cx, cy, [4]."""

    pose: np.ndarray
    """As in `DepthImage`."""

    typical: float
    """Median depth of all images."""


def _points(depth: np.ndarray, lens: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    row, column = np.nonzero((depth > 0.0) & np.isfinite(depth))
    if len(row) > most:
        some = rng.choice(len(row), most, replace=False)
        row, column = row[some], column[some]
    z = depth[row, column].astype(np.float64)
    fx, fy, cx, cy = lens
    x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
    return z[:, None] * np.stack([x, y, np.ones_like(x)], axis=1)


def _coarser(images: Sequence[DepthImage]) -> list[_Image]:
    """Selects some of the images, and reduces their resolution."""
    out: list[_Image] = []
    for image in (images[i] for i in evenly_spaced(len(images), _PICTURES)):
        stride = max(1, -(-max(image.depth.shape) // _SIDE))
        rows, columns = (taken(side, stride) for side in image.depth.shape)
        depth = image.depth[rows[:, None], columns].astype(np.float64)
        out.append(_Image(depth, lens_of(thinned(image.camera, stride)), image.pose, 0.0))
    known = np.concatenate([x.depth[(x.depth > 0.0) & np.isfinite(x.depth)] for x in out])
    typical = float(np.median(known)) if len(known) else 1.0
    return [image._replace(typical=typical) for image in out]


class _Agreement(NamedTuple):
    """Agreement between images."""

    compared: int
    """Number of points of one image that fall within another one where that has a depth."""

    there: float
    """Share of them that lie on a surface seen by the other image."""

    through: float
    """Share of them that the other image sees through."""

    @property
    def is_clear(self) -> bool:
        """True if nothing contradicts, however much the images hide from each other."""
        return self.there >= _SHARED and self.through <= _RARELY * self.there

    @property
    def score(self) -> float:
        """Evidence for agreement less evidence against it, above 1 where it is clear.

        Hidden points are neutral: where it is clear, the evidence against it counts per point seen.
        """
        if self.is_clear:
            return 2.0 + 0.1 * self.there - self.through / self.there
        return self.there - self.through


_Undo = Callable[[_Image, np.ndarray], _Image]


@dataclass(frozen=True)
class Mistake:
    """A common mistake."""

    undo: _Undo
    """Returns the image as it would be without the mistake of a given size."""

    values: np.ndarray
    """Sizes that are tried, [k, d]."""

    steps: tuple[float, ...]
    """Steps by which the best of these is varied."""

    is_small: Callable[[np.ndarray], bool]
    """True for sizes that an audit survives; a finding on the page says so then."""

    fits: str
    """Correction of the capture, to follow *if*; may contain the size."""

    todo: str
    """What to check, or the option that helps."""


def _flipped(rows: int, columns: int) -> _Undo:
    return lambda image, _: image._replace(depth=image.depth[::rows, ::columns])


def _lens(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> _Undo:
    return lambda image, size: image._replace(lens=change(image.lens, size))


def _pose(change: Callable[[np.ndarray], np.ndarray]) -> _Undo:
    return lambda image, _: image._replace(pose=change(image.pose))


def _shifted(image: _Image, size: np.ndarray) -> _Image:
    return image._replace(lens=image.lens + np.r_[0.0, 0.0, size * image.depth.shape[1]])


def _along_axis(image: _Image, _: np.ndarray) -> _Image:
    return image._replace(depth=image.depth / ray_lengths(image.depth.shape, image.lens))


def _inverse(image: _Image, size: np.ndarray) -> _Image:
    known = (image.depth > 0.0) & np.isfinite(image.depth)
    values = np.where(known, image.depth, 1.0)
    return image._replace(depth=np.where(known, size[0] * image.typical**2 / values, 0.0))


FACTORS = np.concatenate([[1e-3, 1e-2], 1.08 ** np.arange(-30, 31), [1e2, 1e3]])
"""Depths are tried as they are and multiplied by these: 0.1 to 10, and slips of units."""

_SHIFTS = np.array([[x, y] for x in range(-2, 3) for y in range(-2, 3) if x or y]) / 10.0


def _never_small(size: np.ndarray) -> bool:
    return False


def _either_or(undo: _Undo, fits: str, todo: str) -> Mistake:
    """Creates a mistake without a size."""
    return Mistake(undo, np.zeros((1, 1)), (), _never_small, fits, todo)


MISTAKES = (
    Mistake(
        lambda image, size: image._replace(depth=size[0] * image.depth),
        FACTORS[:, None],
        (0.03,),
        lambda size: bool(0.8 < size[0] < 1.25),
        "every depth is multiplied by {0:.2g}",
        "--depth-scale {0:.2g} does that, if the unit of depth is wrong and not that of the poses "
        "(in a transforms.json: depth_unit_scale_factor)",
    ),
    _either_or(
        _along_axis,
        "depth is the distance along the ray through each pixel, and not z",
        "--depth-along-ray converts it",
    ),
    _either_or(_flipped(-1, 1), "the depth images are turned upside down", "turn them back"),
    _either_or(_flipped(1, -1), "the depth images are mirrored", "mirror them back"),
    _either_or(_flipped(-1, -1), "the depth images are turned by 180 degrees", "turn them back"),
    _either_or(
        _pose(lambda pose: pose * [1.0, -1.0, -1.0, 1.0]),
        "the y and z axes of all cameras are reversed",
        "write the poses in the camera axes of this format (OpenCV's have y down and z ahead, "
        "OpenGL's y up and z back)",
    ),
    _either_or(
        _pose(np.linalg.inv),
        "the poses are inverted",
        "write them as this format has them (camera to world, or world to camera)",
    ),
    Mistake(
        _lens(lambda lens, size: lens * [*size, 1.0, 1.0]),
        1.1 ** np.arange(-7.0, 8.0)[:, None] * [1.0, 1.0],
        (0.05, 0.02),
        lambda size: bool(np.abs(size - 1.0).max() < 0.1),
        "all focal lengths are multiplied by about {0:.2f} (along x) and {1:.2f} (along y)",
        "check the intrinsics (in a transforms.json: fl_x and fl_y)",
    ),
    Mistake(
        _lens(lambda lens, size: lens * size[0]),
        np.array([[0.25], [0.5], [0.75], [4 / 3], [2.0], [4.0]]),
        (),
        _never_small,
        "focal lengths and principal points are multiplied by {0:.2g}",
        "give the intrinsics of images of this size",
    ),
    _either_or(
        _lens(lambda lens, _: lens[[1, 0, 3, 2]]),
        "x and y of the intrinsics are exchanged",
        "give the intrinsics of images that lie as these do",
    ),
    Mistake(
        _shifted,
        _SHIFTS,
        (0.05, 0.02),
        lambda size: bool(np.abs(size).max() < 0.04),
        "all principal points are moved by about {0:+.0%} of the width along x, {1:+.0%} along y",
        "check the intrinsics (in a transforms.json: cx and cy), and whether images were cropped",
    ),
    Mistake(
        _inverse,
        1.1 ** np.arange(-24.0, 25.0)[:, None],
        (),
        _never_small,
        "depth is one over the values of the depth images",
        "convert them: they hold disparity",
    ),
)
"""The mistakes, in the order in which they are tried."""


def check_agreement(
    images: Sequence[DepthImage], neighbors: Iterable[Sequence[DepthImage]] = ()
) -> None:
    """Refuses depth images that contradict the poses, or each other.

    Images that do not overlap, or were taken from one place, are accepted: no depth is wrong there.

    Args:
        images: from all over the capture.
        neighbors: images of cameras near each other, for several places; where those from all over
            a building do not overlap, the best of these places is judged.

    Raises:
        ValueError: a common mistake explains them far better; or other images see through nearly as
            many points as they see.
    """
    pictures = _coarser(images)
    found = _compared(pictures)
    if found.there + found.through < _SHARED:
        places = [_coarser(near) for near in neighbors]
        found, pictures = max(
            [(found, pictures), *((_compared(place), place) for place in places)],
            key=lambda one: one[0].score,
        )
    if found.is_clear:
        return
    explained = _explained(pictures, found)
    if explained is not None:
        mistake, size, better = explained
        if mistake.is_small(size):
            return
        raise InputError(
            f"the depth images contradict the poses: {100 * found.there:.0f} % of what one shows "
            f"is where others see it, but {100 * better.there:.0f} % if "
            f"{mistake.fits.format(*size)}: {mistake.todo.format(*size)}; --trust-depth audits "
            "it as it is"
        )
    if found.compared >= _FEWEST_POINTS and found.through > _SEE_THROUGH_RATIO * found.there:
        raise InputError(
            f"the frames contradict each other: {100 * found.through:.0f} % of what one shows is "
            f"where others see through, and {100 * found.there:.0f} % where others see it: are "
            "the poses and the depth images of one recording, and do the axes fit? --trust-depth "
            "audits it as it is"
        )


def _explained(
    pictures: list[_Image], found: _Agreement
) -> tuple[Mistake, np.ndarray, _Agreement] | None:
    """Finds the mistake that clearly explains a contradiction, its size, and the new agreement."""
    best: tuple[Mistake, np.ndarray, _Agreement] | None = None
    overlaps = found.compared >= _FEWEST_POINTS
    score = found.score if overlaps else 0.0
    if score > 1.0 - _GAIN:
        return None
    reached = max(_MIN_SCORE, score + max(_GAIN, _EXPLAINED * (1.0 - score)))
    for mistake in MISTAKES if overlaps else MISTAKES[:1]:
        # Without the unit's mistake as many points are compared; else what agrees may be chance.
        least = (
            _FEWEST_POINTS if mistake is MISTAKES[0] else max(_FEWEST_POINTS, found.compared // 2)
        )
        tried = [_tried(pictures, mistake, size, least) for size in mistake.values]
        score, size, there = max(tried, key=lambda one: one[0])
        for step in np.repeat(mistake.steps, _CLIMBS):
            near = size + step * np.concatenate([np.eye(len(size)), -np.eye(len(size))])
            tried = [_tried(pictures, mistake, one, least) for one in near]
            score, size, there = max([(score, size, there), *tried], key=lambda one: one[0])
        if score > reached:
            best, reached = (mistake, size, there), score + _SIMPLER
    return best


def _tried(
    pictures: list[_Image], mistake: Mistake, size: np.ndarray, least: int
) -> tuple[float, np.ndarray, _Agreement]:
    found = _compared([mistake.undo(image, size) for image in pictures])
    return (found.score if found.compared >= least else -1.0), size, found


def _compared(images: Sequence[_Image]) -> _Agreement:
    """Compares each image with every other one."""
    rng = np.random.default_rng(0)
    poses = np.stack([image.pose for image in images])
    lens = np.stack([image.lens for image in images]).T[:, :, None]
    sizes = np.array([image.depth.shape for image in images])
    first = np.cumsum(sizes.prod(axis=1)) - sizes.prod(axis=1)
    depth = np.concatenate([image.depth.ravel() for image in images])
    numbers = np.zeros(3, dtype=np.int64)
    for own, image in enumerate(images):
        world = (
            _points(image.depth, image.lens, _POINTS, rng) @ image.pose[:3, :3].T
            + image.pose[:3, 3]
        )
        x, y, z = np.moveaxis((world[None] - poses[:, None, :3, 3]) @ poses[:, :3, :3], 2, 0)
        is_in = z > 0.0
        is_in[own] = False
        z = np.where(is_in, z, 1.0)
        fx, fy, cx, cy = lens
        column, row = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
        height, width = sizes.T[:, :, None]
        is_in &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
        place = np.where(is_in, first[:, None] + row * width + column, 0.0).astype(np.int64)
        seen = depth[place]
        is_in &= (seen > 0.0) & np.isfinite(seen)
        ratio = z[is_in] / seen[is_in]
        is_there = np.abs(ratio - 1.0) < _TOLERANCE
        numbers += len(ratio), is_there.sum(), (ratio <= 1.0 - _TOLERANCE).sum()
    count, there, through = (int(number) for number in numbers)
    return _Agreement(count, there / max(count, 1), through / max(count, 1))
