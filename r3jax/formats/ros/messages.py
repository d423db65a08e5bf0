"""Images and cameras as ROS sends them, as arrays.

The functions take any object with a message's fields: of rclpy, of rospy, or of a bag.

Shape symbols: H, W image size; h, w size of a depth image.
"""

import struct
from typing import Any

import numpy as np

from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import DEPTH_MODES, IMAGE_FORMATS
from r3jax.formats.ros.rvl import unpack_rvl
from r3jax.formats.validation.errors import ForeignFileError
from r3jax.formats.validation.images import MAX_PIXELS, image_pixels, image_size

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_CHANNELS = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),  # OpenCV's order
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
}
"""Channels of a color image, and where red, green and blue are among them."""

_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Whole millimeters, or meters (REP 118)."""

_MODELS = {
    **dict.fromkeys(("", "plumb_bob", "none"), ("OPENCV", 4)),
    "rational_polynomial": ("FULL_OPENCV", 8),
    **dict.fromkeys(("equidistant", "fisheye"), ("OPENCV_FISHEYE", 4)),
}
"""Names of distortion, the lens it means, and how many coefficients that has."""

_COMPRESSED_DEPTH_HEAD = struct.Struct("<iff")
"""Format, and the two numbers of the inverse depth."""


def stamp_of(message: Any, otherwise: int = 0) -> int:
    """When a message was taken, by its header [ns]; `otherwise` where nobody filled it in."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or otherwise


def frame_of(message: Any) -> str:
    """The frame of a message's header; ROS 1 may begin it with a slash."""
    return str(message.header.frame_id).lstrip("/")


def encoding_of(message: Any) -> str:
    """How the pixels of an image are stored, such as rgb8 or 16UC1."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    stored = str(message.format)
    return stored.partition(";")[0].strip() if ";" in stored else stored.strip()


def is_depth(message: Any) -> bool:
    """True if an image holds depth."""
    is_packed = "compressedDepth" in getattr(message, "format", "")
    return is_packed or encoding_of(message) in _DEPTHS


def is_color(message: Any) -> bool:
    """True if an image holds colors."""
    if is_depth(message):
        return False
    stored = encoding_of(message)
    # Compressed images without a prefix say only "jpeg" or "png".
    return stored in _CHANNELS or (not hasattr(message, "encoding") and not _is_gray(stored))


def _is_gray(stored: str) -> bool:
    return stored.startswith(("mono", "8UC1", "bayer"))


def rgb_of(message: Any) -> np.ndarray:
    """Colors of an image, [H, W, 3] uint8.

    Args:
        message: sensor_msgs/Image in one of five encodings, or CompressedImage of JPEG or PNG.

    Raises:
        ForeignFileError: another encoding; data that are damaged or too few.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        return image_pixels(data, IMAGE_FORMATS, image_size(data, IMAGE_FORMATS))
    encoding = encoding_of(message)
    if encoding not in _CHANNELS:
        raise ForeignFileError(
            f"images of the encoding {encoding[:40]!r} are not read, only {', '.join(_CHANNELS)}"
        )
    channels, order = _CHANNELS[encoding]
    pixels = _rows(message, np.dtype("u1"), channels)
    return pixels.reshape(message.height, message.width, channels)[..., order]


def depth_of(message: Any) -> np.ndarray:
    """z-depth of an image, [h, w] float32 [m]; 0 no measurement, inf beyond the sensor's range.

    Args:
        message: sensor_msgs/Image of 16UC1 (millimeters) or 32FC1 (meters), or CompressedImage of
            the same as PNG or RVL, by image_transport's compressedDepth or plainly.

    Raises:
        ForeignFileError: another encoding; data that are damaged or too few.
    """
    encoding = encoding_of(message)
    if encoding not in _DEPTHS:
        raise ForeignFileError(f"{encoding[:40]!r} is no encoding of depth")
    is_meters = _DEPTHS[encoding] == "f4"
    if not hasattr(message, "encoding"):
        return _unpacked(bytes(message.data), str(message.format), is_meters)
    order = ">" if message.is_bigendian else "<"
    depth = _rows(message, np.dtype(order + _DEPTHS[encoding]), 1)
    return clean_depth(depth if is_meters else 0.001 * depth.astype(np.float64))


