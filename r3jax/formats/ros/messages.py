"""Images and cameras as ROS sends them, as arrays.

The functions take any object with a message's fields: of rclpy, of rospy, or of a bag.

RVL (Wilson 2017) compresses depth images without loss, in ROS and in RTAB-Map: a stream of nibbles,
the highest of each 32-bit little-endian word first, three bits of a number, lowest first, and one
that says whether it goes on. The numbers are runs by turns: how many pixels are zero, how many are
not, and of those the zigzag-coded differences to the pixel before.

Shape symbols: H, W image size; h, w size of a depth image.
"""

import dataclasses
import struct
from typing import Any

import numpy as np

from r3jax.formats.depth import DEPTH_MODES
from r3jax.formats.lenses import Lens, matrix_lens
from r3jax.formats.posed_images import IMAGE_FORMATS
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import MAX_PIXELS, image_pixels

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_CHANNELS = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),  # OpenCV's order
    "8UC4": (4, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "rgb16": (3, (0, 1, 2)),
    "bgr16": (3, (2, 1, 0)),
    "rgba16": (4, (0, 1, 2)),
    "bgra16": (4, (2, 1, 0)),
    "16UC3": (3, (2, 1, 0)),
}
"""Channels of a color image, and where red, green and blue are among them."""

_BAYER_8 = {
    "bayer_rggb8": (0, 1, 1, 2),
    "bayer_bggr8": (2, 1, 1, 0),
    "bayer_gbrg8": (1, 2, 0, 1),
    "bayer_grbg8": (1, 0, 2, 1),
}
_BAYER = _BAYER_8 | {name[:-1] + "16": order for name, order in _BAYER_8.items()}
"""Channels of a block of 2 x 2 pixels, row by row."""

_YUV = {"uyvy": 1, "yuv422": 1, "yuyv": 0, "yuv422_yuy2": 0}
"""4:2:2 in four bytes for two pixels: where the first brightness is among them."""

_GRAY = ("mono8", "8UC1")
"""Whose gray becomes three equal colors, for those who name such a topic: infrared, thermal."""

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
    """Returns when a message was taken, by its header [ns].

    Without a stamp in the header it is `otherwise`.
    """
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or otherwise


def frame_of(message: Any) -> str:
    """Returns the frame of a message's header, without the leading slash of ROS 1."""
    return str(message.header.frame_id).lstrip("/")


