"""Every k-th pixel of an image, as an ideal pinhole camera would have taken it.

An audit needs no more pixels than fall into a voxel each, and no more exactness than a voxel: so
images are thinned out, not averaged, and lenses are straightened by taking the nearest pixel. Where
the ideal image looks past the lens's own, there is no pixel.

Shape symbols: H, W image size; h, w size of the thinned image.
"""

import functools
from typing import NamedTuple

import numpy as np

from r3jax.formats.lenses import Lens
from r3jax.formats.validation.errors import ForeignFileError
from r3jax.geometry.cameras import Camera

_RADIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE",
            "FISHEYE")  # fmt: skip


class Table(NamedTuple):
    """Which pixel of an image each pixel of the thinned one takes."""

    row: np.ndarray
    """[h, w] int64."""

    column: np.ndarray
    """[h, w] int64."""

    is_there: np.ndarray
    """False where the image has no such pixel, [h, w]."""

    def take(self, image: np.ndarray) -> np.ndarray:
        """The thinned image [h, w, ...] of an image [H, W, ...]; 0 where there is no pixel."""
        taken = image[self.row, self.column]
        taken[~self.is_there] = 0
        return taken


def thinned(camera: Camera, stride: int) -> Camera:
    """The pinhole of every `stride`-th pixel, from the middle of the first block on."""
    sides = (camera.width, camera.height)
    width, height = (len(_taken(side, stride)) for side in sides)
    cx, cy = (
        (float(center) - _taken(side, stride)[0] - 0.5) / stride + 0.5
        for center, side in zip((camera.cx, camera.cy), sides, strict=True)
    )
    return Camera(width, height, float(camera.fx) / stride, float(camera.fy) / stride, cx, cy)


def _taken(side: int, stride: int) -> np.ndarray:
    """Which of `side` pixels in a row are taken; at least one."""
    return np.arange(min(stride // 2, side - 1), side, stride)


@functools.lru_cache(maxsize=8)
def sampling_table(lens: Lens, stride: int) -> Table:
    """Where the pixels of `thinned(lens.camera, stride)` lie in the lens's own image.

    Raises:
        ForeignFileError: a lens whose distortion is not known here.
    """
    column, row = np.meshgrid(_taken(lens.width, stride), _taken(lens.height, stride))
    if not lens.is_pinhole:
        fx, fy, cx, cy = lens.intrinsics
        x, y = distorted(lens, (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy)
        column, row = np.floor(fx * x + cx), np.floor(fy * y + cy)
    is_there = (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
    column, row = np.where(is_there, column, 0), np.where(is_there, row, 0)
    return Table(row.astype(np.int64), column.astype(np.int64), is_there)


def distorted(lens: Lens, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the lens shows the ray (x, y, 1): its own normalized coordinates.

    The models are COLMAP's: a polynomial in the squared radius and a tangential part (Brown), or
    in the angle to the axis (fisheye).

    Args:
        lens: the lens.
        x: slopes of the rays to the right.
        y: slopes of the rays downwards.

    Raises:
        ForeignFileError: another model.
    """
    k = {"k1": lens.named.get("k", 0.0), **lens.named}
    value = lambda name: k.get(name, 0.0)
    squared = x * x + y * y
    if lens.model in _FISHEYE:
        radius = np.sqrt(squared)
        angle = np.arctan(radius)
        t = angle * angle
        bent = 1.0 + t * (value("k1") + t * (value("k2") + t * (value("k3") + t * value("k4"))))
        factor = np.where(radius > 1e-9, angle * bent / np.maximum(radius, 1e-9), 1.0)
        return x * factor, y * factor
    if lens.model not in _RADIAL:
        raise ForeignFileError(
            f"images of a {lens.model} lens are not straightened here: undistort the capture "
            "first, for example by COLMAP's image_undistorter"
        )
    upper = 1.0 + squared * (value("k1") + squared * (value("k2") + squared * value("k3")))
    lower = 1.0 + squared * (value("k4") + squared * (value("k5") + squared * value("k6")))
    factor = upper / np.where(np.abs(lower) > 1e-9, lower, 1.0)
    p1, p2 = value("p1"), value("p2")
    return (
        x * factor + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
        y * factor + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y),
    )
