"""Reads bags of ROS 1 and ROS 2 with color, depth, camera_info and poses.

Color is sensor_msgs/Image (rgb8, bgr8, ...) or CompressedImage (JPEG, PNG); depth is 16UC1 in
millimeters or 32FC1 in meters (REP 118), plain or by compressedDepth. A color image takes the
depth image that is nearest in time. Poses come from tf: the chain of transforms from the root (map)
to the frame of the color images, each interpolated at the image's stamp; or from a topic with
odometry. Optical frames have the axes of OpenCV, and worlds are z up (REP 103, REP 105).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.formats.depth_images import register_depth
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.phones.shots import UP_Z
from r3jax.formats.posed_images import Pixels, PosedImages
from r3jax.formats.poses import mend_pose
from r3jax.formats.ros.bags import Bag, Stamped, find_bag
from r3jax.formats.ros.messages import depth_of, frame_of, lens_of, rgb_of, stamp_of
from r3jax.formats.ros.names import Topics
from r3jax.formats.ros.topics import (
    TF,
    ImageTopic,
    check_topics,
    find_images,
    find_info,
    find_pose,
)
from r3jax.formats.ros.transforms import TransformTree
from r3jax.formats.sequences.tum import nearest
from r3jax.formats.validation.errors import ForeignFileError

_MAX_GAP = 0.02
"""Color and depth farther apart than this do not belong together [s]."""

_WORLDS = ("map", "odom", "world", "earth")
"""Roots of tf whose z axis is the vertical (REP 105)."""


@dataclass(frozen=True)
class _Images:
    """The images of a topic: when they were taken, and where they lie in the bag."""

    topic: str
    stamps: np.ndarray
    """By their headers, [n] int64 [ns]."""

    times: np.ndarray
    """By the bag, [n] int64 [ns]."""

    def read(self, bag: Bag, index: int) -> Any:
        """The message of one image."""
        time = int(self.times[index])
        for stamped in bag.messages([self.topic], time, time + 1):
            if _stamp(stamped.message, stamped.time) == self.stamps[index]:
                return stamped.message
        raise FormatError(bag.path, f"an image on {self.topic} is not there any more")

    def name(self, bag: Bag, index: int) -> Path:
        """What an image is called in messages: the topic and its stamp [s]."""
        seconds, rest = divmod(int(self.stamps[index]), 1_000_000_000)
        return bag.path / self.topic.lstrip("/") / f"{seconds}.{rest:09d}"


def read_bag(path: Path | str, topics: Topics | None = None) -> PosedImages:
    """Opens a bag, reads all but the pixels and checks it.

    Args:
        path: the .bag, .mcap or .db3, or the folder with metadata.yaml.
        topics: names of topics and frames; what is not named is guessed.

    Raises:
        FormatError: rosbags is not installed; a damaged bag; no color, depth or camera_info; no
            transforms or odometry that say where the camera was; no image that has all of them.
    """
    path, topics = Path(path), topics or Topics()
    bag = Bag(find_bag(path) or path)
    check_topics(bag, topics)
    color, depth = find_images(bag, topics)
    lens = _lens(bag, color, topics.info)
    if lens is None:
        raise FormatError(
            bag.path,
            f"there is no camera_info that belongs to {color.name}: record it, or name it by "
            "--topics info=TOPIC",
        )
    tree, images, depths = _scan(bag, (color.name, depth.name))
    chain, source = _chain(bag, tree, topics, frame_of(color.first))
    start = int(images.stamps[0])
    at = nearest((images.stamps - start) * 1e-9, (depths.stamps - start) * 1e-9, _MAX_GAP)
    poses, has_pose = tree.poses(chain, images.stamps)
    chosen = np.flatnonzero((at >= 0) & has_pose)
    if not len(chosen):
        raise FormatError(
            bag.path,
            f"of {len(images.stamps)} images on {color.name} none has both a depth image on "
            f"{depth.name} within {_MAX_GAP:g} s ({int((at >= 0).sum())} have one) and a pose by "
            f"{source} ({int(has_pose.sum())} have one): do their clocks differ?",
        )
    move, note = _registration(bag, tree, (color, depth), int(images.stamps[chosen[0]]))
    depth_lens = _lens(bag, depth, topics.depth_info)
    if move is not None and (depth_lens is None or not lens.is_pinhole):
        raise FormatError(
            bag.path,
            f"{depth.name} is not registered to {color.name}, and the cameras are not known well "
            "enough to do it here: record registered depth (RealSense: align_depth.enable:=true)",
        )

    def rgb(index: int) -> np.ndarray:
        number = int(chosen[index])
        with naming(images.name(bag, number)):
            return _checked(rgb_of(images.read(bag, number)), lens)

    def z_depth(index: int) -> np.ndarray:
        number = int(at[chosen[index]])
        with naming(depths.name(bag, number)):
            found = depth_of(depths.read(bag, number))
        if move is None or depth_lens is None:
            return found
        return register_depth(found, depth_lens, lens, move)

    gone = len(images.stamps) - len(chosen)
    lost = f" {gone} of {gone + len(chosen)} frames lack depth or a pose and are left out."
    has_own = move is None and depth_lens is not None and lens.is_pinhole
    return PosedImages(
        path=path,
        image_paths=tuple(images.name(bag, int(i)) for i in chosen),
        lenses=(lens,) * len(chosen),
        poses=np.stack([mend_pose(bag.path, "a pose", poses[i]) for i in chosen]),
        depth_paths=tuple(depths.name(bag, int(at[i])) for i in chosen),
        pixels=Pixels(rgb, z_depth),
        depth_lenses=(depth_lens,) * len(chosen) if has_own and depth_lens else None,
        up=UP_Z if chain[-1] in _WORLDS else None,
        remark=f"Color is {color.name}, depth {depth.name}, poses are those of {chain[0]} in "
        f"{chain[-1]} by {source}." + note + (lost if gone else ""),
    )


def _stamp(message: Any, time: int) -> int:
    """When a message was taken [ns]: as its header says, else when it was recorded."""
    return stamp_of(message) or time


def _scan(bag: Bag, names: tuple[str, str]) -> tuple[TransformTree, _Images, _Images]:
    """All of /tf and /tf_static and the times of the images of two topics, in one pass."""
    tree = TransformTree()
    found: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
    for one in bag.messages([*bag.topics(*TF), *names]):
        if one.topic in found:
            found[one.topic].append((_stamp(one.message, one.time), one.time))
        else:
            _add_transforms(tree, one)
    for name in names:
        if not found[name]:
            raise FormatError(bag.path, f"there is no message on {name}")
    color, depth = (_Images(name, *np.array(found[name], np.int64).T) for name in names)
    return tree, color, depth


def _checked(rgb: np.ndarray, lens: Lens) -> np.ndarray:
    """Colors whose size is what the camera says.

    Raises:
        FormatError: it is not; without a name, which the caller adds.
    """
    if rgb.shape[:2] != (lens.height, lens.width):
        raise ForeignFileError(
            f"the image has {rgb.shape[1]} x {rgb.shape[0]} pixels, its camera_info says "
            f"{lens.width} x {lens.height}"
        )
    return rgb


def _lens(bag: Bag, image: ImageTopic, named: str | None) -> Lens | None:
    """The lens of a topic's images; None where no camera_info belongs to it."""
    name = find_info(bag, image, named)
    if name is None:
        return None
    with naming(bag.path / name.lstrip("/")):
        return lens_of(bag.first(name), is_rectified="rect" in image.name.rpartition("image")[2])


