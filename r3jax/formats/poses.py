"""Poses from files: what rounding did to a rotation is mended, anything worse is refused."""

from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError
from r3jax.geometry.cameras import rigid_error

MAX_DRIFT = 0.02
"""Rotations off by at most this (text with few digits, long chains of products) are mended."""

_ROUNDING = 1e-6
"""Rotations off by at most this stay as they are: float32 stores no better."""


MAX_DISTANCE = 1e12
"""Cameras farther from the origin than this are nowhere: squares would leave float32."""


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
