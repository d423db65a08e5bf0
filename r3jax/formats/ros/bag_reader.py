"""Reads bags of ROS 1 and ROS 2 with color, depth, camera_info and poses.

Color is sensor_msgs/Image (rgb8, bgr8, ...) or CompressedImage (JPEG, PNG); depth is 16UC1 in
millimeters or 32FC1 in meters (REP 118), plain or by compressedDepth. A color image takes the
depth image that is nearest in time. Poses come from tf: the chain of transforms from the root (map)
to the frame of the color images, each interpolated at the image's stamp; or from a topic with
odometry. Optical frames have the axes of OpenCV, and worlds are z up (REP 103, REP 105).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r3jax.formats.depth import register_depth
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import Pixels, PosedImages, left_out
from r3jax.formats.poses import UP_Z, mend_pose, nearest
from r3jax.formats.ros.bags import AnyBag, Bag, Stamped, Topics, find_bag
from r3jax.formats.ros.messages import depth_of, frame_of, lens_of, rgb_of, stamp_of
from r3jax.formats.ros.topics import (
    TF,
    ImageTopic,
    PoseTopic,
    add_transforms,
    check_topics,
    find_chain,
    find_images,
    find_info,
    find_pose_topic,
    not_parsed,
)
from r3jax.formats.ros.transforms import TransformTree
from r3jax.validation.errors import ForeignFileError

_MAX_GAP = 0.02
"""Color and depth farther apart than this do not belong together [s]."""

_WORLDS = ("map", "odom", "world", "earth")
"""Roots of tf whose z axis is the vertical (REP 105)."""


@dataclass(frozen=True)
class ImageTimes:
    """The images of a topic: when they were taken, and where they lie in the bag."""

    topic: str
    stamps: np.ndarray
    """By their headers, [n] int64 [ns]."""

    times: np.ndarray
    """By the bag, [n] int64 [ns]."""

    def __len__(self) -> int:
        """Returns the number of images."""
        return len(self.stamps)

    def take(self, chosen: np.ndarray) -> "ImageTimes":
        """Selects some of the images, [k]."""
        return ImageTimes(self.topic, self.stamps[chosen], self.times[chosen])

    def read(self, bag: AnyBag, index: int) -> Any:
        """Reads the message of one image."""
        time = int(self.times[index])
        for stamped in bag.messages([self.topic], time, time + 1):
            if stamp_of(stamped.message, stamped.time) == self.stamps[index]:
                return stamped.message
        raise FormatError(bag.path, f"an image on {self.topic} has been removed")

    def name(self, bag: AnyBag, index: int) -> Path:
        """Names an image in messages: its topic and its stamp [s]."""
        seconds, rest = divmod(int(self.stamps[index]), 1_000_000_000)
        return bag.path / self.topic.lstrip("/") / f"{seconds}.{rest:09d}"


Choice = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""Which frames to take, by their stamps [n] int64 [ns], their poses [n, 4, 4], and the stamp up to
which these are certain: indices [k], ascending."""


def read_bag(path: Path | str, topics: Topics | None = None) -> PosedImages:
    """Opens a bag, reads all but the pixels and checks it.

    Args:
        path: the .bag, .mcap or .db3, or the folder with metadata.yaml.
        topics: names of topics and frames; what is not named is guessed.

    Raises:
        FormatError: rosbags is not installed; a damaged bag; no color, depth or camera_info; no
            transforms or odometry that say where the camera was; no image that has all of them.
    """
    path = Path(path)
    bag = Bag(find_bag(path) or path)
    reading = BagReading(path, bag, topics or Topics())
    reading.add(bag.messages(reading.names))
    return reading.images()


