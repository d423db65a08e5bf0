"""Surveys some images: checks their consistency, and chooses scale, bounds and voxel size.

All later stages assume the scale of a room: a range of 5, free cells of 0.2, a margin of 0.3. A
capture in meters with depths of a room's size is not scaled; every other is scaled so that 95 % of
its depths lie within the range. COLMAP's models have no metric scale: all output keeps their own
units, and only the audit scales them.

Diverged poses are left out. Lost tracking, a GPS glitch, or a diverging bundle adjustment can put a
camera kilometers away, and a map of everything would be almost empty. Cameras are linked if they
are within a few extents of the capture of each other; the largest group is the capture. One or two
cameras outside of it have diverged, unless they show the same surfaces as others: an overview of an
object from far away. A second room has more cameras, and is kept.

Shape symbols: n poses; k depths or points.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from r3jax.captures.agreement import DepthImage, check_agreement
from r3jax.captures.alignment import Alignment, evenly_spaced, rotation_to_z, up_of
from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import Source
from r3jax.captures.vertical import USED_POSES, Vertical, block_normals, estimated_up, upright
from r3jax.errors import InputError
from r3jax.formats.errors import FormatError
from r3jax.frame import FAR
from r3jax.geometry.voxels import INDEX_LIMIT

_APART = 5.0
"""Maximum distance between linked cameras, in extents of the capture."""

_GROUP = 2
"""Maximum size of a diverged group of cameras; larger groups are separate places."""

_COMPARED = 24
"""Maximum number of pictures of the other cameras that are read."""

_SAME = 0.1
"""Surfaces this close count as one, as a share of their distance from the camera."""

_COMMON = 0.3
"""Minimum share of a camera's points that other cameras must also show."""

_SMALLEST = 0.02
"""All of it lies within this share of the camera's distance: a dot, in which nothing is seen."""


def strays(cameras: np.ndarray, depth: float, points_of: Callable[[int], np.ndarray]) -> np.ndarray:
    """Finds the cameras whose poses have diverged.

    Args:
        cameras: positions, [n, 3].
        depth: a typical depth, in the same units.
        points_of: reads the points in the picture of a camera, [k, 3] in the same coordinates.

    Returns:
        Indices of these cameras, ascending; empty if no group contains most cameras.
    """
    from_middle = np.linalg.norm(cameras - np.median(cameras, axis=0), axis=1)
    group = _groups(cameras, _APART * (float(np.median(from_middle)) + 2.0 * depth))
    sizes = np.bincount(group)
    main = int(np.argmax(sizes))
    alone = np.flatnonzero((sizes <= _GROUP)[group])
    if 2 * sizes[main] <= len(cameras) or not len(alone):
        return alone[:0]
    others = np.flatnonzero(group == main)
    others = others[evenly_spaced(len(others), _COMPARED)]
    shown = np.concatenate([points_of(i) for i in others.tolist()])
    tree = KDTree(shown)
    shares = [_shares(cameras[i], points_of(i), tree) for i in alone.tolist()]
    return alone[~np.array(shares)]


def _groups(cameras: np.ndarray, reach: float) -> np.ndarray:
    """Labels the group of each camera, [n]: groups are connected by steps within reach."""
    steps = KDTree(cameras).query_pairs(reach, output_type="ndarray")
    links = (np.ones(len(steps), dtype=bool), (steps[:, 0], steps[:, 1]))
    count = len(cameras)
    return connected_components(sparse.coo_matrix(links, (count, count)), directed=False)[1]


def _shares(camera: np.ndarray, shown: np.ndarray, tree: KDTree) -> bool:
    """Returns True if a camera shows the same surfaces as others, at a sufficient size."""
    if not len(shown) or not tree.n:
        return False
    distance = np.linalg.norm(shown - camera, axis=1)
    apart, _ = tree.query(shown)
    size = float(np.linalg.norm(shown.std(axis=0)))
    is_common = float((apart < _SAME * distance).mean()) >= _COMMON
    return is_common and size > _SMALLEST * float(np.median(distance))