def clean_depth(depth: np.ndarray) -> np.ndarray:
    """The same as float32; NaN, negative numbers and -inf become 0: no measurement."""
    return np.where(depth > 0.0, depth, 0.0).astype(np.float32)  # NaN makes it false


def _rows(message: Any, kind: np.dtype, channels: int) -> np.ndarray:
    """The rows of a plain image without what pads them, [height, width * channels]."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    used = width * channels * kind.itemsize
    if not 0 < width * height <= MAX_PIXELS:
        raise ForeignFileError(f"an image has {width} x {height} pixels")
    is_bytes = isinstance(message.data, bytes)
    data = (np.frombuffer if is_bytes else np.asarray)(message.data, np.uint8)
    if step < used or len(data) < step * height:
        raise ForeignFileError(
            f"an image of {width} x {height} pixels and {step} bytes a row has {len(data)} bytes"
        )
    rows = data[: step * height].reshape(height, step)[:, :used]
    return np.ascontiguousarray(rows).view(kind)


def _unpacked(data: bytes, stored: str, is_meters: bool) -> np.ndarray:
    """Depth from a PNG of 16 bits or RVL, with image_transport's header or without."""
    inverse = None
    if "compressedDepth" in stored:
        if len(data) < _COMPRESSED_DEPTH_HEAD.size:
            raise ForeignFileError("a depth image is cut off")
        inverse = _COMPRESSED_DEPTH_HEAD.unpack_from(data)[1:]
        data = data[_COMPRESSED_DEPTH_HEAD.size :]
    if "rvl" in stored.lower():
        steps = unpack_rvl(data)
    else:
        wanted = "depth must be a 16-bit PNG"
        steps = image_pixels(data, ("PNG",), image_size(data, ("PNG",)), DEPTH_MODES, wanted)
    if not is_meters:
        return clean_depth(0.001 * steps.astype(np.float64))
    if inverse is None:
        raise ForeignFileError("depth in meters cannot be stored in a PNG of whole numbers")
    a, b = inverse
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = a / (steps.astype(np.float64) - b)
    return clean_depth(np.where(steps == 0, 0.0, depth))


def lens_of(info: Any, *, is_rectified: bool = False) -> Lens:
    """The lens of sensor_msgs/CameraInfo, where pixel centers lie at whole numbers.

    Args:
        info: the message.
        is_rectified: the images are those of `image_rect`, which P belongs to.

    Raises:
        ForeignFileError: a camera that makes no sense, or a distortion that is not known.
    """
    field = lambda name: np.asarray(
        getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper()),
        dtype=np.float64,
    )
    matrix, distortion = field("p" if is_rectified else "k").ravel(), field("d")
    if len(matrix) != (12 if is_rectified else 9):
        raise ForeignFileError(f"a matrix of the camera has {len(matrix)} numbers")
    K = matrix.reshape(3, -1)
    values = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    model, bent = "PINHOLE", ()
    if distortion.any() and not is_rectified:
        model, bent = _distortion(str(info.distortion_model), distortion)
    params = tuple(float(value) for value in (*values, *bent))
    return Lens(model, int(info.width), int(info.height), params)


def _distortion(name: str, coefficients: np.ndarray) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of a lens, and its coefficients."""
    if name not in _MODELS:
        raise ForeignFileError(
            f"the distortion {name[:40]!r} is not known, only {', '.join(filter(None, _MODELS))}: "
            "record the rectified images (image_proc)"
        )
    model, count = _MODELS[name]
    found = coefficients.ravel()
    if model == "OPENCV" and found[4:].any():  # k3 of plumb_bob
        model, count = "FULL_OPENCV", 8
    return model, (*found[:count], *(0.0,) * max(0, count - len(found)))
