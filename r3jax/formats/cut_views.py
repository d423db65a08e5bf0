"""Cuts photos that no pinhole shows whole into pinhole views: panoramas, fisheyes of 180 degrees.

A photo becomes the faces of a cube around its camera: front, right, back and left, up and down; a
fisheye those that it shows. Each face is an image with a pose and intrinsics of its own, so that
everything that takes posed images takes these. A track of structure from motion goes to the faces
that show its point. Pixels are taken from the photo when they are read, at its resolution in the
middle of a face, and nothing is written.

A 360 camera also shows what holds it: a hand, a tripod, a person. A cone below the camera is
therefore masked.

Shape symbols: s side of a view [px].
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from r3jax.formats.cut import Cut
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import BEYOND_A_HALF, PANORAMA, Lens, project_rays
from r3jax.formats.posed_images import IMAGE_FORMATS, Pixels, PosedImages, SparsePoints
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import small_gray

_WIDE = math.radians(75.0)
"""Half the field of view from which on a fisheye is cut: a pinhole of its focal length would show
less than half of the directions that it shows."""

_MAX_SIDE = 2048
"""Maximum side of a view [px]; a panorama of 6400 pixels has this resolution."""

_LEAST_SHOWN = 0.1
"""Minimum share of a face that the photo shows; other faces are left out."""

FACES: dict[str, np.ndarray] = {
    name: np.array(axes, np.float64).T
    for name, axes in {
        "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
        "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
        "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
        "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
        "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    }.items()
}
"""Rotation of every face, [3, 3]: its camera's axes in those of the photo."""


class _View(NamedTuple):
    """One view of a photo."""

    photo: int
    """Index of the photo."""

    face: str | None
    """Name of the face; None: the photo as it is."""


def is_wide(lens: Lens) -> bool:
    """Checks whether a lens shows more than a pinhole can."""
    return lens.is_panorama or (lens.model in BEYOND_A_HALF and lens.half_angle > _WIDE)


def cut_wide(images: PosedImages, cut: Cut | None = None) -> PosedImages:
    """Cuts panoramas and wide fisheyes into views; other photos stay as they are.

    Args:
        images: of any lenses. Depth of a photo that is cut counts as distance along the rays.
        cut: settings of the cut.

    Returns:
        The same images if none of them is wide. Views of a photo follow each other.
    """
    cut = cut or Cut()
    for lens, path in zip(images.lenses, images.image_paths, strict=True):
        if lens.model == PANORAMA:
            _check_stitched(path)
            break
    wide = {lens: shown_faces(lens, cut) for lens in set(images.lenses) if is_wide(lens)}
    if not wide:
        return images
    views = [
        _View(photo, face)
        for photo, lens in enumerate(images.lenses)
        for face in wide.get(lens, (None,))
    ]
    poses = images.poses[[view.photo for view in views]].copy()
    for pose, view in zip(poses, views, strict=True):
        if view.face is not None:
            pose[:3, :3] = pose[:3, :3] @ FACES[view.face]
    paths = [images.image_paths[view.photo] for view in views]
    named = tuple(
        path if view.face is None else path.with_name(f"{path.stem}_{view.face}{path.suffix}")
        for path, view in zip(paths, views, strict=True)
    )
    said = _remark(images, wide, cut)
    return dataclasses.replace(
        images,
        image_paths=named,
        lenses=tuple(_lens_of(images.lenses[view.photo], view, cut) for view in views),
        poses=poses,
        depth_paths=tuple(images.depth_paths[view.photo] for view in views),
        depth_lenses=None,
        points=None if images.points is None else _shared_out(images, views, cut),
        pixels=_pixels(images, views, cut),
        mask_paths=None,
        remark=f"{said} {images.remark}" if images.remark else said,
        photo_of=np.array([view.photo for view in views]),
    )


_SMALL = (64, 32)
"""Size at which a panorama is checked [px]."""

_BLACK, _BRIGHT = 16, 48
"""Gray values of the corners round the circles of a dual fisheye, and of its circles."""


def _check_stitched(path: Path) -> None:
    """Refuses a dual fisheye that is given as a panorama, whose first row is one direction.

    Raises:
        FormatError: the corners round two circles are black.
    """
    try:
        gray = small_gray(path, IMAGE_FORMATS, _SMALL)
    except (ForeignFileError, OSError):
        return  # what is wrong with the photo is said when its pixels are read
    quarter = _SMALL[0] // 4
    corners = gray[[0, 0, 0, -1, -1, -1], [0, 2 * quarter, -1] * 2]
    circles = gray[[0, 0, -1, -1], [quarter, 3 * quarter] * 2]
    if corners.max() <= _BLACK and np.median(circles) >= _BRIGHT:
        raise FormatError(
            path,
            "this is a dual fisheye (two circles), not a stitched panorama: stitch the photos with "
            "the camera's app or ffmpeg's filter v360=dfisheye:e, or say so in a transforms.json "
            '("camera_model": "DUAL_FISHEYE" and "fov", the degrees of each circle)',
        )


def view_lens(lens: Lens, cut: Cut) -> Lens:
    """Returns the pinhole of a photo's views: its pixels in the middle are as wide as there."""
    half = math.radians(45.0 + 0.5 * cut.overlap)
    side = min(_MAX_SIDE, max(1, round(2.0 * lens.intrinsics[0] * math.tan(half))))
    focal = 0.5 * side / math.tan(half)
    return Lens("PINHOLE", side, side, (focal, focal, 0.5 * side, 0.5 * side))