def encoding_of(message: Any) -> str:
    """Returns the encoding of an image's pixels, such as rgb8 or 16UC1."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    stored = str(message.format)
    return stored.partition(";")[0].strip() if ";" in stored else stored.strip()


def is_depth(message: Any) -> bool:
    """Returns True if an image holds depth."""
    is_packed = "compressedDepth" in getattr(message, "format", "")
    return is_packed or encoding_of(message) in _DEPTHS


def is_color(message: Any) -> bool:
    """Returns True if an image holds colors."""
    if is_depth(message):
        return False
    stored = encoding_of(message)
    if hasattr(message, "encoding"):
        return stored in _CHANNELS or stored in _BAYER or stored in _YUV
    # Compressed images without a prefix say only "jpeg" or "png".
    return not stored.startswith(("mono", *_GRAY))


def is_gray(message: Any) -> bool:
    """Returns True if an image holds 8 bits of gray."""
    return not is_depth(message) and encoding_of(message).startswith(_GRAY)


def rgb_of(message: Any) -> np.ndarray:
    """Converts an image to colors, [H, W, 3] uint8.

    Args:
        message: sensor_msgs/Image of 8-bit RGB, Bayer, YUV 4:2:2 or gray, or CompressedImage of
            JPEG or PNG.

    Raises:
        ForeignFileError: another encoding; data that are damaged or too few.
    """
    encoding = encoding_of(message)
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        rgb = image_pixels(data, IMAGE_FORMATS)
        # A raw sensor's pixels may be packed as they are, in one channel.
        return _from_bayer(rgb[..., 0], _BAYER[encoding]) if encoding in _BAYER else rgb
    if encoding in _GRAY:
        return np.repeat(_rows(message, np.dtype("u1"), 1)[..., None], 3, axis=-1)
    if encoding in _BAYER:
        return _from_bayer(_levels(message, encoding, 1), _BAYER[encoding])
    if encoding in _YUV:
        return _from_yuv(_rows(message, np.dtype("u1"), 2), _YUV[encoding])
    if encoding not in _CHANNELS:
        known = ", ".join((*_CHANNELS, *_BAYER, *_YUV, *_GRAY))
        raise ForeignFileError(f"unsupported image encoding {encoding[:40]!r}: {known}")
    channels, order = _CHANNELS[encoding]
    pixels = _levels(message, encoding, channels)
    return pixels.reshape(message.height, message.width, channels)[..., order]


def _levels(message: Any, encoding: str, channels: int) -> np.ndarray:
    """Reads rows of 8 bits per value, [height, width * channels] uint8.

    Of values of 16 bits the upper byte is kept.
    """
    if "16" not in encoding:
        return _rows(message, np.dtype("u1"), channels)
    order = ">" if message.is_bigendian else "<"
    return (_rows(message, np.dtype(f"{order}u2"), channels) >> 8).astype(np.uint8)


def _from_bayer(raw: np.ndarray, channels: tuple[int, ...]) -> np.ndarray:
    """Interpolates a Bayer mosaic bilinearly, [H, W] uint8 to [H, W, 3] uint8."""
    rgb = np.empty((*raw.shape, 3), np.uint8)
    for color in range(3):
        there = np.zeros(raw.shape, np.float32)
        for at, channel in enumerate(channels):
            if channel == color:
                there[at // 2 :: 2, at % 2 :: 2] = 1.0
        # Weights 1 2 1 both ways: of each color they reach exactly its nearest pixels.
        total, weight = (_tent(one) for one in (there * raw, there))
        rgb[..., color] = np.where(there > 0, raw, np.rint(total / np.maximum(weight, 1e-6)))
    return rgb


def _tent(image: np.ndarray) -> np.ndarray:
    """Filters an image [H, W] with the weights 1 2 1 along columns and rows.

    Pixels outside count as zero.
    """
    for axis in (0, 1):
        padded = np.pad(image, [(1, 1) if axis == one else (0, 0) for one in (0, 1)])
        before, here, after = (np.moveaxis(padded, axis, 0)[i : i + image.shape[axis]] for i in
                               range(3))  # fmt: skip
        image = np.moveaxis(before + 2.0 * here + after, 0, axis)
    return image


def _from_yuv(rows: np.ndarray, first: int) -> np.ndarray:
    """Converts YUV 4:2:2, [H, 2 W] uint8, to colors [H, W, 3] uint8 by narrow-range BT.601."""
    if rows.shape[1] % 4:
        raise ForeignFileError("an image of YUV 4:2:2 has an odd number of columns")
    pairs = rows.reshape(len(rows), -1, 4).astype(np.float32)
    y = 1.164 * (pairs[..., [first, first + 2]].reshape(len(rows), -1) - 16.0)
    u, v = (np.repeat(pairs[..., 1 - first + i] - 128.0, 2, axis=1) for i in (0, 2))
    rgb = np.stack([y + 1.596 * v, y - 0.392 * u - 0.813 * v, y + 2.017 * u], axis=-1)
    return np.rint(rgb).clip(0.0, 255.0).astype(np.uint8)


def depth_of(message: Any) -> np.ndarray:
    """Converts an image to z-depth, [h, w] float32 [m].

    0 means no measurement, inf beyond the sensor's range.

    Args:
        message: sensor_msgs/Image of 16UC1 (millimeters) or 32FC1 (meters), or CompressedImage of
            the same as PNG or RVL, by image_transport's compressedDepth or plainly.

    Raises:
        ForeignFileError: another encoding; data that are damaged or too few.
    """
    encoding = encoding_of(message)
    if encoding not in _DEPTHS:
        raise ForeignFileError(f"{encoding[:40]!r} is not an encoding of depth")
    is_meters = _DEPTHS[encoding] == "f4"
    if not hasattr(message, "encoding"):
        return _unpacked(bytes(message.data), str(message.format), is_meters)
    order = ">" if message.is_bigendian else "<"
    depth = _rows(message, np.dtype(order + _DEPTHS[encoding]), 1)
    return clean_depth(depth if is_meters else 0.001 * depth.astype(np.float64))


def clean_depth(depth: np.ndarray) -> np.ndarray:
    """Converts depth to float32; NaN, negative numbers and -inf become 0: no measurement."""
    return np.where(depth > 0.0, depth, 0.0).astype(np.float32)  # NaN makes it false


def _rows(message: Any, kind: np.dtype, channels: int) -> np.ndarray:
    """Reads the rows of a plain image without their padding, [height, width * channels]."""
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
    """Decodes depth from a PNG of 16 bits or RVL, with image_transport's header or without."""
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
        steps = image_pixels(data, ("PNG",), None, DEPTH_MODES, wanted)
    if not is_meters:
        return clean_depth(0.001 * steps.astype(np.float64))
    if inverse is None:
        raise ForeignFileError("depth in meters cannot be stored in a PNG of whole numbers")
    a, b = inverse
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = a / (steps.astype(np.float64) - b)
    return clean_depth(np.where(steps == 0, 0.0, depth))


