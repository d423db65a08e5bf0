"""Poses from files, and the tables of numbers in text that most recordings keep them in.

What rounding did to a rotation is mended, anything worse is refused.
"""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.geometry.cameras import rigid_error
from r3jax.validation.files import plain_text, read_bytes

MAX_DRIFT = 0.02
"""Rotations off by at most this (text with few digits, long chains of products) are mended."""

_ROUNDING = 1e-6
"""Rotations off by at most this stay as they are: float32 stores no better."""

MAX_DISTANCE = 1e12
"""Cameras farther from the origin than this are nowhere: squares would leave float32."""

_MAX_TEXT = 64 << 20
"""A pose takes some hundred bytes."""


def mend_pose(path: Path, which: str, pose: np.ndarray) -> np.ndarray:
    """Removes a small drift from a rotation (nearest rotation, by SVD); refuses a large one.

    Args:
        path: the file that the pose is from, for the message.
        which: the pose's name in that file, for the message.
        pose: [4, 4] float64.

    Raises:
        FormatError: not finite, not rigid, mirrored, or too far away.
    """
    if np.all(np.isfinite(pose)) and np.abs(pose[:3, :3]).max() < 2.0:
        R = pose[:3, :3]
        u, _, vt = np.linalg.svd(R)
        nearest = u @ vt
        drift = float(np.abs(nearest - R).max())
        if np.linalg.det(nearest) > 0.0 and _ROUNDING < drift <= MAX_DRIFT:
            pose = pose.copy()
            pose[:3, :3] = nearest
    problem = rigid_error(pose)
    if problem is None and np.abs(pose[:3, 3]).max() > MAX_DISTANCE:
        problem = f"the position is {pose[:3, 3].tolist()}"
    if problem is not None:
        raise FormatError(path, f"{which}: {problem}")
    return pose


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The words of every line that has any, and its number from 1; comments start with #.

    A heading that lost its # ("timestamp filename") is no line either.

    Raises:
        FormatError: missing, not a regular file, or far too large.
    """
    with naming(path):
        data = plain_text(read_bytes(path, _MAX_TEXT))
    for number, raw in enumerate(io.BytesIO(data), start=1):
        words = raw.decode("utf-8", errors="replace").partition("#")[0].split()
        if words and words[0].lower() != "timestamp":
            yield number, words


def to_floats(path: Path, number: int, words: list[str], columns: int) -> list[float]:
    """The numbers of one line.

    Raises:
        FormatError: another number of words, or one that is no number.
    """
    if len(words) != columns:
        raise FormatError(path, f"line {number} has {len(words)} numbers, not {columns}")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise FormatError(path, f"line {number}: {error!s:.200}") from None


def read_numbers(path: Path, columns: int) -> np.ndarray:
    """A table of numbers, [n, columns] float64, n >= 1.

    Raises:
        FormatError: the file is missing, holds no numbers, or a line has another number of them.
    """
    rows = [to_floats(path, number, words, columns) for number, words in read_lines(path)]
    if not rows:
        raise FormatError(path, "the file holds no numbers")
    return np.asarray(rows)
