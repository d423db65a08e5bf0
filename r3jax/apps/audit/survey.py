"""A first look at some pictures: how large the place is, and so how fine the audit.

Everything downstream counts in rooms: a range of 5, free cells of 0.2, a margin of 0.3. A capture
in meters with depths of a room's size stays as it is; every other is scaled so that what its
pictures show (95 % of the depths) lies within the range. COLMAP's models have no meters at all:
their units stay their own in all that is written, and only the audit sees them scaled.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r3jax.apps.audit.agreement import Look, check_agreement
from r3jax.apps.audit.alignment import Alignment, estimated_up, rotation_to_z, up_of
from r3jax.apps.audit.source import Source
from r3jax.formats.errors import FormatError
from r3jax.frame import FAR
from r3jax.geometry.voxels import INDEX_LIMIT

RANGE = 5.0
"""What is farther from a camera does not count as visible [audit units]."""

MARGIN = 0.3
"""Standpoints keep this far from everything [audit units]."""

_ROOM = (2.0, 5.0)
"""Depths (95th percentile) of captures in meters that are rooms [m]."""

_FARTHEST = 20.0
"""Of a range that makes sense, in depths."""

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
"""Pictures that are looked at."""

_VALUES = 4000
"""Depths taken of each."""

_FAR_AWAY = 100.0
"""Cameras farther from the origin than this lose digits of float32 [audit units]."""

_LEAST = {"max_frames": 2, "folds": 2, "num_views": 0, "seed": 0}
"""Of wishes that count something."""

_OPTIONS = {"num_views": "views"}
"""How the command calls a wish, where it is not the field's own name."""

_MOST_VIEWS = 200
"""A report of more is read by nobody."""

_MOST_CELLS = 1_000_000
"""Cells of the coarse grid; they become larger where a place would have more."""


@dataclass(frozen=True)
class Wishes:
    """What the user may decide."""

    voxel_size: float | None = None
    """Edge of a voxel [capture units]; None: from the depths."""

    max_range: float | None = None
    """What is farther does not count as visible [capture units]; None: from the depths."""

    up: str | None = None
    """Vertical axis of the capture, such as `y` or `-y`; None: as the format or the cameras say."""

    max_frames: int = 400
    """Pictures that are used at most, evenly spread."""

    folds: int = 8
    """Every picture is judged by a map that lacks one picture in so many: its own among them."""

    num_views: int = 10
    """Views to suggest."""

    num_places: int = 64
    """Places at which views are looked for, at most."""

    num_standpoints: int = 24
    """Places from which every surface is judged: the first of the others, at most."""

    seed: int = 0
    """Of the random views that the suggested ones are compared with."""

    trust_depth: bool = False
    """True: depth images are taken as they are, even if they contradict the poses."""


@dataclass(frozen=True)
class Survey:
    """How a capture is audited."""

    alignment: Alignment
    """From the capture's coordinates to the audit's."""

    chosen: np.ndarray
    """Indices of the pictures that are used, ascending."""

    bounds: np.ndarray
    """Box round what the pictures show and where they were taken, [2, 3] [audit units]."""

    voxel_size: float
    """Edge of a voxel [audit units]."""

    cell_size: float
    """Edge of a cell of the coarse grid [audit units]."""

    median_depth: float
    """Of all that was measured [capture units]."""

    far_depth: float
    """95th percentile of all that was measured [capture units]."""

    unit: str
    """`m`, or `u` where nobody knows what a unit is."""

    def length(self, in_audit: float) -> float:
        """A length of the audit, in the capture's units."""
        return in_audit / self.alignment.scale