def lens_of(info: Any, *, is_rectified: bool = False) -> Lens:
    """Converts sensor_msgs/CameraInfo, whose pixel centers lie at whole numbers, to a lens.

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
    lens = rectified_lens(matrix, (int(info.width), int(info.height)))
    if is_rectified or not distortion.any():
        return lens
    model, bent = _distortion(str(info.distortion_model), distortion)
    return dataclasses.replace(lens, model=model, params=(*lens.params, *map(float, bent)))


def rectified_lens(matrix: np.ndarray, size: tuple[int, int]) -> Lens:
    """Makes the pinhole of a matrix [9] or [12] whose pixel centers lie at whole numbers.

    Args:
        matrix: K or P, row by row.
        size: width and height [px].
    """
    K = matrix.reshape(3, -1)
    if not K[:2].any():
        raise ForeignFileError(
            "the camera_info was never filled in, its matrix is zero: calibrate the camera "
            "(camera_calibration), or name another topic by --topics info=TOPIC"
        )
    return matrix_lens(K, size)


def _distortion(name: str, coefficients: np.ndarray) -> tuple[str, tuple[float, ...]]:
    """Returns COLMAP's name of a lens, and its coefficients."""
    if name not in _MODELS:
        raise ForeignFileError(
            f"unknown distortion {name[:40]!r}, known: {', '.join(filter(None, _MODELS))}: "
            "record the rectified images (image_proc)"
        )
    model, count = _MODELS[name]
    found = coefficients.ravel()
    if model == "OPENCV" and found[4:].any():  # k3 of plumb_bob
        model, count = "FULL_OPENCV", 8
    return model, (*found[:count], *(0.0,) * max(0, count - len(found)))


_SIZE = struct.Struct("<II")
"""Columns and rows, before the stream."""

_LONGEST = 8
"""Nibbles of a number: 24 bits are more than any run or difference takes."""


def unpack_rvl(data: bytes) -> np.ndarray:
    """Unpacks a depth image, [h, w] uint16.

    Args:
        data: its size and the stream.

    Raises:
        ForeignFileError: cut off or damaged, or an image that is too large.
    """
    if len(data) < _SIZE.size:
        raise ForeignFileError("a depth image is cut off")
    width, height = _SIZE.unpack_from(data)
    total = width * height
    if not 0 < total <= MAX_PIXELS:
        raise ForeignFileError(f"a depth image has {width} x {height} pixels")
    numbers = _numbers(data[_SIZE.size :])
    zigzag, is_measured = _runs(numbers, total)
    deltas = (zigzag >> 1) ^ -(zigzag & 1)
    values = np.cumsum(deltas)
    if len(values) and not (values.min() >= 0 and values.max() <= 0xFFFF):
        raise ForeignFileError("a depth image is damaged")
    depth = np.zeros(total, np.uint16)
    depth[is_measured] = values
    return depth.reshape(height, width)


def _numbers(stream: bytes) -> np.ndarray:
    """Decodes all numbers of a stream, [k] int64."""
    words = np.frombuffer(stream[: len(stream) // 4 * 4], "<u4")
    nibbles = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15
    nibbles = nibbles.ravel().astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        raise ForeignFileError("a depth image is damaged")
    starts = np.concatenate([[0], ends[:-1] + 1])
    if (ends - starts).max() >= _LONGEST:
        raise ForeignFileError("a depth image is damaged")
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    return np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << (3 * place), starts)


def _runs(numbers: np.ndarray, total: int) -> tuple[np.ndarray, np.ndarray]:
    """Splits a stream into differences of the measured pixels, and a mask of these [total]."""
    is_measured = np.zeros(total, bool)
    deltas: list[np.ndarray] = []
    at, pixel = 0, 0
    while pixel < total:
        if at + 1 >= len(numbers):
            raise ForeignFileError("a depth image is cut off")
        zeros, others = int(numbers[at]), int(numbers[at + 1])
        begin, end = pixel + zeros, pixel + zeros + others
        if end > total or at + 2 + others > len(numbers):
            raise ForeignFileError("a depth image is damaged")
        is_measured[begin:end] = True
        deltas.append(numbers[at + 2 : at + 2 + others])
        at, pixel = at + 2 + others, end
    return np.concatenate(deltas), is_measured
