"""Poses written as a position and a quaternion, as trackers and phones write them."""

from pathlib import Path

import numpy as np

from r3jax.formats.colmap.model import rotation_of
from r3jax.formats.errors import FormatError
from r3jax.formats.poses import MAX_DISTANCE
from r3jax.validation.errors import ForeignFileError


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
    x, y, z, w = xyzw
    try:
        pose[:3, :3] = rotation_of(np.array([w, x, y, z], dtype=np.float64))
    except ForeignFileError as error:
        raise FormatError(source, f"{which}: {error}") from None
    return pose