def survey_of(source: Source, wishes: Wishes) -> Survey:
    """Looks at some pictures and decides.

    Raises:
        ValueError: a wish that makes no sense; depth images that contradict the poses.
        FormatError: no picture has any depth; or a file is missing or broken.
    """
    _check(wishes)
    count = min(len(source), wishes.max_frames)
    chosen = np.unique(np.linspace(0, len(source) - 1, count).round().astype(np.int64))
    looks = _looks(source, chosen)
    depths, points = _measured(source, looks)
    median, far = (float(v) for v in np.percentile(depths, [50.0, 95.0]))
    if source.is_dense and not wishes.trust_depth:
        _check_depth(looks, median)
    scale = RANGE / _range(far, source.is_metric, wishes.max_range)
    cameras = source.poses[:, :3, 3]
    is_near = float(np.abs(cameras).max()) * scale < _FAR_AWAY
    origin = np.zeros(3) if is_near else np.median(cameras[chosen], axis=0)
    alignment = Alignment(rotation_to_z(_up(source, wishes)), scale, origin)
    low, high = np.percentile(alignment.points(points), [0.5, 99.5], axis=0)
    stood = alignment.points(cameras[chosen])
    low, high = np.minimum(low, stood.min(axis=0)), np.maximum(high, stood.max(axis=0))
    bounds = np.stack([low - 2 * MARGIN, high + 2 * MARGIN])
    voxel = _voxel_size(source, wishes, scale, median)
    _check_voxel(voxel, bounds, scale)
    least = float(np.cbrt(np.prod(bounds[1] - bounds[0]) / _MOST_CELLS))
    return Survey(
        alignment=alignment,
        chosen=chosen,
        bounds=bounds,
        voxel_size=voxel,
        cell_size=max(_CELL, 2.0 * voxel, least),
        median_depth=median,
        far_depth=far,
        unit="m" if source.is_metric else "u",
    )


def _check(wishes: Wishes) -> None:
    for name in ("voxel_size", "max_range"):
        value = getattr(wishes, name)
        if value is not None and not 0.0 < value < np.inf:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}")
    for name, least in _LEAST.items():
        value = getattr(wishes, name)
        option = _OPTIONS.get(name, name.replace("_", "-"))
        if value < least:
            raise ValueError(f"--{option} must be at least {least}, got {value}")
    if wishes.num_views > _MOST_VIEWS:
        raise ValueError(f"--views must be at most {_MOST_VIEWS}, got {wishes.num_views}")


def _looks(source: Source, chosen: np.ndarray) -> list[Look]:
    looked = chosen[np.unique(np.linspace(0, len(chosen) - 1, _SURVEYED).round().astype(int))]
    return [Look(source.read(i)[1], source.camera(i), source.poses[i]) for i in looked.tolist()]


def _measured(source: Source, looks: list[Look]) -> tuple[np.ndarray, np.ndarray]:
    """Some of the depths [k] and their points [k, 3], in the capture's coordinates."""
    rng = np.random.default_rng(0)
    local = [look.points(_VALUES, rng) for look in looks]
    depths = np.concatenate([points[:, 2] for points in local])
    if len(depths) < 3:
        raise FormatError(Path(source.name), "no picture shows anything whose depth is known")
    world = [
        points @ look.pose[:3, :3].T + look.pose[:3, 3]
        for points, look in zip(local, looks, strict=True)
    ]
    return depths, np.concatenate(world)


def _check_depth(looks: list[Look], median: float) -> None:
    """Refuses depth that no indoor camera measures, or that the poses contradict."""
    if median > FAR:
        raise ValueError(
            f"the median depth is {median:.4g} m: is its unit right (millimeters are 0.001 of a "
            "meter; in a transforms.json: depth_unit_scale_factor)? --trust-depth audits it all "
            "the same"
        )
    check_agreement(looks)


def _range(far: float, is_metric: bool, wanted: float | None) -> float:
    """How far pictures show things [capture units]."""
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


def _up(source: Source, wishes: Wishes) -> np.ndarray:
    if wishes.up is not None:
        return up_of(wishes.up)
    return source.up if source.up is not None else estimated_up(source.poses)


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


def _voxel_size(source: Source, wishes: Wishes, scale: float, median: float) -> float:
    if wishes.voxel_size is not None:
        return wishes.voxel_size * scale
    focal = float(np.median([float(source.camera(i).focal) for i in _few(len(source))]))
    finest = _DENSE_VOXEL if source.is_dense else _SPARSE_VOXEL
    return min(max(finest, _PIXELS * median * scale / focal), _LARGEST_VOXEL)


def _few(count: int) -> list[int]:
    return sorted({0, count // 2, count - 1})
