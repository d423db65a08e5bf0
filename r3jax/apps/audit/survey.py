"""A first look at some images: do they fit together, how large is the place, how fine to audit?

Do depth images and poses tell of one world? A unit that is wrong shows without knowing any room: a
point of one depth image is where another one sees a surface, unless something hides it. With
depths that are too long or too short by a factor it is elsewhere, as soon as the cameras stood
apart: so the factor that brings most points together is known from the images alone. (It is
the scale of monocular reconstruction, asked the other way round.)

Everything downstream counts in rooms: a range of 5, free cells of 0.2, a margin of 0.3. A capture
in meters with depths of a room's size stays as it is; every other is scaled so that what its
images show (95 % of the depths) lies within the range. COLMAP's models have no meters at all:
their units stay their own in all that is written, and only the audit sees them scaled.

Shape symbols: n points; h, w size of an image.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r3jax.apps.audit.alignment import Alignment, rotation_to_z, up_of
from r3jax.apps.audit.source import Source
from r3jax.apps.audit.strays import strays
from r3jax.apps.audit.vertical import Vertical, block_normals, estimated_up
from r3jax.formats.errors import FormatError
from r3jax.frame import FAR
from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import INDEX_LIMIT

FACTORS = np.concatenate([[1e-3, 1e-2], 1.08 ** np.arange(-30, 31), [1e2, 1e3]])
"""Depths are tried as they are and multiplied by these: 0.1 to 10, and slips of units."""

_TOLERANCE = 0.05
"""Surfaces that lie so close agree, as a share of their distance: noise, edges, drift of poses."""

_POINTS, _PICTURES = 100, 24
"""Taken of each image, and images taken: 50,000 comparisons for each factor."""

_FEWEST_POINTS = 400
"""Fewer comparisons say nothing: the images hardly overlap."""

_FITS = 0.9
"""Share of the points that agree where nothing needs to be explained."""

_THROUGH = 0.8
"""Points that others look through, for each that they see: 0.01 to 0.03 in good captures, 0.4 if
the poses are off by 5 cm, 1 and more if the poses belong to other images."""

_SURE = 0.2
"""A factor that brings fewer together explains nothing."""


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
        """Some of the points that it shows, in the camera's frame, [n, 3]."""
        row, column = np.nonzero((self.depth > 0.0) & np.isfinite(self.depth))
        if len(row) > most:
            some = rng.choice(len(row), most, replace=False)
            row, column = row[some], column[some]
        z = self.depth[row, column].astype(np.float64)
        x = (column + 0.5 - float(self.camera.cx)) / float(self.camera.fx)
        y = (row + 0.5 - float(self.camera.cy)) / float(self.camera.fy)
        return z[:, None] * np.stack([x, y, np.ones_like(x)], axis=1)


def check_agreement(images: Sequence[DepthImage]) -> None:
    """Refuses depth images that contradict the poses, or each other.

    Nothing is said where images do not overlap, or were taken from one place: no depth is wrong
    there.

    Raises:
        ValueError: another factor explains them far better; or nearly as many points lie where
            another image looks through them as where it sees a surface.
    """
    chosen = np.unique(np.linspace(0, len(images) - 1, _PICTURES).round().astype(int))
    pictures = _Pictures([images[i] for i in chosen])
    count, share, seen_through = pictures.compare(1.0)
    if count < _FEWEST_POINTS:
        return
    found = [(*pictures.compare(factor)[:2], factor) for factor in FACTORS.tolist()]
    best, factor = max(
        (share, factor) for number, share, factor in found if number >= _FEWEST_POINTS
    )
    is_better = best > 2.0 * share or 1.0 - share > 2.0 * (1.0 - best)
    if best > _SURE and share < _FITS and is_better and not 0.8 < factor < 1.25:
        raise ValueError(
            f"the depth images contradict the poses: {100 * share:.0f} % of what one shows is "
            f"where others see it, but {100 * best:.0f} % if every depth is multiplied by "
            f"{factor:.2g}: is the unit of depth (or of the poses) wrong? --trust-depth audits it "
            "all the same"
        )
    if seen_through > _THROUGH * share:
        raise ValueError(
            f"the frames contradict each other: {100 * seen_through:.0f} % of what one shows is "
            f"where others look through, and {100 * share:.0f} % where others see it: are the "
            "poses and the depth images of one recording, and do the axes fit? --trust-depth "
            "audits it all the same"
        )


