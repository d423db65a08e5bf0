"""Finds the topics of a bag that are color, depth, their cameras and the pose, where not named.

The first message of a topic shows what it holds; the name decides among several. Poses are the
transforms of /tf and /tf_static, or those of a topic that holds one pose a message.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.bags import AnyBag, Stamped, Topics
from r3jax.formats.ros.messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    frame_of,
    is_color,
    is_depth,
    is_gray,
    stamp_of,
)
from r3jax.formats.ros.transforms import TransformTree

TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (
    ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
"""Types of topics that hold one pose a message, the most likely first."""

_TRANSPORTS = ("/compressedDepth", "/compressed")
"""What image_transport adds to the name of a topic."""


def check_topics(bag: AnyBag, topics: Topics) -> None:
    """Refuses names that the bag does not have.

    Raises:
        FormatError: lists those that there are.
    """
    for key in ("color", "depth", "info", "depth_info", "pose"):
        name = getattr(topics, key)
        if name is not None and name not in bag.types:
            raise FormatError(bag.path, f"there is no topic {name} in it, {_listed(bag)}")


@dataclass(frozen=True)
class ImageTopic:
    """A topic with images."""

    name: str
    first: Any
    """Its first message."""


def find_images(bag: AnyBag, topics: Topics) -> tuple[ImageTopic, ImageTopic]:
    """Finds the topics of color and depth.

    They are the named ones, else those that look most like a registered pair.

    Raises:
        FormatError: there is no color or no depth; says what there is and what to do.
    """
    images = [ImageTopic(name, bag.first(name)) for name in bag.topics(IMAGE, COMPRESSED)]
    by_name = {one.name: one for one in images}
    for name in (topics.color, topics.depth):
        if name is not None and name not in by_name:
            raise FormatError(bag.path, f"{name} has no images but {bag.types[name]}")
    colors = [one for one in images if is_color(one.first)]
    if not colors:  # a gray camera, or infrared
        colors = [one for one in images if is_gray(one.first) and "depth" not in one.name]
    depths = [one for one in images if is_depth(one.first)]
    if topics.color is not None:
        colors = [by_name[topics.color]]
    if topics.depth is not None:
        depths = [by_name[topics.depth]]
    for kind, found in (("color", colors), ("depth", depths)):
        if not found:
            what = (
                "rgb8, bgr8, mono8 or JPEG"
                if kind == "color"
                else "16UC1, 32FC1 or compressedDepth"
            )
            raise FormatError(
                bag.path,
                f"there are no {kind} images ({what}) in it, {_listed(bag)}: record them, too",
            )
    pairs = [(_likeness(color, depth), color, depth) for color in colors for depth in depths]
    _, color, depth = max(pairs, key=lambda pair: pair[0])
    return color, depth


def _likeness(color: ImageTopic, depth: ImageTopic) -> tuple[bool, ...]:
    """Rates how likely two topics are the color and depth of one camera."""
    has = lambda one, *words: any(word in one.name for word in words)
    is_packed = lambda one: one.name.endswith(_TRANSPORTS)
    return (
        frame_of(color.first) == frame_of(depth.first),
        has(depth, "aligned", "registered"),
        has(color, "color", "rgb"),
        not has(color, "infra", "fisheye", "mask", "debug"),
        not has(depth, "mask", "debug"),
        _parent(color.name).partition("/")[0] == _parent(depth.name).partition("/")[0],
        not is_packed(depth),
        not is_packed(color),
    )


def _parent(topic: str) -> str:
    """Returns the namespace of an image's topic, which its camera_info shares."""
    for suffix in _TRANSPORTS:
        topic = topic.removesuffix(suffix)
    return topic.rpartition("/")[0].lstrip("/")


def find_info(bag: AnyBag, image: ImageTopic, named: str | None) -> str | None:
    """Finds the topic of an image's camera: its sibling, else the only one of its frame."""
    if named is not None:
        return named
    infos = bag.topics(CAMERA_INFO)
    siblings = [name for name in infos if _parent(name) == _parent(image.name)]
    if siblings:
        return siblings[0]
    frame = frame_of(image.first)
    same = [name for name in infos if frame_of(bag.first(name)) == frame]
    return same[0] if len(same) == 1 else None


def find_pose(bag: AnyBag) -> str | None:
    """Finds the topic that is most likely the pose of the robot."""
    found = [name for kind in POSES for name in bag.topics(kind)]
    return found[0] if found else None


def _listed(bag: AnyBag) -> str:
    """Lists some topics and their types, in part of a sentence."""
    shown = [f"{name} ({kind.rpartition('/')[2]})" for name, kind in sorted(bag.types.items())]
    more = f" and {len(shown) - 12} more" if shown[12:] else ""
    listed = f"only {', '.join(shown[:12])[:1000]}" if shown else "nor any message that can be read"
    return listed + more + not_parsed(bag)


def not_parsed(bag: AnyBag) -> str:
    """Describes the topics that are left out, in part of a sentence."""
    if not bag.left_out:
        return ""
    more = f" and {len(bag.left_out) - 4} more" if bag.left_out[4:] else ""
    return f"; left out, as their type cannot be parsed: {', '.join(bag.left_out[:4])}{more}"


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
            bag.path, f"there is no transform from {camera} to {topics.world}, only to {chain[-1]}"
        )
    if not tree.is_timed(chain):
        raise FormatError(
            bag.path,
            f"there are no poses of {camera}, the frame of the images{_known(tree)}: record /tf "
            "and /tf_static, or odometry (--topics pose=TOPIC)",
        )
    return chain


def _known(tree: TransformTree) -> str:
    """Describes the transforms that there are, in part of a sentence."""
    known = [f"{child} in {edge.parent}" for child, edge in sorted(tree.edges.items())]
    return f", tf only has {', '.join(known[:4])[:200]}" if known else ""


def _pose_of(message: Any) -> tuple[Any, Any]:
    """Reads the position and orientation of a message that holds one pose."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose  # with a covariance
    return pose.position, pose.orientation


def _vector(message: Any, names: str = "xyz") -> np.ndarray:
    return np.array([getattr(message, name) for name in names], dtype=np.float64)