def shown_faces(lens: Lens, cut: Cut) -> tuple[str, ...]:
    """Lists the faces of which a photo shows enough."""
    coarse = 64.0 / view_lens(lens, cut).width
    return tuple(
        face for face in FACES if _table_of(lens, face, cut, coarse)[1].mean() >= _LEAST_SHOWN
    )


def _lens_of(lens: Lens, view: _View, cut: Cut) -> Lens:
    return lens if view.face is None else view_lens(lens, cut)


def _remark(images: PosedImages, wide: dict[Lens, tuple[str, ...]], cut: Cut) -> str:
    photo = next(i for i, lens in enumerate(images.lenses) if lens in wide)
    lens, path = images.lenses[photo], images.image_paths[photo]
    count = sum(lens in wide for lens in images.lenses)
    faces = wide[lens]
    field = 360 if lens.is_panorama else round(2.0 * math.degrees(lens.half_angle))
    said = (
        f"The {count} photos of {field} degrees are cut into {len(faces)} pinhole views each, "
        f"named after photo and direction ({path.stem}_{faces[0]}{path.suffix} to "
        f"{path.stem}_{faces[-1]}{path.suffix})"
    )
    if not (cut.hide_below and lens.is_panorama):
        return f"{said}."
    return (
        f"{said}; {cut.hide_below:g} degrees around the direction below the camera are masked, "
        "where its holder is (--hide-below)."
    )


def _rays(lens: Lens, scale: float) -> np.ndarray:
    """Computes the rays (x, y, 1) of a view's pixels, or of fewer, [s, s, 3]."""
    side = max(1, round(scale * lens.width))
    along = (np.arange(side) + 0.5 - 0.5 * side) * (lens.width / side) / lens.params[0]
    x, y = np.meshgrid(along, along)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


@functools.lru_cache(maxsize=2 * len(FACES))
def _table(lens: Lens, face: str, cut: Cut) -> tuple[np.ndarray, np.ndarray]:
    """Keeps the tables of two lenses."""
    return _table_of(lens, face, cut, 1.0)


def _table_of(lens: Lens, face: str, cut: Cut, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Computes which pixel of the photo a view's pixel takes [s, s] int32, and whether it may."""
    rays = _rays(view_lens(lens, cut), scale) @ FACES[face].T
    column, row = project_rays(lens, rays)
    is_there = (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
    if lens.is_panorama:
        is_there &= np.hypot(rays[..., 0], rays[..., 2]) > rays[..., 1] * math.tan(
            math.radians(cut.hide_below)
        )
    column, row = np.where(is_there, column, 0.0), np.where(is_there, row, 0.0)
    return row.astype(np.int32) * lens.width + column.astype(np.int32), is_there


def _pixels(images: PosedImages, views: list[_View], cut: Cut) -> Pixels:
    """Makes the reader of the views. A photo is kept until another one is read."""

    @functools.lru_cache(maxsize=1)
    def photo(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        return images.masked_rgb(index)

    def taken(image: np.ndarray, view: _View) -> np.ndarray:
        if view.face is None:
            return image
        table, is_there = _table(images.lenses[view.photo], view.face, cut)
        found = image.reshape(-1, *image.shape[2:])[table]
        found[~is_there] = 0
        return found

    def rgb(index: int) -> np.ndarray:
        return taken(photo(views[index].photo)[0], views[index])

    def mask(index: int) -> np.ndarray:
        rgb, given = photo(views[index].photo)
        return taken(np.ones(rgb.shape[:2], bool) if given is None else given, views[index])

    def depth(index: int) -> np.ndarray:
        view = views[index]
        lens = images.lenses[view.photo]
        found = images.depth(view.photo)
        if found is None:
            return np.zeros((1, 1), np.float32)
        if view.face is None:
            return found
        lengths = np.linalg.norm(_rays(view_lens(lens, cut), 1.0), axis=-1)
        return (taken(found, view) / lengths).astype(np.float32)

    return Pixels(rgb, depth, mask, images.has_images)


def _shared_out(images: PosedImages, views: list[_View], cut: Cut) -> SparsePoints:
    """Gives each observation to the views of its photo that show the point."""
    points = images.points
    assert points is not None
    edge = math.tan(math.radians(45.0 + 0.5 * cut.overlap))
    order = np.argsort(points.seen_image, kind="stable")
    ends = np.searchsorted(points.seen_image[order], np.arange(len(images) + 1))
    seen_point, seen_image = [points.seen_point[:0]], [points.seen_image[:0]]
    for number, (photo, face) in enumerate(views):
        seen = points.seen_point[order[ends[photo] : ends[photo + 1]]]
        if face is not None:
            pose = images.poses[photo]
            x, y, z = ((points.xyz[seen] - pose[:3, 3]) @ pose[:3, :3] @ FACES[face]).T
            seen = seen[(z > 0.0) & (np.maximum(np.abs(x), np.abs(y)) <= edge * z)]
        seen_point.append(seen)
        seen_image.append(np.full(len(seen), number, points.seen_image.dtype))
    point, image = np.concatenate(seen_point), np.concatenate(seen_image)
    order = np.argsort(point, kind="stable")
    return SparsePoints(points.xyz, points.rgb, point[order], image[order])
