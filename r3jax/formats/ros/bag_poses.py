"""Poses in a bag: transforms of /tf and /tf_static, or a topic that holds one pose a message."""

from typing import Any, NamedTuple

import numpy as np

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.bags import AnyBag, Stamped
from r3jax.formats.ros.messages import frame_of, stamp_of
from r3jax.formats.ros.names import Topics
from r3jax.formats.ros.topics import find_pose
from r3jax.formats.ros.transforms import TransformTree


def add_transforms(tree: TransformTree, one: Stamped, but: str | None = None) -> None:
    """Adds a message of /tf or /tf_static, but for one frame that something else moves."""
    is_static = one.topic.endswith("tf_static")
    for sample in one.message.transforms:
        move, child = sample.transform, str(sample.child_frame_id).lstrip("/")
        if child != but:
            stamp = None if is_static else stamp_of(sample, one.time)
            turn = _vector(move.rotation, "xyzw")
            tree.add(frame_of(sample), child, stamp, _vector(move.translation), turn)


class PoseTopic(NamedTuple):
    """A topic that holds one pose a message."""

    name: str
    child: str
    """The frame that its poses are of."""

    def add(self, tree: TransformTree, one: Stamped) -> None:
        """Adds a message as a transform."""
        place, turn = _pose_of(one.message)
        stamp = stamp_of(one.message, one.time)
        tree.add(frame_of(one.message), self.child, stamp, _vector(place), _vector(turn, "xyzw"))


def find_pose_topic(
    bag: AnyBag, tree: TransformTree, topics: Topics, camera: str
) -> PoseTopic | None:
    """Finds the topic that says where the robot is; None: the transforms of tf do.

    Args:
        bag: that may hold such a topic.
        tree: the transforms of tf.
        topics: what is named.
        camera: the frame of the images.
    """
    name = topics.pose
    if name is None and not tree.is_moving(tree.chain(camera, topics.world)):
        name = find_pose(bag)
    if name is None:
        return None
    child = topics.frame or str(getattr(bag.first(name), "child_frame_id", "")).lstrip("/")
    return PoseTopic(name, child or camera)


def find_chain(
    bag: AnyBag, tree: TransformTree, topics: Topics, camera: str, pose: PoseTopic | None
) -> list[str]:
    """Finds the frames from the camera to the world.

    Args:
        bag: for what is wrong.
        tree: the transforms of tf and of the topic.
        topics: what is named.
        camera: the frame of the images.
        pose: the topic that moves a frame of them, if one does.

    Raises:
        FormatError: no transforms lead there, or none of them moves; says what to record.
    """
    chain = tree.chain(camera, topics.world)
    if pose is not None and pose.child not in chain[:-1]:
        raise FormatError(
            bag.path,
            f"{pose.name} says where {pose.child} is, but no transform leads there from {camera}, "
            f"the frame of the images: record /tf_static, too; or, if {pose.name} is the camera's "
            f"own pose, give --topics pose={pose.name},frame={camera}",
        )
    if topics.world is not None and chain[-1] != topics.world:
        raise FormatError(
            bag.path, f"no transform leads from {camera} to {topics.world}, only to {chain[-1]}"
        )
    if not tree.is_timed(chain):
        raise FormatError(
            bag.path,
            f"nothing says where {camera}, the frame of the images, was{_known(tree)}: record /tf "
            "and /tf_static, or odometry (--topics pose=TOPIC)",
        )
    return chain


def _known(tree: TransformTree) -> str:
    """A part of a sentence on the transforms that there are."""
    known = [f"{child} in {edge.parent}" for child, edge in sorted(tree.edges.items())]
    return f", tf only has {', '.join(known[:4])[:200]}" if known else ""


def _pose_of(message: Any) -> tuple[Any, Any]:
    """Position and orientation of a message that holds one pose."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose  # with a covariance
    return pose.position, pose.orientation


def _vector(message: Any, names: str = "xyz") -> np.ndarray:
    return np.array([getattr(message, name) for name in names], dtype=np.float64)
