"""Between our world and Habitat-Sim's: axes, poses, field of view. Needs no Habitat-Sim.

Ours is z-up with OpenCV camera axes. Habitat's is y-up with OpenGL camera axes (x right, y up,
z backward); its rotations are quaternions (w, x, y, z). Between the two lies the mesh file, whose
axes are its maker's. `habitat_from_world` always means the rotation [3, 3] from our world to
Habitat's: neither moves the origin nor scales.
"""

import math
from collections.abc import Sequence

import numpy as np

from r3jax.geometry.cameras import Camera, rigid_error

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Between the camera's axes; its own inverse."""

_MAX_OFF_CENTER = 1e-3
"""How far the principal point may lie from the image's center [px]."""

_MAX_STRETCH = 1e-5
"""How much the focal lengths may differ, relative to their size."""


def habitat_from_axes(up: Sequence[float | int], front: Sequence[float | int]) -> np.ndarray:
    """The rotation [3, 3] from a mesh file to Habitat's world.

    Args:
        up: direction in the file that becomes Habitat's up, +y; a stage config's `up`.
        front: direction in the file that becomes Habitat's front, -z; its `front`.

    Raises:
        ValueError: the directions are not axes of unit length at right angles.
    """
    y, z = np.asarray(up, np.float64), -np.asarray(front, np.float64)
    if y.shape != (3,) or z.shape != (3,):
        raise ValueError(f"up and front are 3 numbers each, got {y.size} and {z.size}")
    with np.errstate(all="ignore"):  # numbers of any size may stand in a file
        rotation = np.stack([np.cross(y, z), y, z])
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= 1e-6:
        raise ValueError(
            f"up {list(up)} and front {list(front)} must have unit length and be at right angles"
        )
    return rotation


BARE_GLB = habitat_from_axes((0, 0, 1), (0, 1, 0))
"""What Habitat does with a GLB that no stage config describes: (x, y, z) -> (x, z, -y)."""


def agent_from_pose(
    T_world_camera: np.ndarray, habitat_from_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The state of an agent whose camera sits in its origin.

    Args:
        T_world_camera: pose of the camera in our world, [4, 4].
        habitat_from_world: rotation [3, 3].

    Returns:
        Position in Habitat's world [3] [m] and rotation as (w, x, y, z) [4], of unit length with
        w >= 0, also where the pose is rigid up to rounding only.

    Raises:
        ValueError: the pose is not finite or not rigid.
    """
    problem = rigid_error(T_world_camera)
    if problem is not None:
        raise ValueError(problem)
    T = np.asarray(T_world_camera, np.float64)
    rotation = habitat_from_world @ T[:3, :3] @ _OPENGL_FROM_OPENCV
    return habitat_from_world @ T[:3, 3], _wxyz_of(rotation)


def pose_from_agent(
    position: np.ndarray, rotation_wxyz: np.ndarray, habitat_from_world: np.ndarray
) -> np.ndarray:
    """The inverse of `agent_from_pose`: `T_world_camera`, [4, 4] float64."""
    pose = np.eye(4)
    rotation = habitat_from_world.T @ rotation_of(rotation_wxyz)
    pose[:3, :3] = rotation @ _OPENGL_FROM_OPENCV
    pose[:3, 3] = habitat_from_world.T @ np.asarray(position, np.float64)
    return pose


def rotation_of(wxyz: np.ndarray) -> np.ndarray:
    """The rotation matrix [3, 3] of a quaternion (w, x, y, z) of any length but 0."""
    w, *axis = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _wxyz_of(rotation: np.ndarray) -> np.ndarray:
    """The quaternion (w, x, y, z), w >= 0, of the rotation nearest to a matrix [3, 3].

    The largest eigenvector of a symmetric matrix made of the rotation's entries: exact for every
    angle, half turns included (Bar-Itzhack, J. Guidance, Control and Dynamics 23(6), 2000).
    """
    trace = np.trace(rotation)
    symmetric = np.empty((4, 4))
    symmetric[0, 0] = trace
    symmetric[1:, 1:] = rotation + rotation.T - trace * np.eye(3)
    # Twice the vector part that the antisymmetric half of the matrix holds.
    turn = rotation.T - rotation
    symmetric[0, 1:] = symmetric[1:, 0] = turn[1, 2], turn[2, 0], turn[0, 1]
    wxyz = np.linalg.eigh(symmetric)[1][:, -1]
    return wxyz if wxyz[0] >= 0.0 else -wxyz


def horizontal_fov_deg(camera: Camera) -> float:
    """The horizontal field of view [deg] by which Habitat knows a camera.

    Raises:
        ValueError: Habitat cannot show this camera's image: its pixels are not square, or the
            principal point is not the image's center.
    """
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    if abs(fx - fy) > _MAX_STRETCH * fx:
        raise ValueError(
            f"Habitat's cameras have square pixels, but fx is {fx:.6g} and fy {fy:.6g} px: give "
            "a camera with fx = fy (Camera.from_fov), or use the ray caster (mesh:<file>)"
        )
    center = 0.5 * camera.width, 0.5 * camera.height
    if max(abs(cx - center[0]), abs(cy - center[1])) > _MAX_OFF_CENTER:
        raise ValueError(
            f"Habitat's cameras look through the image's center {center}, but the principal point "
            f"is ({cx:.6g}, {cy:.6g}) px: give a centered camera (Camera.from_fov), or use the "
            "ray caster (mesh:<file>)"
        )
    return math.degrees(2.0 * math.atan(0.5 * camera.width / fx))
