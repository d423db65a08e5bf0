"""A bag that is being recorded, as one that is read like any other.

What can be followed: an MCAP, alone or in the folder that `ros2 bag record` makes (all its parts),
and a bag of ROS 1 (.bag.active, or .bag). A recorder writes by chunks of about a megabyte, so a
frame comes in with its chunk. SQLite (.db3) is not followed: a reader would lock the recorder out.

Of 30 frames a second nobody learns more than of 2: a frame is taken half a second after the last
one, if the camera has moved since, and if nothing that is still to come can change its pose.
"""

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.ros.bag_reader import BagReading
from r3jax.formats.ros.bags import MessageTypes, Stamped, reading
from r3jax.formats.ros.growing.mcap import McapFollower
from r3jax.formats.ros.growing.record_files import Follower, Note
from r3jax.formats.ros.growing.rosbag1 import Rosbag1Follower
from r3jax.formats.ros.messages import CAMERA_INFO, COMPRESSED, IMAGE
from r3jax.formats.ros.names import Topics
from r3jax.formats.ros.topics import POSES, TF
from r3jax.geometry.cameras import angle_between
from r3jax.validation.errors import ForeignFileError

_ACTIVE = ".bag.active"
_READ = (IMAGE, COMPRESSED, CAMERA_INFO, *TF, *POSES)
"""Types of messages that are taken note of."""

_SETTLE = 1_000_000_000
"""So much must be there before topics are chosen: the best of them may begin last [ns]."""

_PERIOD = 500_000_000
"""Between frames that are taken [ns]."""

_STEP, _TURN = 0.05, np.radians(5.0)
"""A camera that moved by less shows nothing new [m], [rad]."""

_PACKED = b"\x28\xb5\x2f\xfd"
"""How zstd begins."""


class GrowingBag:
    """What has come in of a bag so far; see `Bag`."""

    def __init__(self, path: Path, files: Collection[Path]):
        """Knows nothing yet; raises FormatError where rosbags is not installed.

        Args:
            path: what the bag is called in messages.
            files: those that are there already.
        """
        self.path = path
        self.types: dict[str, str] = {}
        self.left_out: list[str] = []
        self._files: dict[Path, Follower] = {}
        self._notes: list[tuple[Path, Note]] = []
        self._by_topic: dict[str, list[int]] = {}
        is_ros1 = not any(file.suffix == ".mcap" for file in files)
        self._messages = MessageTypes(path, is_ros1=is_ros1)
        self._fresh = 0

    @property
    def duration(self) -> int:
        """From the first message that is there to the last [ns]."""
        times = [note.time for _, note in (*self._notes[:1], *self._notes[-1:])]
        return times[-1] - times[0] if times else 0

    def advance(self, files: Collection[Path]) -> None:
        """Takes note of what has come in since.

        Args:
            files: those of the bag, in their order; there may be more than last time.

        Raises:
            FormatError: damaged.
        """
        for file in files:
            with naming(file):
                if file not in self._files:
                    kind = McapFollower if file.suffix == ".mcap" else Rosbag1Follower
                    self._files[file] = kind(file)
                for note in self._files[file].advance():
                    if note.channel.kind in _READ:
                        self._by_topic.setdefault(note.channel.topic, []).append(len(self._notes))
                        self._notes.append((file, note))
                        self.types[note.channel.topic] = note.channel.kind

    def topics(self, *types: str) -> list[str]:
        """Names of the topics of these types, sorted."""
        return sorted(name for name, one in self.types.items() if one in types)

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[Stamped]:
        """Messages of some topics, as in `Bag.messages`, in the order of the file."""
        found = sorted(i for topic in topics for i in self._by_topic.get(topic, ()))
        for file, note in (self._notes[i] for i in found):
            if (start is None or start <= note.time) and (stop is None or note.time < stop):
                yield self._message(file, note)

    def fresh(self, topics: Collection[str]) -> Iterator[Stamped]:
        """Messages of some topics that came in since this was last asked."""
        first, self._fresh = self._fresh, len(self._notes)
        for file, note in self._notes[first:]:
            if note.channel.topic in topics:
                yield self._message(file, note)

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        if topic not in self._by_topic:
            raise FormatError(self.path, f"there is no message on {topic}")
        return self._message(*self._notes[self._by_topic[topic][0]]).message

    def _message(self, file: Path, note: Note) -> Stamped:
        with reading(self.path, "read"):
            data = self._files[file].read(note)
            if data.startswith(_PACKED):
                raise FormatError(
                    self.path,
                    "its messages are packed one by one, which cannot be followed: record "
                    "without --compression-mode message",
                )
            channel = note.channel
            kind = channel.kind
            if not self._messages.register(kind, channel.definition, channel.language):
                raise ForeignFileError(f"the type {kind} of {channel.topic} cannot be parsed")
            message = self._messages.read(data, kind)
            return Stamped(channel.topic, note.time, message)


