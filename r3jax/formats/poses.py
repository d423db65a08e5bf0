"""Poses from files: matrices, quaternions, and tables of numbers in text that hold them.

Rounding errors of rotations are corrected, larger errors are refused.
"""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.formats.errors import FormatError, naming
from r3jax.geometry.cameras import rigid_error
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import plain_text, read_bytes

UP_Y, UP_Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
"""Verticals of worlds: phones have y up, robots and most data sets z."""

MAX_DRIFT = 0.02
"""Rotations off by at most this (text with few digits, long chains of products) are mended."""

_ROUNDING = 1e-6
"""Rotations off by at most this stay as they are: float32 stores no better."""

MAX_DISTANCE = 1e12
"""Maximum distance of cameras from the origin, so that squares fit in float32."""

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


def read_lines(path: Path, data: bytes | None = None) -> Iterator[tuple[int, list[str]]]:
    """Yields the words of every line that has any, and its number from 1; comments start with #.

    A heading that lost its # ("timestamp filename") is no line either.

    Args:
        path: the file.
        data: what it holds, where it lies in an archive.

    Raises:
        FormatError: missing, not a regular file, or far too large.
    """
    with naming(path):
        data = plain_text(read_bytes(path, _MAX_TEXT) if data is None else data)
    for number, raw in enumerate(io.BytesIO(data), start=1):
        words = raw.decode("utf-8", errors="replace").partition("#")[0].split()
        if words and words[0].lower() != "timestamp":
            yield number, words


def to_floats(path: Path, number: int, words: list[str], columns: int) -> list[float]:
    """Parses the numbers of one line.

    Raises:
        FormatError: another number of words, or one that is no number.
    """
    if len(words) != columns:
        raise FormatError(path, f"line {number} has {len(words)} numbers, not {columns}")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise FormatError(path, f"line {number}: {error!s:.200}") from None


def read_numbers(path: Path, columns: int, data: bytes | None = None) -> np.ndarray:
    """Reads a table of numbers, [n, columns] float64, n >= 1; `data` as in `read_lines`.

    Raises:
        FormatError: the file is missing, holds no numbers, or a line has another number of them.
    """
    lines = read_lines(path, data)
    rows = [to_floats(path, number, words, columns) for number, words in lines]
    if not rows:
        raise FormatError(path, "the file holds no numbers")
    return np.asarray(rows)


def read_matrix(path: Path, rows: int, columns: int, data: bytes | None = None) -> np.ndarray:
    """Reads a matrix of this shape, float64; `data` as in `read_lines`.

    Raises:
        FormatError: the file is missing, or holds something else.
    """
    matrix = read_numbers(path, columns, data)
    if len(matrix) != rows:
        raise FormatError(path, f"expected a {rows}x{columns} matrix, got {len(matrix)} lines")
    return matrix


def read_poses(path: Path) -> np.ndarray:
    """Reads camera-to-world matrices [n, 4, 4], one a line, 16 numbers row by row.

    Raises:
        FormatError: the file is missing or damaged, or a pose is not finite or not rigid.
    """
    rows = read_numbers(path, columns=16).reshape(-1, 4, 4)
    return np.stack(
        [mend_pose(path, f"pose {i} (line {i + 1})", pose) for i, pose in enumerate(rows)]
    )


def up_of_poses(poses: np.ndarray) -> np.ndarray | None:
    """Returns the vertical of a data set whose world has z up, [3].

    It is None if the first pose is the identity: then another program wrote it in this layout,
    whose world is the first camera.
    """
    return None if np.allclose(poses[0], np.eye(4), atol=1e-6) else UP_Z


def nearest(times: np.ndarray, others: np.ndarray, max_gap: float) -> np.ndarray:
    """Finds the index of the time nearest to each time; -1 if none is close enough.

    Args:
        times: [n] [s], in any order.
        others: [m] [s], in any order, m >= 1.
        max_gap: the largest difference [s].
    """
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    right = np.searchsorted(ordered, times).clip(0, len(others) - 1)
    left = (right - 1).clip(0)
    is_left = np.abs(ordered[left] - times) <= np.abs(ordered[right] - times)
    best = np.where(is_left, left, right)
    return np.where(np.abs(ordered[best] - times) <= max_gap, order[best], -1)


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Converts a quaternion w x y z [4] to a rotation matrix [3, 3].

    A length that differs from 1 by rounding is corrected.

    Raises:
        ForeignFileError: not finite, or not of unit length.
    """
    length = float(np.sqrt(np.sum(np.square(quaternion))))
    if not abs(length - 1.0) <= MAX_DRIFT:  # NaN makes the comparison false
        raise ForeignFileError(f"the rotation is no unit quaternion, its length is {length:g}")
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """Converts a rotation matrix [3, 3] to a quaternion w x y z [4], with w >= 0."""
    return Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True)


def quaternion_pose(source: Path, which: str, position: np.ndarray, xyzw: np.ndarray) -> np.ndarray:
    """Makes the matrix [4, 4] float64 of a position [3] and a unit quaternion x y z w [4].

    Args:
        source: the file that the pose is from, for the message.
        which: the pose's name in that file, for the message.
        position: of the camera.
        xyzw: rotation from the camera to the world.

    Raises:
        FormatError: not finite, too far away, or no unit quaternion.
    """
    pose = np.eye(4)
    pose[:3, 3] = position
    if not np.abs(pose[:3, 3]).max() <= MAX_DISTANCE:  # NaN makes the comparison false
        raise FormatError(source, f"{which}: the position is {pose[:3, 3].tolist()}")
    try:
        pose[:3, :3] = rotation_of(np.roll(np.asarray(xyzw, np.float64), 1))
    except ForeignFileError as error:
        raise FormatError(source, f"{which}: {error}") from None
    return pose