class _Pictures:
    """Images that are compared, each with every other one."""

    def __init__(self, images: Sequence[DepthImage]):
        """Takes some points of each image."""
        rng = np.random.default_rng(0)
        self._local = [look.points(_POINTS, rng) for look in images]
        self._poses = np.stack([look.pose for look in images])
        lenses = [
            [getattr(look.camera, name) for name in ("fx", "fy", "cx", "cy")] for look in images
        ]
        self._lens = np.asarray(lenses, dtype=np.float64).T[:, :, None]
        sizes = np.array([look.depth.shape for look in images])
        self._height, self._width = sizes.T[:, :, None]
        self._first = (np.cumsum(sizes.prod(axis=1)) - sizes.prod(axis=1))[:, None]
        self._depth = np.concatenate([look.depth.ravel() for look in images]).astype(np.float64)

    def compare(self, factor: float) -> tuple[int, float, float]:
        """Compares them, all depths multiplied by a factor.

        Returns:
            Comparisons, the share of points that lie where the other image sees a surface, and
            the share that it looks through.
        """
        numbers = np.zeros(3, dtype=np.int64)
        for i, (pose, local) in enumerate(zip(self._poses, self._local, strict=True)):
            ratio = self._ratios(factor * local @ pose[:3, :3].T + pose[:3, 3], i, factor)
            is_there = np.abs(ratio - 1.0) < _TOLERANCE
            numbers += len(ratio), is_there.sum(), (ratio <= 1.0 - _TOLERANCE).sum()
        count, there, through = (int(number) for number in numbers)
        return count, there / max(count, 1), through / max(count, 1)

    def _ratios(self, world: np.ndarray, own: int, factor: float) -> np.ndarray:
        """Depths of points [n, 3] over those of the surfaces that the others show there."""
        offset = world[None] - self._poses[:, None, :3, 3]
        x, y, z = np.moveaxis(offset @ self._poses[:, :3, :3], 2, 0)
        is_in = z > 0.0
        is_in[own] = False
        z = np.where(is_in, z, 1.0)
        fx, fy, cx, cy = self._lens
        column, row = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
        is_in &= (column >= 0) & (column < self._width) & (row >= 0) & (row < self._height)
        place = np.where(is_in, self._first + row * self._width + column, 0.0).astype(np.int64)
        seen = self._depth[place]
        is_in &= (seen > 0.0) & np.isfinite(seen)
        return z[is_in] / (factor * seen[is_in])


RANGE = 5.0
"""What is farther from a camera does not count as visible [audit units]."""

MARGIN = 0.3
"""Standpoints keep this far from everything [audit units]."""

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

_LARGEST_VOXEL = 0.2 * RANGE
"""Larger ones tell no wall from the next [audit units]."""

_PIXELS = 3.0
"""A voxel at the median depth is at least this wide [px], or it is seen by chance."""

_SURVEYED = 32
"""Images that are looked at."""

_VALUES, _FEW_VALUES = 4000, 1000
"""Depths taken of each; and of each where poses may have diverged."""

_FAR_AWAY = 100.0
"""Cameras farther from the origin than this lose digits of float32 [audit units]."""

_LEAST = {"max_frames": 2, "folds": 2, "num_views": 0, "seed": 0}
"""Least values of settings that count something."""

_OPTIONS = {"num_views": "views"}
"""How the command calls a setting, where it is not the field's own name."""

_MOST_VIEWS = 200
"""A report of more is read by nobody."""

_MOST_CELLS = 1_000_000
"""Cells of the coarse grid; they become larger where a place would have more."""


