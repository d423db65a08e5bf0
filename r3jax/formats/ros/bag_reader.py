"""Reads bags of ROS 1 and ROS 2 with color, depth, camera_info and poses.

Color is sensor_msgs/Image (rgb8, bgr8, ...) or CompressedImage (JPEG, PNG); depth is 16UC1 in
millimeters or 32FC1 in meters (REP 118), plain or by compressedDepth. A color image takes the
depth image that is nearest in time. Poses come from tf: the chain of transforms from the root (map)
to the frame of the color images, each interpolated at the image's stamp; or from a topic with
odometry. Optical frames have the axes of OpenCV, and worlds are z up (REP 103, REP 105).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r3jax.formats.depth_images import register_depth
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.phones.shots import UP_Z
from r3jax.formats.posed_images import Pixels, PosedImages
from r3jax.formats.poses import mend_pose
from r3jax.formats.ros.bag_poses import add_transforms, find_chain
from r3jax.formats.ros.bags import Bag, find_bag
from r3jax.formats.ros.messages import depth_of, frame_of, lens_of, rgb_of, stamp_of
from r3jax.formats.ros.names import Topics
from r3jax.formats.ros.topics import (
    TF,
    ImageTopic,
    check_topics,
    find_images,
    find_info,
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

    def __len__(self) -> int:
        """Number of images."""
        return len(self.stamps)

    def take(self, chosen: np.ndarray) -> "_Images":
        """Some of them, [k]."""
        return _Images(self.topic, self.stamps[chosen], self.times[chosen])

    def read(self, bag: Bag, index: int) -> Any:
        """The message of one image."""
        time = int(self.times[index])
        for stamped in bag.messages([self.topic], time, time + 1):
            if stamp_of(stamped.message, stamped.time) == self.stamps[index]:
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
    topic, depth_topic = find_images(bag, topics)
    lens = _lens(bag, topic, topics.info)
    if lens is None:
        raise FormatError(
            bag.path,
            f"there is no camera_info that belongs to {topic.name}: record it, or name it by "
            "--topics info=TOPIC",
        )
    tree, images, depths = _scan(bag, (topic.name, depth_topic.name))
    chain, source = find_chain(bag, tree, topics, frame_of(topic.first))
    _, has_pose = tree.poses(chain, images.stamps)
    color, depth = _matched(bag, images, depths, has_pose, source)
    camera = _depth_camera(bag, tree, (topic, depth_topic), lens, topics.depth_info)
    gone = len(images) - len(color)
    lost = f" {gone} of {len(images)} frames lack depth or a pose and are left out." if gone else ""
    return PosedImages(
        path=path,
        image_paths=tuple(color.name(bag, i) for i in range(len(color))),
        lenses=(lens,) * len(color),
        poses=np.stack(
            [mend_pose(bag.path, "a pose", pose) for pose in tree.poses(chain, color.stamps)[0]]
        ),
        depth_paths=tuple(depth.name(bag, i) for i in range(len(color))),
        pixels=Pixels(
            lambda index: _rgb(bag, color, index, lens),
            lambda index: _depth(bag, depth, index, lens, camera),
        ),
        depth_lenses=None if camera.own is None else (camera.own,) * len(color),
        up=UP_Z if chain[-1] in _WORLDS else None,
        remark=f"Color is {topic.name}, depth {depth_topic.name}, poses are those of {chain[0]} in "
        f"{chain[-1]} by {source}.{camera.remark}{lost}",
    )


def _matched(
    bag: Bag, images: _Images, depths: _Images, has_pose: np.ndarray, source: str
) -> tuple[_Images, _Images]:
    """Color images that have a pose and depth, and the depth image nearest in time to each.

    Raises:
        FormatError: there is none; says what is lacking.
    """
    start = int(images.stamps[0])
    at = nearest((images.stamps - start) * 1e-9, (depths.stamps - start) * 1e-9, _MAX_GAP)
    chosen = np.flatnonzero((at >= 0) & has_pose)
    if not len(chosen):
        raise FormatError(
            bag.path,
            f"of {len(images)} images on {images.topic} none has both a depth image on "
            f"{depths.topic} within {_MAX_GAP:g} s ({int((at >= 0).sum())} have one) and a pose by "
            f"{source} ({int(has_pose.sum())} have one): do their clocks differ?",
        )
    return images.take(chosen), depths.take(at[chosen])


def _rgb(bag: Bag, images: _Images, index: int, lens: Lens) -> np.ndarray:
    """Colors [H, W, 3] uint8."""
    with naming(images.name(bag, index)):
        rgb = rgb_of(images.read(bag, index))
        if rgb.shape[:2] != (lens.height, lens.width):
            raise ForeignFileError(
                f"the image has {rgb.shape[1]} x {rgb.shape[0]} pixels, its camera_info says "
                f"{lens.width} x {lens.height}"
            )
        return rgb


def _depth(bag: Bag, depths: _Images, index: int, lens: Lens, camera: "_DepthCamera") -> np.ndarray:
    """z-depth [h, w] float32, registered where it is not."""
    with naming(depths.name(bag, index)):
        depth = depth_of(depths.read(bag, index))
    if camera.elsewhere is None:
        return depth
    depth_lens, T_color_depth = camera.elsewhere
    return register_depth(depth, depth_lens, lens, T_color_depth)


def _scan(bag: Bag, names: tuple[str, str]) -> tuple[TransformTree, _Images, _Images]:
    """All of /tf and /tf_static and the times of the images of two topics, in one pass."""
    tree = TransformTree()
    found: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
    for one in bag.messages([*bag.topics(*TF), *names]):
        if one.topic in found:
            found[one.topic].append((stamp_of(one.message, one.time), one.time))
        else:
            add_transforms(tree, one)
    for name in names:
        if not found[name]:
            raise FormatError(bag.path, f"there is no message on {name}")
    color, depth = (_Images(name, *np.array(found[name], np.int64).T) for name in names)
    return tree, color, depth


def _lens(bag: Bag, image: ImageTopic, named: str | None) -> Lens | None:
    """The lens of a topic's images; None where no camera_info belongs to it."""
    name = find_info(bag, image, named)
    if name is None:
        return None
    with naming(bag.path / name.lstrip("/")):
        return lens_of(bag.first(name), is_rectified="rect" in image.name.rpartition("image")[2])


