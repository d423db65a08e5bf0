"""Depth images: the files that hold them, the meaning of their numbers, and their pixels.

PNG, TIFF and NumPy's files hold whole numbers of steps; TIFF, NumPy's files and EXR hold floats.

Phones measure depth with few pixels (256 x 192) beside large images (1920 x 1440). Depth is
resampled to the image by its nearest pixel, never interpolated: the mean of two surfaces is not a
surface.

Shape symbols: H, W size of the color image; h, w size of the depth image.
"""

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from r3jax.formats.lenses import Lens
from r3jax.validation.arrays import read_npy
from r3jax.validation.errors import ForeignFileError, why_not_imported
from r3jax.validation.images import MAX_PIXELS, image_pixels

DEPTH_MODES = ("I;16", "I;16B", "I")
"""Pillow's modes of a depth image of whole numbers."""

_FORMATS = ("PNG", "TIFF")
_COLMAP = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")
_NPY, _EXR = b"\x93NUMPY", b"\x76\x2f\x31\x01"
"""How these files begin."""

_WANTED = "depth must be a PNG or TIFF of 16 bits, or floats of a TIFF, EXR or .npy file"

_CHANNELS = ("Z", "V", "Depth.Z", "Depth.V", "depth")
"""Where an EXR of several channels keeps depth: V is Blender's."""

_BACKGROUND = 1e9
"""Renderers store this or more where a ray meets nothing; in half floats it is infinite."""


@dataclass(frozen=True)
class DepthUnit:
    """The meaning of the numbers in a depth image; 0 is no measurement."""

    metres_per_step: float = 0.001
    """Units of the capture per step of whole numbers."""

    beyond_range: int | None = None
    """Value for pixels beyond the sensor's range; None: there is no such value."""

    invalid: int | None = None
    """Value, beside 0, of pixels without a measurement; None: there is no such value."""

    metres_per_unit: float = 1.0
    """Units of the capture per 1.0, for floats."""

    def depth(self, steps: np.ndarray) -> np.ndarray:
        """Converts stored numbers to z-depth [h, w] float32.

        0 means no measurement, inf beyond the range.
        """
        if steps.dtype.kind == "f":
            return (steps * self.metres_per_unit).astype(np.float32)
        depth = (steps.astype(np.float64) * self.metres_per_step).astype(np.float32)
        if self.invalid is not None:
            depth = np.where(steps == self.invalid, np.float32(0.0), depth)
        if self.beyond_range is None:
            return depth
        return np.where(steps == self.beyond_range, np.float32(np.inf), depth)


MILLIMETERS = DepthUnit()


def stored_depth(data: bytes) -> np.ndarray:
    """Reads a depth image as it is stored, [h, w]: whole numbers of steps, or floats.

    Floats are finite and >= 0, or inf where there is nothing; 0 is no measurement.

    Raises:
        ForeignFileError: no such file, damaged, of 8 bits or with several channels; an EXR while
            OpenEXR is not installed.
    """
    if header := _COLMAP.match(data):
        stored = _pixels_of_colmap(data, header)
    elif data.startswith(_EXR):
        stored = _pixels_of_exr(data)
    elif data.startswith(_NPY):
        stored = read_npy(data)
        if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[2]):
            stored = stored[..., 0] if stored.shape[2] == 1 else stored[0]
        if stored.ndim != 2 or stored.dtype.kind not in "fiu" or not 0 < stored.size <= MAX_PIXELS:
            shape = " x ".join(map(str, stored.shape))
            raise ForeignFileError(f"depth must be a table of numbers, got {shape} {stored.dtype}")
    else:
        stored = image_pixels(data, _FORMATS, None, (*DEPTH_MODES, "F"), _WANTED)
    if stored.dtype.kind != "f":
        return stored
    is_measured = stored > 0.0  # NaN makes it false
    depth = np.where(is_measured, stored, 0.0).astype(np.float32)
    return np.where(depth < _BACKGROUND, depth, np.float32(np.inf))


def _pixels_of_colmap(data: bytes, header: re.Match[bytes]) -> np.ndarray:
    """Reads a depth map of COLMAP's stereo: "width&height&1&", then floats row by row."""
    width, height, channels = (int(number) for number in header.groups())
    if channels != 1 or not 0 < width * height <= MAX_PIXELS:
        raise ForeignFileError(f"the depth map is {width} x {height} x {channels}")
    left = len(data) - header.end()
    if left != 4 * width * height:
        raise ForeignFileError(
            f"truncated: it declares {width} x {height} pixels, but {left} bytes follow"
        )
    return np.frombuffer(data, "<f4", width * height, header.end()).reshape(height, width)


def check_exr() -> None:
    """Checks that OpenEXR is installed.

    Raises:
        ForeignFileError: it is not installed; names the extra.
    """
    _load_openexr()


def _load_openexr() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise ForeignFileError(
            why_not_imported(error, "OpenEXR", "EXR images are read by", "phones")
        ) from None
    return OpenEXR