@dataclass(frozen=True)
class AuditSettings:
    """What the user may decide."""

    voxel_size: float | None = None
    """Edge of a voxel [capture units]; None: from the depths."""

    max_range: float | None = None
    """What is farther does not count as visible [capture units]; None: from the depths."""

    up: str | None = None
    """Vertical of the capture: an axis such as `y` or `-y`, or three numbers with commas; None: as
    the format says, or as cameras and surfaces suggest."""

    max_frames: int = 400
    """Images that are used at most, evenly spread."""

    folds: int = 8
    """Every image is evaluated by a map that lacks one image in so many: its own among them."""

    num_views: int = 10
    """Views to suggest."""

    num_places: int = 64
    """Places at which views are looked for, at most."""

    num_standpoints: int = 24
    """Places from which every surface is evaluated: the first of the others, at most."""

    seed: int = 0
    """Seed of the random views that the suggested ones are compared with."""

    trust_depth: bool = False
    """True: depth images are taken as they are, even if they contradict the poses."""


@dataclass(frozen=True)
class Survey:
    """How a capture is audited."""

    alignment: Alignment
    """From the capture's coordinates to the audit's."""

    up: Vertical
    """The vertical, in the capture's coordinates."""

    chosen: np.ndarray
    """Indices of the images that are used, ascending."""

    strays: tuple[int, ...]
    """Images that are left out, as their poses have diverged."""

    bounds: np.ndarray
    """Box round what the images show and where they were taken, [2, 3] [audit units]."""

    voxel_size: float
    """Edge of a voxel [audit units]."""

    cell_size: float
    """Edge of a cell of the coarse grid [audit units]."""

    median_depth: float
    """Median of all that was measured [capture units]."""

    far_depth: float
    """95th percentile of all that was measured [capture units]."""

    unit: str
    """`m`, or `u` where nobody knows what a unit is."""

    doubt: str | None = None
    """How depth images and poses contradict each other, where they were to be trusted all the same;
    None: they do not, or the capture would have been refused."""

    def length(self, in_audit: float) -> float:
        """A length of the audit, in the capture's units."""
        return in_audit / self.alignment.scale


def survey_of(source: Source, settings: AuditSettings) -> Survey:
    """Looks at some images and decides.

    Raises:
        ValueError: a setting that makes no sense; depth images that contradict the poses.
        FormatError: no image has any depth; or a file is missing or broken.
    """
    _check(settings)
    count = min(len(source), settings.max_frames)
    chosen = np.unique(np.linspace(0, len(source) - 1, count).round().astype(np.int64))
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
            _check_depth(images, median)
        except ValueError as error:
            if not settings.trust_depth:
                raise
            doubt = str(error).partition(" --trust-depth")[0]
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
    least = float(np.cbrt(np.prod(bounds[1] - bounds[0]) / _MOST_CELLS))
    return Survey(
        alignment=alignment,
        up=up,
        chosen=chosen,
        strays=tuple(left_out.tolist()),
        bounds=bounds,
        voxel_size=voxel,
        cell_size=max(_CELL, 2.0 * voxel, least),
        median_depth=median,
        far_depth=far,
        unit="m" if source.is_metric else "u",
        doubt=doubt,
    )


def _check(settings: AuditSettings) -> None:
    for name in ("voxel_size", "max_range"):
        value = getattr(settings, name)
        if value is not None and not 0.0 < value < np.inf:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}")
    for name, least in _LEAST.items():
        value = getattr(settings, name)
        option = _OPTIONS.get(name, name.replace("_", "-"))
        if value < least:
            raise ValueError(f"--{option} must be at least {least}, got {value}")
    if settings.num_views > _MOST_VIEWS:
        raise ValueError(f"--views must be at most {_MOST_VIEWS}, got {settings.num_views}")


def _depth_images(source: Source, chosen: np.ndarray) -> list[DepthImage]:
    looked = chosen[np.unique(np.linspace(0, len(chosen) - 1, _SURVEYED).round().astype(int))]
    images: list[DepthImage] = []
    for i in looked.tolist():
        with suppress(FormatError):  # what cannot be read is named once all have been tried
            images.append(DepthImage(source.read(i)[1], source.camera(i), source.poses[i]))
    if not images:
        source.read(int(looked[0]))  # says why
    return images