RANGE = 5.0
"""Range: surfaces farther from a camera do not count as visible [audit units]."""

MARGIN = 0.3
"""Standpoints keep this far from everything [audit units]."""

_NEAREST, _TYPICAL = 0.01, 2.0
"""Median depths of captures in meters: of no camera it is less, and of rooms about this [m]."""

_ONE_PLACE = 0.1
"""Cameras within this share of the median depth saw each surface from one direction: 6 degrees."""

_ROOM = (2.0, 5.0)
"""Depths (95th percentile) of captures in meters that are rooms [m]."""

_FARTHEST = 20.0
"""Largest range that makes sense [median depths]."""

_NEAR_BY = 2.5
"""Range of smaller captures, in depths: objects on a table have space round them."""

_DENSE_VOXEL, _SPARSE_VOXEL, _CELL = 0.05, 0.1, 0.2
"""Edges [audit units]. Sparse points lie farther apart: with finer voxels walls have gaps."""

_MOST_ACROSS = INDEX_LIMIT // 2
"""Voxels along an axis: an index has 21 bits."""

LARGEST_VOXEL = 0.2 * RANGE
"""Maximum voxel size that separates one wall from the next [audit units]."""

_PIXELS = 3.0
"""A voxel at the median depth is at least this wide [px], or it is seen by chance."""

_SURVEYED = 32
"""Maximum number of images examined."""

_VALUES, _FEW_VALUES = 4000, 1000
"""Depths taken of each; and of each where poses may have diverged."""

_FAR_AWAY = 100.0
"""Cameras farther from the origin than this lose digits of float32 [audit units]."""

_MOST_CELLS = 1_000_000
"""Cells of the coarse grid; they become larger where a place would have more."""


@dataclass(frozen=True)
class Survey:
    """Coordinates, scale and selected images for an audit."""

    alignment: Alignment
    """Transform from the capture's coordinates to the audit's."""

    up: Vertical
    """The vertical, in the capture's coordinates."""

    chosen: np.ndarray
    """Indices of the images that are used, ascending."""

    strays: tuple[int, ...]
    """Indices of images that are left out because their poses have diverged."""

    bounds: np.ndarray
    """Box around all visible surfaces and cameras, [2, 3] [audit units]."""

    voxel_size: float
    """Voxel size [audit units]."""

    cell_size: float
    """Edge of a cell of the coarse grid [audit units]."""

    median_depth: float
    """Median of all depths [capture units]."""

    far_depth: float
    """95th percentile of all depths [capture units]."""

    span: float
    """Twice the distance of the farthest camera from the median of all [capture units]."""

    unit: str
    """`m`, or `u` where the scale is unknown."""

    doubt: str | None = None
    """How depth images and poses contradict each other, where they were to be trusted anyway;
    None: they do not, or the capture would have been refused."""

    @property
    def is_one_place(self) -> bool:
        """True if surfaces were seen from one direction each: a tripod, a panorama head."""
        return self.span < _ONE_PLACE * self.median_depth

    def with_voxels(self, size: float) -> "Survey":
        """Returns the survey with another voxel size [audit units], and cells that fit it."""
        cell = max(self.cell_size, 2.0 * size)
        bounds = on_lattice(self.bounds, cell)
        return replace(self, voxel_size=size, cell_size=cell, bounds=bounds)

    def length(self, in_audit: float) -> float:
        """Converts a length of the audit to the capture's units."""
        return in_audit / self.alignment.scale


