"""Key frames, and how they move along with a trajectory that SLAM has corrected."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.formats.ros.messages import stamp_of
from r3jax.formats.ros.transforms import TransformTree
from r3jax_ros.messages import matrix_of


@dataclass(frozen=True)
class KeyFrame:
    """What is kept to map it again."""

    stamp: int
    rgb: np.ndarray
    depth: np.ndarray
    T_world_camera: np.ndarray


def has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """True from 5 cm or 5 degrees on: a robot that stands still adds nothing but memory."""
    turned = np.degrees(Rotation.from_matrix(before[:3, :3].T @ now[:3, :3]).magnitude())
    return bool(np.linalg.norm(now[:3, 3] - before[:3, 3]) > 0.05 or turned > 5.0)


def has_arrived(here: np.ndarray, view: np.ndarray, meters: float) -> bool:
    """True if a camera is this near to a view, and its line of sight within 15 degrees of it.

    The planner's views have no roll; a camera may be mounted on its side.
    """
    is_turned = here[:3, 2] @ view[:3, 2] > np.cos(np.radians(15.0))
    return bool(np.linalg.norm(view[:3, 3] - here[:3, 3]) < meters and is_turned)


def track_of(path) -> TransformTree:
    """Where the robot was at each stamp of a path."""
    tree = TransformTree()
    for stamped in path.poses:
        T = matrix_of(stamped.pose.position, stamped.pose.orientation)
        turn = Rotation.from_matrix(T[:3, :3]).as_quat()
        tree.add("world", "robot", stamp_of(stamped), T[:3, 3], turn)
    return tree


def with_later(before: TransformTree, after: TransformTree) -> TransformTree:
    """An earlier path with what a later one has added to its end: where each node was at first."""
    old, new = before.edges.get("robot"), after.edges.get("robot")
    if old is None or new is None:
        return after if old is None else before
    whole, last = TransformTree(), max(old.times)
    for edge, since in ((old, -1), (new, last)):
        for time, position, turn in zip(edge.times, edge.positions, edge.rotations, strict=True):
            if time > since:
                whole.add("world", "robot", time, position, turn)
    return whole


def corrected(
    frames: list[KeyFrame], before: TransformTree, after: TransformTree
) -> list[KeyFrame]:
    """Key frames moved as the robot's place at their time was; the latest as its last place.

    Nodes of a path may be minutes apart, as SLAM adds none while a robot stands: where both ends
    move alike, so does all between them.
    """
    if not before.edges or not after.edges:
        return frames
    times = np.array([frame.stamp for frame in frames], dtype=np.int64)
    known = np.array(before.edges["robot"].times)
    times = times.clip(known.min(), known.max())
    (old, was), (new, now) = (tree.edges["robot"].at(times, np.inf) for tree in (before, after))
    moves = np.where((was & now)[:, None, None], new @ np.linalg.inv(old), np.eye(4))
    return [replace(frame, T_world_camera=move @ frame.T_world_camera) for frame, move in
            zip(frames, moves, strict=True)]  # fmt: skip


def base_for_view(T_world_camera: np.ndarray, T_base_camera: np.ndarray) -> np.ndarray:
    """The place on the floor, x ahead and z up, from which a robot's camera has a view.

    The camera may be mounted anywhere, tilted and turned: the robot turns so that the headings of
    the wanted line of sight and of its own agree, and stands so that the camera is above the right
    place. Of a camera that looks straight up or down the images' upper edges decide.

    Args:
        T_world_camera: the view, [4, 4].
        T_base_camera: where the camera is mounted, [4, 4].
    """
    yaw = _heading(T_world_camera) - _heading(T_base_camera)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = T_world_camera[:2, 3] - T[:2, :2] @ T_base_camera[:2, 3]
    return T


def _heading(T: np.ndarray) -> float:
    """Angle of the line of sight in the plane [rad]."""
    is_vertical = np.hypot(*T[:2, 2]) < 1e-3
    axis = -T[:2, 1] * np.sign(-T[2, 2]) if is_vertical else T[:2, 2]
    return float(np.arctan2(axis[1], axis[0]))
