"""Unpacks RVL (Wilson 2017), by which RTAB-Map and ROS compress depth images without loss.

A stream of nibbles, the highest of each 32-bit little-endian word first: three bits of a number,
lowest first, and one that says whether it goes on. The numbers are runs by turns: how many pixels
are zero, how many are not, and of those the zigzag-coded differences to the pixel before.
"""

import struct

import numpy as np

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import MAX_PIXELS

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
    """All numbers of a stream, [k] int64."""
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
    """Differences of the pixels that are measured, and which pixels those are [total]."""
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