def survey_of(source: Source, settings: SurveySettings) -> Survey:
    """Surveys a capture from some of its images.

    Raises:
        ValueError: a setting is invalid, or depth images contradict the poses.
        FormatError: no image has any depth, or a file is missing or broken.
    """
    chosen = source.some(settings.max_frames)
    images = _depth_images(source, chosen)
    depths, points = _measured(source, images)
    if len(left_out := _strays(source, chosen, float(np.median(depths)))):
        chosen = np.setdiff1d(chosen, left_out)
        images = _depth_images(source, chosen)
        depths, points = _measured(source, images)
    median, far = (float(v) for v in np.percentile(depths, [50.0, 95.0]))
    doubt = None
    if source.is_dense:
        try:
            _check_depth(images, median, _neighbors(source, chosen))
        except ValueError as error:
            if not settings.trust_depth:
                raise
            doubt = str(error).partition("--trust-depth")[0].rstrip(" ;") + "."
    scale = RANGE / _range(far, source.is_metric, settings.max_range)
    cameras = source.poses[chosen, :3, 3]
    is_near = float(np.abs(cameras).max()) * scale < _FAR_AWAY
    origin = np.zeros(3) if is_near else np.median(cameras, axis=0)
    up = _up(source, settings, chosen, images)
    alignment = Alignment(rotation_to_z(up.direction), scale, origin)
    low, high = np.percentile(alignment.points(points), [0.5, 99.5], axis=0)
    stood = alignment.points(cameras)
    low, high = np.minimum(low, stood.min(axis=0)), np.maximum(high, stood.max(axis=0))
    bounds = np.stack([low - 2 * MARGIN, high + 2 * MARGIN])
    voxel = _voxel_size(source, settings, scale, median)
    _check_voxel(voxel, bounds, scale)
    gap = cameras - np.median(cameras, axis=0)
    least = float(np.cbrt(np.prod(bounds[1] - bounds[0]) / _MOST_CELLS))
    cell = max(_CELL, 2.0 * voxel, least)
    return Survey(
        alignment=alignment,
        up=up,
        chosen=chosen,
        strays=tuple(left_out.tolist()),
        bounds=on_lattice(bounds, cell),
        voxel_size=voxel,
        cell_size=cell,
        median_depth=median,
        far_depth=far,
        span=2.0 * float(np.linalg.norm(gap, axis=1).max()),
        unit="m" if source.is_metric else "u",
        doubt=doubt,
    )


def on_lattice(bounds: np.ndarray, cell_size: float) -> np.ndarray:
    """Extends a box [2, 3] to whole cells counted from the origin.

    Grids of the same place then have the same cells, whatever else they contain: a doorway is as
    wide in the audit of a capture as it was on the page that was shown during the scan.
    """
    low, high = bounds / cell_size
    return cell_size * np.stack([np.floor(low), np.ceil(high)])


def _depth_images(source: Source, chosen: np.ndarray) -> list[DepthImage]:
    looked = source.some(_SURVEYED, chosen)
    images: list[DepthImage] = []
    for i in looked.tolist():
        with suppress(FormatError):  # what cannot be read is named once all have been tried
            images.append(DepthImage(source.read(i)[1], source.camera(i), source.poses[i]))
    if not images:
        source.read(int(looked[0]))  # says why
    return images


def _measured(source: Source, images: list[DepthImage]) -> tuple[np.ndarray, np.ndarray]:
    """Draws some of the depths [k] and their points [k, 3], in the capture's coordinates."""
    rng = np.random.default_rng(0)
    local = [look.points(_VALUES, rng) for look in images]
    depths = np.concatenate([points[:, 2] for points in local])
    if len(depths) < 3:
        raise FormatError(
            Path(source.name),
            "no picture shows a surface of known depth: depth is empty, or the points lie outside "
            "of all images, so intrinsics (principal point, size) or poses are of other images",
        )
    world = [
        points @ look.pose[:3, :3].T + look.pose[:3, 3]
        for points, look in zip(local, images, strict=True)
    ]
    return depths, np.concatenate(world)


def _neighbors(source: Source, chosen: np.ndarray) -> Iterator[list[DepthImage]]:
    """Reads images of cameras near each other, at three places of a capture that has more."""
    if len(source) <= _SURVEYED:
        return
    eyes = source.poses[:, :3, 3]
    for middle in chosen[evenly_spaced(len(chosen), 5)[1:-1]]:
        near = np.argsort(np.linalg.norm(eyes - eyes[middle], axis=1))[: 2 * _COMPARED]
        yield _depth_images(source, np.sort(near))