def _measured(source: Source, images: list[DepthImage]) -> tuple[np.ndarray, np.ndarray]:
    """Some of the depths [k] and their points [k, 3], in the capture's coordinates."""
    rng = np.random.default_rng(0)
    local = [look.points(_VALUES, rng) for look in images]
    depths = np.concatenate([points[:, 2] for points in local])
    if len(depths) < 3:
        raise FormatError(Path(source.name), "no picture shows anything whose depth is known")
    world = [
        points @ look.pose[:3, :3].T + look.pose[:3, 3]
        for points, look in zip(local, images, strict=True)
    ]
    return depths, np.concatenate(world)


def _check_depth(images: list[DepthImage], median: float) -> None:
    """Refuses depth that no indoor camera measures, or that the poses contradict."""
    if median > FAR:
        raise ValueError(
            f"the median depth is {median:.4g} m: is its unit right (millimeters are 0.001 of a "
            "meter; in a transforms.json: depth_unit_scale_factor)? --trust-depth audits it all "
            "the same"
        )
    check_agreement(images)


def _range(far: float, is_metric: bool, wanted: float | None) -> float:
    """How far images show things [capture units]."""
    if wanted is not None:
        if wanted > _FARTHEST * far:
            raise ValueError(
                f"--max-range {wanted:g} is far beyond what the pictures show (95 % lies within "
                f"{far:.3g}): everything would lie in a few voxels"
            )
        return wanted
    if not is_metric:
        return 1.05 * far
    if far < _ROOM[0]:
        return _NEAR_BY * far
    return max(far, _ROOM[1])


def _strays(source: Source, chosen: np.ndarray, depth: float) -> np.ndarray:
    """Which of the chosen images have poses that diverged."""
    rng = np.random.default_rng(0)

    def points_of(number: int) -> np.ndarray:
        index = int(chosen[number])
        look = DepthImage(source.read(index)[1], source.camera(index), source.poses[index])
        return look.points(_FEW_VALUES, rng) @ look.pose[:3, :3].T + look.pose[:3, 3]

    return chosen[strays(source.poses[chosen, :3, 3], depth, points_of)]


def _up(
    source: Source, settings: AuditSettings, chosen: np.ndarray, images: Sequence[DepthImage]
) -> Vertical:
    """The vertical as it was given, as the format says, or as cameras and surfaces suggest."""
    if settings.up is not None:
        return Vertical(up_of(settings.up))
    if source.up is not None:
        return Vertical(source.up)
    dense = images if source.is_dense else []
    seen = [block_normals(look.depth, look.camera, look.pose[:3, :3]) for look in dense]
    return estimated_up(source.poses[chosen], seen)


def _check_voxel(voxel: float, bounds: np.ndarray, scale: float) -> None:
    """Refuses sizes at which a map means nothing."""
    across = float(np.abs(bounds).max()) / voxel
    if across > _MOST_ACROSS:
        raise ValueError(
            f"voxels of {voxel / scale:.3g} would be {across:.3g} voxels along an axis: choose a "
            "larger --voxel-size"
        )
    if voxel > _LARGEST_VOXEL:
        raise ValueError(
            f"voxels of {voxel / scale:.3g} are larger than a fifth of the range "
            f"({RANGE / scale:.3g}): choose a smaller --voxel-size"
        )


def _voxel_size(source: Source, settings: AuditSettings, scale: float, median: float) -> float:
    if settings.voxel_size is not None:
        return settings.voxel_size * scale
    focal = float(np.median([float(source.camera(i).focal) for i in _few(len(source))]))
    finest = _DENSE_VOXEL if source.is_dense else _SPARSE_VOXEL
    return min(max(finest, _PIXELS * median * scale / focal), _LARGEST_VOXEL)


def _few(count: int) -> list[int]:
    return sorted({0, count // 2, count - 1})