class BagReading:
    """What is known of a bag but the pixels: cameras, transforms, and when images were taken."""

    def __init__(self, path: Path, bag: AnyBag, topics: Topics):
        """Finds the topics and the cameras; raises FormatError as `read_bag`."""
        self._path, self._bag, self._topics = path, bag, topics
        check_topics(bag, topics)
        self._color, self._depth = find_images(bag, topics)
        lens = _lens(bag, self._color, topics.info)
        if lens is None:
            raise FormatError(
                bag.path,
                f"there is no camera_info for {self._color.name}: record it, or name "
                "it by --topics info=TOPIC",
            )
        self._lens, self._tree = lens, TransformTree()
        self._found: dict[str, list[tuple[int, int]]] = {self._color.name: [], self._depth.name: []}
        self._pose: PoseTopic | None = None

    @property
    def names(self) -> list[str]:
        """Topics whose messages are to be added."""
        pose = [] if self._pose is None else [self._pose.name]
        return [*self._bag.topics(*TF), *self._found, *pose]

    def add(self, messages: Iterable[Stamped]) -> None:
        """Takes note of messages."""
        pose = self._pose
        for one in messages:
            if one.topic in self._found:
                self._found[one.topic].append((stamp_of(one.message, one.time), one.time))
            elif pose is not None and one.topic == pose.name:
                pose.add(self._tree, one)
            else:
                add_transforms(self._tree, one, but=None if pose is None else pose.child)

    def images(self, choose: Choice | None = None) -> PosedImages:
        """Builds the posed images of all that was added so far; raises FormatError as `read_bag`.

        Args:
            choose: tells which of the images to take, in the order of time; None: all that have
                a pose and depth.
        """
        bag, tree = self._bag, self._tree
        frame = frame_of(self._color.first)
        images, depths = (_images_of(bag, name, found) for name, found in self._found.items())
        if self._pose is None:
            self._choose_pose(frame)
        chain = find_chain(bag, tree, self._topics, frame, self._pose)
        source = "tf" if self._pose is None else self._pose.name
        total = len(images)
        _, has_pose = tree.poses(chain, images.stamps)
        color, depth = _matched(bag, images, depths, has_pose, source)
        poses, _ = tree.poses(chain, color.stamps)
        if choose is not None:
            until = min(int(depths.stamps.max()), tree.latest(chain))
            chosen = choose(color.stamps, poses, until)
            if not len(chosen):
                raise FormatError(bag.path, "no frame has both of the transforms around it yet")
            color, depth, poses = color.take(chosen), depth.take(chosen), poses[chosen]
        camera = _depth_camera(
            bag, tree, (self._color, self._depth), self._lens, self._topics.depth_info
        )
        gone = 0 if choose is not None else total - len(color)
        lost = left_out(gone, total)
        return PosedImages(
            path=self._path,
            image_paths=tuple(color.name(bag, i) for i in range(len(color))),
            lenses=(self._lens,) * len(color),
            poses=np.stack([mend_pose(bag.path, "a pose", pose) for pose in poses]),
            depth_paths=tuple(depth.name(bag, i) for i in range(len(color))),
            pixels=Pixels(
                lambda index: _rgb(bag, color, index, self._lens),
                lambda index: _depth(bag, depth, index, self._lens, camera),
            ),
            depth_lenses=None if camera.own is None else (camera.own,) * len(color),
            up=UP_Z if chain[-1] in _WORLDS else None,
            remark=f"Color is {color.topic}, depth {depth.topic}, poses are those of {chain[0]} in "
            f"{chain[-1]} by {source}{not_parsed(bag)}."
            f"{camera.remark}{'' if lost is None else f' {lost}'}",
        )

    def _choose_pose(self, frame: str) -> None:
        """Looks for a topic with poses where tf does not move, and adds what it holds."""
        pose = find_pose_topic(self._bag, self._tree, self._topics, frame)
        if pose is not None:
            self._tree.edges.pop(pose.child, None)
            self._pose = pose
            self.add(self._bag.messages([pose.name]))


def _matched(
    bag: AnyBag, images: ImageTimes, depths: ImageTimes, has_pose: np.ndarray, source: str
) -> tuple[ImageTimes, ImageTimes]:
    """Finds color images that have a pose and depth, and the depth image nearest in time to each.

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


def _rgb(bag: AnyBag, images: ImageTimes, index: int, lens: Lens) -> np.ndarray:
    """Reads colors [H, W, 3] uint8."""
    with naming(images.name(bag, index)):
        rgb = rgb_of(images.read(bag, index))
        if rgb.shape[:2] != (lens.height, lens.width):
            raise ForeignFileError(
                f"the image has {rgb.shape[1]} x {rgb.shape[0]} pixels, its camera_info says "
                f"{lens.width} x {lens.height}"
            )
        return rgb


def _depth(
    bag: AnyBag, depths: ImageTimes, index: int, lens: Lens, camera: "_DepthCamera"
) -> np.ndarray:
    """Reads z-depth [h, w] float32, and registers it where it is not."""
    with naming(depths.name(bag, index)):
        depth = depth_of(depths.read(bag, index))
    if camera.elsewhere is None:
        return depth
    depth_lens, T_color_depth = camera.elsewhere
    return register_depth(depth, depth_lens, lens, T_color_depth)


def _images_of(bag: AnyBag, name: str, found: list[tuple[int, int]]) -> ImageTimes:
    if not found:
        raise FormatError(bag.path, f"there is no message on {name}")
    return ImageTimes(name, *np.array(found, np.int64).T)


def _lens(bag: AnyBag, image: ImageTopic, named: str | None) -> Lens | None:
    """Finds the lens of a topic's images; None if no camera_info belongs to it."""
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
    bag: AnyBag,
    tree: TransformTree,
    images: tuple[ImageTopic, ImageTopic],
    lens: Lens,
    named: str | None,
) -> _DepthCamera:
    """Locates the depth camera by tf, if the frames differ.

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
        note = f" There is no transform from {depth} to {color}: they are taken as equal."
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