def _pixels_of_exr(data: bytes) -> np.ndarray:
    """Reads the only channel of an EXR image, or the one that is named like depth."""
    openexr = _load_openexr()
    try:
        file = openexr.InputFile(io.BytesIO(data))
        header = file.header()
        window = header["dataWindow"]
        width = int(window.max.x) - int(window.min.x) + 1
        height = int(window.max.y) - int(window.min.y) + 1
        names = sorted(header["channels"])
        if not 0 < width * height <= MAX_PIXELS:
            raise ForeignFileError(f"the image is {width} x {height} pixels")
        chosen = names if len(names) == 1 else [name for name in _CHANNELS if name in names]
        if not chosen:
            raise ForeignFileError(f"depth must be one channel, got {', '.join(names)[:80]}")
        pixels = np.frombuffer(file.channel(chosen[0]), _kind(header["channels"][chosen[0]]))
    except ForeignFileError:
        raise
    except Exception as error:  # the library raises what C++ threw
        raise ForeignFileError(f"the EXR image cannot be read ({error!s:.200})") from None
    return pixels.reshape(height, width).astype(np.float32)


def _kind(channel: Any) -> str:
    """Returns NumPy's type of a channel."""
    return {"HALF": "<f2", "FLOAT": "<f4", "UINT": "<u4"}[str(channel.type)]


def resample_depth(depth: np.ndarray, lens: Lens, depth_lens: Lens | None = None) -> np.ndarray:
    """Samples z-depth at the nearest pixel of every ray of a color image, [H, W].

    Args:
        depth: [h, w].
        lens: the color image's; distortion does not count.
        depth_lens: pinhole of the depth image, at the same place and with the same axes; None: it
            covers what the color image covers.

    Returns:
        0 where the ray leaves the depth image.
    """
    fx, fy, cx, cy = lens.intrinsics
    if depth_lens is None:
        column, row = (
            ((np.arange(now) + 0.5) * there / now).astype(np.int64)
            for now, there in ((lens.width, depth.shape[1]), (lens.height, depth.shape[0]))
        )
        return depth[row[:, None], column[None, :]]
    fx_depth, fy_depth, cx_depth, cy_depth = depth_lens.intrinsics
    column = _along(lens.width, fx, cx, fx_depth, cx_depth)
    row = _along(lens.height, fy, cy, fy_depth, cy_depth)
    sampled = depth[
        row.clip(0, depth.shape[0] - 1)[:, None], column.clip(0, depth.shape[1] - 1)[None, :]
    ]
    is_row = (row >= 0) & (row < depth.shape[0])
    is_column = (column >= 0) & (column < depth.shape[1])
    return np.where(is_row[:, None] & is_column[None, :], sampled, np.float32(0.0))


def _along(
    count: int, focal: float, center: float, focal_depth: float, center_depth: float
) -> np.ndarray:
    """Finds pixels of the depth image along one axis, [count] int64.

    An index of -1, or beyond the last pixel, lies outside the image.
    """
    slope = (np.arange(count) + 0.5 - center) / focal
    return np.floor(focal_depth * slope + center_depth).clip(-1, 1 << 30).astype(np.int64)


def keep_confident(depth: np.ndarray, confidence: np.ndarray, best: int) -> np.ndarray:
    """Makes every depth no measurement whose confidence is below the best one.

    Args:
        depth: [h, w].
        confidence: of the same size.
        best: the sensor's highest level.

    Raises:
        ForeignFileError: the sizes differ.
    """
    if confidence.shape != depth.shape:
        raise ForeignFileError(
            f"the confidence has {confidence.shape[1]} x {confidence.shape[0]} pixels, its depth "
            f"image {depth.shape[1]} x {depth.shape[0]}"
        )
    return np.where(confidence >= best, depth, np.float32(0.0))


def register_depth(
    depth: np.ndarray, depth_lens: Lens, lens: Lens, T_color_depth: np.ndarray
) -> np.ndarray:
    """Moves the depth of one camera into the image of another beside it (forward warping).

    Every measurement becomes a point, which falls into one pixel; the nearest hides the others.
    The result is a little coarser than the depth, so that few of its pixels stay empty.

    Args:
        depth: z-depth [h, w] float32.
        depth_lens: pinhole of the depth camera.
        lens: pinhole of the color camera.
        T_color_depth: takes points of the depth camera to the color camera, [4, 4].

    Returns:
        z-depth [h', w'] float32 that covers what the color image covers; 0 where nothing fell.
    """
    fx, fy, cx, cy = depth_lens.intrinsics
    row, column = np.nonzero((depth > 0.0) & np.isfinite(depth))
    z = depth[row, column].astype(np.float64)
    local = np.stack([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z], axis=1)
    x, y, z = (local @ T_color_depth[:3, :3].T + T_color_depth[:3, 3]).T
    fx_color, fy_color, cx_color, cy_color = lens.intrinsics
    coarser = 0.9 * min(1.0, fx / fx_color, fy / fy_color)
    height, width = (max(1, int(side * coarser)) for side in (lens.height, lens.width))
    z_or_far = np.where(z > 1e-3, z, np.inf)
    u = np.floor((fx_color * x / z_or_far + cx_color) * width / lens.width)
    v = np.floor((fy_color * y / z_or_far + cy_color) * height / lens.height)
    is_in = (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    nearest = np.full((height, width), np.inf)
    place = v[is_in].astype(np.int64), u[is_in].astype(np.int64)
    np.minimum.at(nearest, place, z[is_in])
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)
