"""Converts between a capture's own coordinates and those in which it is audited.

The map, the free space and the standpoints need z up and lengths on the scale of a room, while a
capture has arbitrary coordinates. A similarity transforms one into the other:

    x_audit = scale * rotation @ (x_capture - origin)

All output of the audit is transformed back.

Shape symbols: n points or poses.
"""

from dataclasses import dataclass

import numpy as np

from r3jax.errors import InputError

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
"""Names of the axes; `-y` is the opposite of `y`."""


@dataclass(frozen=True)
class Alignment:
    """A similarity between two right-handed coordinate systems."""

    rotation: np.ndarray
    """Rotation from the capture's directions to the audit's, [3, 3] float64."""

    scale: float
    """Length in the audit of one unit of the capture."""

    origin: np.ndarray
    """The audit's origin in capture coordinates, [3] float64."""

    def points(self, points_capture: np.ndarray) -> np.ndarray:
        """Transforms points [n, 3] of the capture into the audit."""
        return self.scale * (points_capture - self.origin) @ self.rotation.T

    def points_back(self, points_audit: np.ndarray) -> np.ndarray:
        """Transforms points [n, 3] of the audit into the capture: the inverse of `points`."""
        return points_audit.astype(np.float64) @ self.rotation / self.scale + self.origin

    def poses(self, poses_capture: np.ndarray) -> np.ndarray:
        """Transforms `T_world_camera` [n, 4, 4] of the capture into the audit; they stay rigid."""
        moved = poses_capture.astype(np.float64)
        moved[:, :3, :3] = self.rotation @ moved[:, :3, :3]
        moved[:, :3, 3] = self.points(moved[:, :3, 3])
        return moved

    def poses_back(self, poses_audit: np.ndarray) -> np.ndarray:
        """Transforms `T_world_camera` [n, 4, 4] back into the capture: the inverse of `poses`."""
        moved = poses_audit.astype(np.float64)
        moved[:, :3, :3] = self.rotation.T @ moved[:, :3, :3]
        moved[:, :3, 3] = self.points_back(moved[:, :3, 3])
        return moved


def evenly_spaced(count: int, most: int) -> np.ndarray:
    """Picks at most `most` indices of a sequence, from its first to its last, ascending."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def up_of(name: str) -> np.ndarray:
    """Parses a direction, an axis such as `y` or `-z` or three numbers, as a unit vector [3].

    Raises:
        ValueError: the text is neither of these.
    """
    axis = name.removeprefix("-")
    if axis in AXES:
        return (-1.0 if name.startswith("-") else 1.0) * np.asarray(AXES[axis])
    try:
        up = np.array([float(word) for word in name.split(",")])
    except ValueError:
        up = np.zeros(0)
    length = float(np.linalg.norm(up))
    if up.shape != (3,) or not 0.0 < length < np.inf:
        raise InputError(
            f"--up must be one of {', '.join([*AXES, *(f'-{axis}' for axis in AXES)])}, or a "
            f"direction such as 0.1,-0.9,0.4, got {name!r}"
        )
    return up / length


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """Computes the smallest rotation [3, 3] that takes a unit vector [3] to z.

    From -z it is half a turn about x.

    Rodrigues: with v = up x z and c = <up, z>, R = I + [v] + [v]^2 / (1 + c).
    """
    x, y, c = (float(value) for value in up)
    if c < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    R = np.eye(3) + K + K @ K / (1.0 + c)
    u, _, vt = np.linalg.svd(R)
    exact = u @ vt
    whole = np.round(exact)  # axes stay axes, without rounding
    return whole if np.abs(whole - exact).max() < 1e-12 else exact
