"""Reads the files that depth is stored in.

PNG, TIFF and NumPy's files hold whole numbers of steps; TIFF, NumPy's files and EXR hold floats.

Shape symbols: h, w size of a depth image.
"""

import io
from typing import Any

import numpy as np

from r3jax.validation.arrays import read_npy
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import MAX_PIXELS, image_pixels, image_size
from r3jax.validation.packages import why_not_imported

DEPTH_MODES = ("I;16", "I;16B", "I")
"""Pillow's modes of a depth image of whole numbers."""

_FORMATS = ("PNG", "TIFF")
_NPY, _EXR = b"\x93NUMPY", b"\x76\x2f\x31\x01"
"""How these files begin."""

_WANTED = "depth must be a PNG or TIFF of 16 bits, or floats of a TIFF, EXR or .npy file"

_CHANNELS = ("Z", "V", "Depth.Z", "Depth.V", "depth")
"""Where an EXR of several channels keeps depth: V is Blender's."""

_BACKGROUND = 1e9
"""Renderers store this or more where a ray meets nothing; in half floats it is infinite."""


def stored_depth(data: bytes) -> np.ndarray:
    """Reads a depth image as it is stored, [h, w]: whole numbers of steps, or floats.

    Floats are finite and >= 0, or inf where there is nothing; 0 is no measurement.

    Raises:
        ForeignFileError: no such file, damaged, of 8 bits or with several channels; an EXR while
            OpenEXR is not installed.
    """
    if data.startswith(_EXR):
        stored = _pixels_of_exr(data)
    elif data.startswith(_NPY):
        stored = read_npy(data)
        if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[2]):
            stored = stored[..., 0] if stored.shape[2] == 1 else stored[0]
        if stored.ndim != 2 or stored.dtype.kind not in "fiu" or not 0 < stored.size <= MAX_PIXELS:
            shape = " x ".join(map(str, stored.shape))
            raise ForeignFileError(f"depth must be a table of numbers, got {shape} {stored.dtype}")
    else:
        size = image_size(data, _FORMATS)
        stored = image_pixels(data, _FORMATS, size, (*DEPTH_MODES, "F"), _WANTED)
    if stored.dtype.kind != "f":
        return stored
    is_measured = stored > 0.0  # NaN makes it false
    depth = np.where(is_measured, stored, 0.0).astype(np.float32)
    return np.where(depth < _BACKGROUND, depth, np.float32(np.inf))


def check_exr() -> None:
    """Refuses to go on without OpenEXR.

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
    """The only channel of an EXR image, or the one that is named like depth."""
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
    """NumPy's type of a channel."""
    return {"HALF": "<f2", "FLOAT": "<f4", "UINT": "<u4"}[str(channel.type)]
