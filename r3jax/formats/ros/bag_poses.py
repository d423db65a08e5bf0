"""Poses in a bag: transforms of /tf and /tf_static, or a topic that holds one pose a message."""

from typing import Any

import numpy as np

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.bags import Bag, Stamped
from r3jax.formats.ros.messages import frame_of, stamp_of
from r3jax.formats.ros.names import Topics
from r3jax.formats.ros.topics import find_pose
from r3jax.formats.ros.transforms import TransformTree


def add_transforms(tree: TransformTree, one: Stamped) -> None:
    """Adds a message of /tf or /tf_static."""
    is_static = one.topic.endswith("tf_static")
    for sample in one.message.transforms:
        move = sample.transform
        tree.add(
            frame_of(sample),
            str(sample.child_frame_id).lstrip("/"),
            None if is_static else stamp_of(sample, one.time),
            _vector(move.translation),
            _vector(move.rotation, "xyzw"),
        )


def find_chain(bag: Bag, tree: TransformTree, topics: Topics, camera: str) -> tuple[list[str], str]:
    """Finds the frames from the camera to the world, and the topic that says how they move.

    Args:
        bag: that may hold a topic with poses.
        tree: the transforms of tf; the poses of a topic are added to it.
        topics: what is named.
        camera: the frame of the images.

    Raises:
        FormatError: no transforms lead there, or none of them moves; says what to record.
    """
    name = topics.pose
    if name is None and not tree.is_moving(tree.chain(camera, topics.world)):
        name = find_pose(bag)
    moved = None if name is None else _add_poses(bag, tree, topics, name, camera)
    chain = tree.chain(camera, topics.world)
    if moved is not None and moved not in chain[:-1]:
        raise FormatError(
            bag.path,
            f"{name} says where {moved} is, but no transform leads there from {camera}, the frame "
            f"of the images: record /tf_static, too; or, if {name} is the camera's own pose, give "
            f"--topics pose={name},frame={camera}",
        )
    if topics.world is not None and chain[-1] != topics.world:
        raise FormatError(
            bag.path, f"no transform leads from {camera} to {topics.world}, only to {chain[-1]}"
        )
    if not tree.is_timed(chain):
        raise FormatError(
            bag.path,
            f"nothing says where {camera}, the frame of the images, was: record /tf and "
            "/tf_static, or odometry (--topics pose=TOPIC)",
        )
    return chain, name or "tf"


def _add_poses(bag: Bag, tree: TransformTree, topics: Topics, name: str, camera: str) -> str:
    """Adds the poses of a topic as transforms; returns the frame that they move."""
    child = topics.frame or str(getattr(bag.first(name), "child_frame_id", "")).lstrip("/")
    child = child or camera
    tree.edges.pop(child, None)
    for one in bag.messages([name]):
        place, turn = _pose_of(one.message)
        stamp = stamp_of(one.message, one.time)
        tree.add(frame_of(one.message), child, stamp, _vector(place), _vector(turn, "xyzw"))
    return child


def _pose_of(message: Any) -> tuple[Any, Any]:
    """Position and orientation of a message that holds one pose."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose  # with a covariance
    return pose.position, pose.orientation


def _vector(message: Any, names: str = "xyz") -> np.ndarray:
    return np.array([getattr(message, name) for name in names], dtype=np.float64)