class _DepthCamera(NamedTuple):
    """How depth images lie to the color images."""

    own: Lens | None = None
    """Lens of a depth camera at the place of the color camera; None: it covers what that does."""

    elsewhere: tuple[Lens, np.ndarray] | None = None
    """Lens of a depth camera elsewhere, and `T_color_depth` [4, 4]."""

    remark: str = ""


def _depth_camera(
    bag: Bag,
    tree: TransformTree,
    images: tuple[ImageTopic, ImageTopic],
    lens: Lens,
    named: str | None,
) -> _DepthCamera:
    """Where the depth camera is: by tf, if the frames differ.

    Raises:
        FormatError: elsewhere, and not to be registered here.
    """
    color, depth = (frame_of(image.first) for image in images)
    depth_lens = _lens(bag, images[1], named)
    own = _DepthCamera(own=depth_lens if lens.is_pinhole else None)
    if color == depth:
        return own
    upwards = {frame: tree.chain(frame) for frame in (color, depth)}
    if upwards[color][-1] != upwards[depth][-1]:
        note = f" No transform leads from {depth} to {color}: they count as one place."
        return own._replace(remark=note)
    at = np.array([stamp_of(images[0].first)])
    T_root = {frame: tree.poses(chain, at)[0][0] for frame, chain in upwards.items()}
    move = np.linalg.inv(T_root[color]) @ T_root[depth]
    if np.allclose(move, np.eye(4), atol=1e-4):
        return own
    if depth_lens is None or not lens.is_pinhole:
        raise FormatError(
            bag.path,
            f"{images[1].name} is not registered to {images[0].name}, and the cameras are not "
            "known well enough to do it here: record registered depth (RealSense: "
            "align_depth.enable:=true)",
        )
    return _DepthCamera(elsewhere=(depth_lens, move))