def growing_files(path: Path) -> list[Path]:
    """The files of a bag that may be being recorded, in their order; none: it is no such bag.

    Args:
        path: an MCAP, a bag of ROS 1 (whose name ends in .active as long as it is recorded), or a
            folder with either.

    Raises:
        FormatError: SQLite, of which nobody has written yet that it is finished.
    """
    active = path.with_name(f"{path.name}.active")
    if path.suffix == ".bag" and not path.exists() and active.exists():
        return [active]
    if path.is_file():
        _refuse_sqlite(path, [path] if path.suffix == ".db3" else [])
        return [path] if path.suffix in (".mcap", ".bag") or path.name.endswith(_ACTIVE) else []
    if not path.is_dir():
        return []
    entries = sorted(path.iterdir(), key=_numbered)
    if not (path / "metadata.yaml").exists():
        _refuse_sqlite(path, [one for one in entries if one.suffix == ".db3"])
    parts = [one for one in entries if one.suffix == ".mcap" and one.is_file()]
    return parts or [one for one in entries if one.name.endswith(_ACTIVE)][:1]


def _refuse_sqlite(path: Path, found: list[Path]) -> None:
    if found:
        raise FormatError(
            path,
            "a bag in SQLite (.db3) is not followed while it is recorded, as reading it may stop "
            "the recorder: record an MCAP (ros2 bag record --storage mcap), or give the bag when "
            "it is finished",
        )


def _numbered(path: Path) -> tuple[int, str]:
    """The order of drive_9.mcap and drive_10.mcap."""
    number = re.search(r"_(\d{1,9})\.mcap$", path.name)
    return int(number[1]) if number else 0, path.name


class FollowedBag:
    """A bag that grows, as posed images of what is certain so far."""

    def __init__(self, path: Path, files: list[Path], topics: Topics | None = None):
        """Looks at nothing yet; raises FormatError where rosbags is not installed.

        Args:
            path: as in `growing_files`.
            files: what that found.
            topics: names of topics and frames; what is not named is guessed.
        """
        self._path, self._topics = path, topics or Topics()
        self._bag = GrowingBag(path, files)
        self._reading: BagReading | None = None

    def images(self, files: list[Path]) -> PosedImages:
        """What is there by now.

        Args:
            files: of `growing_files`.

        Raises:
            FormatError: nothing that can be shown, with what is lacking; or damaged.
        """
        self._bag.advance(files)
        if self._reading is None:
            if self._bag.duration < _SETTLE:
                raise FormatError(self._path, "the recording has just begun")
            self._reading = BagReading(self._path, self._bag, self._topics)
        self._reading.add(self._bag.fresh(self._reading.names))
        return self._reading.images(key_frames)


def key_frames(stamps: np.ndarray, poses: np.ndarray, until: int) -> np.ndarray:
    """Frames half a second apart between which the camera has moved.

    Args:
        stamps: [n] int64 [ns], ascending.
        poses: [n, 4, 4].
        until: later frames are left out [ns].

    Returns:
        Indices [k]; of a recording that has grown they begin as before.
    """
    kept: list[int] = []
    index = 0
    while index < len(stamps) and stamps[index] <= until:
        if not kept or _has_moved(poses[kept[-1]], poses[index]):
            kept.append(index)
        index = int(np.searchsorted(stamps, stamps[index] + _PERIOD))
    return np.array(kept, np.int64)


def _has_moved(before: np.ndarray, after: np.ndarray) -> bool:
    step = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    return step > _STEP or bool(angle_between(before, after) > _TURN)