def _add_transforms(tree: TransformTree, one: Stamped) -> None:
    """Adds a message of /tf or /tf_static."""
    is_static = one.topic.endswith("tf_static")
    for sample in one.message.transforms:
        move = sample.transform
        tree.add(
            frame_of(sample),
            str(sample.child_frame_id).lstrip("/"),
            None if is_static else _stamp(sample, one.time),
            _vector(move.translation),
            _vector(move.rotation, "xyzw"),
        )


def _vector(message: Any, names: str = "xyz") -> np.ndarray:
    return np.array([getattr(message, name) for name in names], dtype=np.float64)


def _chain(bag: Bag, tree: TransformTree, topics: Topics, camera: str) -> tuple[list[str], str]:
    """Frames from the camera to the world, and the topic that says how they move."""
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
    if not tree.is_moving(chain):
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
        stamp = _stamp(one.message, one.time)
        tree.add(frame_of(one.message), child, stamp, _vector(place), _vector(turn, "xyzw"))
    return child


def _pose_of(message: Any) -> tuple[Any, Any]:
    """Position and orientation of a message that holds one pose."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose  # with a covariance
    return pose.position, pose.orientation


def _registration(
    bag: Bag, tree: TransformTree, images: tuple[ImageTopic, ImageTopic], time: int
) -> tuple[np.ndarray | None, str]:
    """`T_color_depth` [4, 4] where the depth camera lies elsewhere, and what to remark."""
    color, depth = (frame_of(image.first) for image in images)
    if color == depth:
        return None, ""
    upwards = {frame: tree.chain(frame) for frame in (color, depth)}
    if upwards[color][-1] != upwards[depth][-1]:
        return None, f" No transform leads from {depth} to {color}: they count as one place."
    at = np.array([time])
    T_root = {frame: tree.poses(chain, at)[0][0] for frame, chain in upwards.items()}
    move = np.linalg.inv(T_root[color]) @ T_root[depth]
    return (None if np.allclose(move, np.eye(4), atol=1e-4) else move), ""