def _check_depth(
    images: list[DepthImage], median: float, neighbors: Iterator[list[DepthImage]]
) -> None:
    """Refuses depth that is implausible for an indoor camera, or contradicts the poses."""
    if not _NEAREST < median < FAR:
        factor = 10.0 ** round(np.log10(_TYPICAL / median))
        raise InputError(
            f"the median depth is {median:.4g} m: check its unit; --depth-scale {factor:g} "
            f"multiplies by {factor:g} (in a transforms.json: depth_unit_scale_factor); "
            "--trust-depth audits it as it is"
        )
    check_agreement(images, neighbors)


def _range(far: float, is_metric: bool, wanted: float | None) -> float:
    """Chooses the distance up to which images are used [capture units]."""
    if wanted is not None:
        if wanted > _FARTHEST * far:
            raise InputError(
                f"--max-range {wanted:g} is far beyond the depths in the pictures (95 % within "
                f"{far:.3g}), so everything would lie in a few voxels: give a smaller --max-range"
            )
        return wanted
    if not is_metric:
        return 1.05 * far
    if far < _ROOM[0]:
        return _NEAR_BY * far
    return max(far, _ROOM[1])


def _strays(source: Source, chosen: np.ndarray, depth: float) -> np.ndarray:
    """Finds the chosen images whose poses have diverged."""
    rng = np.random.default_rng(0)

    def points_of(number: int) -> np.ndarray:
        index = int(chosen[number])
        look = DepthImage(source.read(index)[1], source.camera(index), source.poses[index])
        return look.points(_FEW_VALUES, rng) @ look.pose[:3, :3].T + look.pose[:3, 3]

    return chosen[strays(source.poses[chosen, :3, 3], depth, points_of)]


def _up(
    source: Source, settings: SurveySettings, chosen: np.ndarray, images: Sequence[DepthImage]
) -> Vertical:
    """Chooses the vertical: as given, as in the format, or as cameras and surfaces suggest."""
    if settings.up is not None:
        return Vertical(up_of(settings.up))
    if source.up is not None:
        return Vertical(source.up)
    dense = images if source.is_dense else []
    seen = [block_normals(look.depth, look.camera, look.pose[:3, :3]) for look in dense]
    poses = source.poses[chosen]
    if source.top is not None:
        few = evenly_spaced(len(chosen), USED_POSES)
        tops = [source.top(index) for index in chosen[few].tolist()]
        poses = np.stack([upright(*each) for each in zip(poses[few], tops, strict=True)])
    return estimated_up(poses, seen)


def _check_voxel(voxel: float, bounds: np.ndarray, scale: float) -> None:
    """Refuses voxel sizes at which a map is meaningless."""
    across = float(np.abs(bounds).max()) / voxel
    if across > _MOST_ACROSS:
        raise InputError(
            f"voxels of {voxel / scale:.3g} would be {across:.3g} voxels along an axis: choose a "
            "larger --voxel-size"
        )
    if voxel > LARGEST_VOXEL:
        raise InputError(
            f"voxels of {voxel / scale:.3g} are larger than a fifth of the range "
            f"({RANGE / scale:.3g}): choose a smaller --voxel-size"
        )


def _voxel_size(source: Source, settings: SurveySettings, scale: float, median: float) -> float:
    if settings.voxel_size is not None:
        return settings.voxel_size * scale
    focal = float(np.median([float(source.camera(i).focal) for i in _few(len(source))]))
    finest = _DENSE_VOXEL if source.is_dense else _SPARSE_VOXEL
    return min(max(finest, _PIXELS * median * scale / focal), LARGEST_VOXEL)


def _few(count: int) -> list[int]:
    return sorted({0, count // 2, count - 1})
