"""Finds the topics of a bag that are color, depth, their cameras and the pose, where not named.

What a topic holds is told by its first message, not by its name; the name decides among several.
"""

from dataclasses import dataclass
from typing import Any

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.bags import AnyBag
from r3jax.formats.ros.messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    frame_of,
    is_color,
    is_depth,
    is_gray,
)
from r3jax.formats.ros.names import Topics

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
            raise FormatError(bag.path, f"there is no topic {name} in it, only {_listed(bag)}")


@dataclass(frozen=True)
class ImageTopic:
    """A topic with images."""

    name: str
    first: Any
    """Its first message."""


def find_images(bag: AnyBag, topics: Topics) -> tuple[ImageTopic, ImageTopic]:
    """Color and depth: the named ones, else those that look most like a registered pair.

    Raises:
        FormatError: there is no color or no depth; says what there is and what to do.
    """
    images = [ImageTopic(name, bag.first(name)) for name in bag.topics(IMAGE, COMPRESSED)]
    by_name = {one.name: one for one in images}
    for name in (topics.color, topics.depth):
        if name is not None and name not in by_name:
            raise FormatError(bag.path, f"{name} holds no images but {bag.types[name]}")
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
                f"there are no {kind} images ({what}) in it, only {_listed(bag)}: record them, too",
            )
    pairs = [(_likeness(color, depth), color, depth) for color in colors for depth in depths]
    _, color, depth = max(pairs, key=lambda pair: pair[0])
    return color, depth


def _likeness(color: ImageTopic, depth: ImageTopic) -> tuple[bool, ...]:
    """How likely two topics are the color and depth of one camera."""
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
    """The namespace of an image's topic, that its camera_info shares."""
    for suffix in _TRANSPORTS:
        topic = topic.removesuffix(suffix)
    return topic.rpartition("/")[0].lstrip("/")


def find_info(bag: AnyBag, image: ImageTopic, named: str | None) -> str | None:
    """Topic of an image's camera: its sibling, else the only one of the same frame."""
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
    """The topic that most likely says where the robot is."""
    found = [name for kind in POSES for name in bag.topics(kind)]
    return found[0] if found else None


def _listed(bag: AnyBag) -> str:
    """Some topics and their types."""
    shown = [f"{name} ({kind.rpartition('/')[2]})" for name, kind in sorted(bag.types.items())]
    more = f" and {len(shown) - 12} more" if shown[12:] else ""
    return (", ".join(shown[:12])[:1000] or "nothing") + more + not_parsed(bag)


def not_parsed(bag: AnyBag) -> str:
    """A part of a sentence on the topics that are left out."""
    if not bag.left_out:
        return ""
    more = f" and {len(bag.left_out) - 4} more" if bag.left_out[4:] else ""
    return f"; left out, as their type cannot be parsed: {', '.join(bag.left_out[:4])}{more}"
