"""Reads a bag while it is being recorded.

An MCAP can be followed, alone or in the folder that `ros2 bag record` makes (all its parts): its
records are readable before the summary at its end is there. A recorder writes by chunks of about a
megabyte, so a frame comes in with its chunk. SQLite (.db3) is not followed, as a reader would lock
the recorder out, nor is a bag of ROS 1 (.bag.active).

    magic, then records: operation (1 byte), length (8 bytes), content
    Schema    id, name, encoding, data                  Channel  id, schema, topic, encoding, ...
    Message   channel, sequence, time, time, data       Chunk    times, size, crc, packed records

(https://mcap.dev/spec). At 30 frames a second most are alike: a frame is taken half a second after
the last one, if the camera has moved since, and if nothing that is still to come can change its
pose.
"""

import os
import re
import struct
import weakref
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.ros.bag_reader import BagReading
from r3jax.formats.ros.bags import MessageTypes, Stamped, Topics, reading, unpack_chunk
from r3jax.formats.ros.messages import CAMERA_INFO, COMPRESSED, IMAGE
from r3jax.formats.ros.topics import POSES, TF
from r3jax.geometry.cameras import angle_between
from r3jax.validation.errors import ForeignFileError


class Channel(NamedTuple):
    """A topic in one file."""

    topic: str
    kind: str
    """Type of its messages, such as sensor_msgs/msg/Image."""

    definition: str
    """What a message looks like; empty: the file does not say."""

    language: str
    """ros2msg, ros2idl, or nothing."""


class Note(NamedTuple):
    """Where a message lies."""

    channel: Channel
    time: int
    """When it was recorded [ns]."""

    chunk: int
    """Where its chunk begins in the file [bytes]; -1: it lies in none."""

    begin: int
    """In the unpacked chunk, or in the file [bytes]."""

    end: int


class GrowingFile:
    """A file that another program appends to; it stays open when it is renamed."""

    def __init__(self, path: Path):
        """Opens it; raises OSError."""
        self._file = path.open("rb")
        weakref.finalize(self, self._file.close)

    @property
    def size(self) -> int:
        """What there is of it so far [bytes]."""
        return os.fstat(self._file.fileno()).st_size

    def part(self, begin: int, end: int) -> bytes | None:
        """Reads the bytes from `begin` to `end`; None unless all of them have been written."""
        if end > self.size:
            return None
        found = os.pread(self._file.fileno(), end - begin, begin)
        return found if len(found) == end - begin else None


_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END, _FOOTER = 0x03, 0x04, 0x05, 0x06, 0x0F, 0x02
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MAX_SMALL = 1 << 20
"""A schema or channel is never larger [bytes]."""


class McapFollower:
    """Reads the messages of an MCAP that grows."""

    def __init__(self, path: Path):
        """Opens the file; raises OSError."""
        self._file, self._at, self._is_whole = GrowingFile(path), 0, False
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, Channel] = {}
        self._unpacked = (-1, b"")

    def advance(self) -> list[Note]:
        """Finds the messages of all records that have become whole since."""
        if self._at == 0:
            magic = self._file.part(0, len(_MAGIC))
            if magic is None:
                return []
            if magic != _MAGIC:
                raise ForeignFileError("this is no MCAP")
            self._at = len(_MAGIC)
        notes: list[Note] = []
        while not self._is_whole and (head := self._file.part(self._at, self._at + _HEAD.size)):
            operation, length = _HEAD.unpack(head)
            begin = self._at + _HEAD.size
            if begin + length > self._file.size:
                break
            notes += self._record(operation, begin, begin + length)
            self._at = begin + length
        return notes

    def read(self, note: Note) -> bytes:
        """Reads a message's data."""
        if note.chunk >= 0:
            return self._chunk(note.chunk)[note.begin : note.end]
        data = self._file.part(note.begin, note.end)
        if data is None:
            raise ForeignFileError("the bag has become shorter")
        return data

    def _record(self, operation: int, begin: int, end: int) -> list[Note]:
        """Reads the messages of one record of the file; notes schemas and channels."""
        self._is_whole = operation in (_DATA_END, _FOOTER)  # the summary repeats what was there
        if operation == _MESSAGE:
            head = self._file.part(begin, min(end, begin + _MESSAGE_HEAD.size)) or b""
            return self._message(head, -1, begin, end)
        if operation == _CHUNK:
            records = self._chunk(begin)
            found: list[Note] = []
            for inner, first, last in _records(records):
                if inner == _MESSAGE:
                    head = records[first : min(last, first + _MESSAGE_HEAD.size)]
                    found += self._message(head, begin, first, last)
                else:
                    self._declare(inner, records[first : min(last, first + _MAX_SMALL)])
            return found
        if operation in (_SCHEMA, _CHANNEL):
            self._declare(operation, self._file.part(begin, min(end, begin + _MAX_SMALL)) or b"")
        return []

    def _chunk(self, begin: int) -> bytes:
        """Unpacks the records of a chunk, and caches the last one."""
        if self._unpacked[0] != begin:
            head = self._file.part(begin - _HEAD.size, begin) or bytes(_HEAD.size)
            data = self._file.part(begin, begin + _HEAD.unpack(head)[1]) or b""
            try:
                _, _, size, _ = _CHUNK_HEAD.unpack_from(data)
                name, at = _text(data, _CHUNK_HEAD.size)
                (length,) = struct.unpack_from("<Q", data, at)
            except struct.error:
                raise ForeignFileError("a chunk is damaged") from None
            packed = data[at + 8 : at + 8 + length]
            self._unpacked = (begin, unpack_chunk(packed, name, size))
        return self._unpacked[1]

    def _message(self, head: bytes, chunk: int, begin: int, end: int) -> list[Note]:
        if len(head) < _MESSAGE_HEAD.size:
            raise ForeignFileError("a message is damaged")
        number, _, time, _ = _MESSAGE_HEAD.unpack(head)
        channel = self._channels.get(number)
        if channel is None:
            raise ForeignFileError("a message has no channel")
        return [Note(channel, time, chunk, begin + _MESSAGE_HEAD.size, end)]

    def _declare(self, operation: int, data: bytes) -> None:
        """Takes note of a schema or a channel."""
        try:
            if operation == _SCHEMA:
                (number,) = struct.unpack_from("<H", data)
                name, at = _text(data, 2)
                language, at = _text(data, at)
                self._schemas[number] = (name, _text(data, at)[0], language)
            elif operation == _CHANNEL:
                number, schema = struct.unpack_from("<HH", data)
                kind, definition, language = self._schemas.get(schema, ("", "", ""))
                channel = Channel(_text(data, 4)[0], kind, definition, language)
                self._channels.setdefault(number, channel)
        except struct.error:
            raise ForeignFileError("a record is damaged") from None


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields the operation, beginning and end of each record of a chunk."""
    at = 0
    while at < len(data):
        if at + _HEAD.size > len(data):
            raise ForeignFileError("a chunk is damaged")
        operation, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if at + length > len(data):
            raise ForeignFileError("a chunk is damaged")
        yield operation, at, at + length
        at += length


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Reads a text with its length before it, and returns where it ends."""
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    if end > len(data):
        raise struct.error
    return data[at + 4 : end].decode("utf-8", errors="replace"), end


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

    def __init__(self, path: Path):
        """Knows nothing yet; raises FormatError where rosbags is not installed.

        Args:
            path: what the bag is called in messages.
        """
        self.path = path
        self.types: dict[str, str] = {}
        self.left_out: list[str] = []
        self._files: dict[Path, McapFollower] = {}
        self._notes: list[tuple[Path, Note]] = []
        self._by_topic: dict[str, list[int]] = {}
        self._messages = MessageTypes(path, is_ros1=False)
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
                    self._files[file] = McapFollower(file)
                for note in self._files[file].advance():
                    if note.channel.kind in _READ:
                        self._by_topic.setdefault(note.channel.topic, []).append(len(self._notes))
                        self._notes.append((file, note))
                        self.types[note.channel.topic] = note.channel.kind

    def topics(self, *types: str) -> list[str]:
        """Lists the topics of these types, sorted."""
        return sorted(name for name, one in self.types.items() if one in types)

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[Stamped]:
        """Yields messages of some topics, as in `Bag.messages`, in the order of the file."""
        found = sorted(i for topic in topics for i in self._by_topic.get(topic, ()))
        for file, note in (self._notes[i] for i in found):
            if (start is None or start <= note.time) and (stop is None or note.time < stop):
                yield self._message(file, note)

    def fresh(self, topics: Collection[str]) -> Iterator[Stamped]:
        """Yields messages of some topics that arrived since the last call."""
        first, self._fresh = self._fresh, len(self._notes)
        for file, note in self._notes[first:]:
            if note.channel.topic in topics:
                yield self._message(file, note)

    def first(self, topic: str) -> Any:
        """Reads the first message of a topic."""
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
    """Lists the files of a bag that may still be recorded, in their order.

    The list is empty if there is no such bag.

    Args:
        path: an MCAP, or a folder with its parts.

    Raises:
        FormatError: SQLite or ROS 1 while it is recorded; says what to do.
    """
    if path.is_file():
        _refuse(path, [path])
        return [path] if path.suffix == ".mcap" else []
    if not path.is_dir():
        _refuse(path, [one for one in [path.with_name(f"{path.name}.active")] if one.exists()])
        return []
    entries = sorted(path.iterdir(), key=_numbered)
    if not (path / "metadata.yaml").exists():
        _refuse(path, entries)
    return [one for one in entries if one.suffix == ".mcap" and one.is_file()]


def _refuse(path: Path, found: list[Path]) -> None:
    """Refuses files that cannot be followed."""
    if any(one.suffix == ".db3" for one in found):
        raise FormatError(
            path,
            "a bag in SQLite (.db3) is not followed while it is recorded, as reading it may stop "
            "the recorder: record an MCAP (ros2 bag record --storage mcap), or give the bag when "
            "it is finished",
        )
    if any(one.name.endswith(".bag.active") for one in found):
        raise FormatError(
            path,
            "a bag of ROS 1 (.bag.active) is not followed while it is recorded: wait until the "
            "recorder has closed it, and give the .bag",
        )


def _numbered(path: Path) -> tuple[int, str]:
    """Returns a sort key by number: drive_10.mcap comes after drive_9.mcap."""
    number = re.search(r"_(\d{1,9})\.mcap$", path.name)
    return int(number[1]) if number else 0, path.name


class FollowedBag:
    """A bag that grows, as posed images of what is certain so far."""

    def __init__(self, path: Path, topics: Topics | None = None):
        """Looks at nothing yet; raises FormatError where rosbags is not installed.

        Args:
            path: as in `growing_files`.
            topics: names of topics and frames; what is not named is guessed.
        """
        self._path, self._topics = path, topics or Topics()
        self._bag = GrowingBag(path)
        self._reading: BagReading | None = None

    def images(self, files: list[Path]) -> PosedImages:
        """Reads the posed images that are certain by now.

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
    """Selects frames half a second apart between which the camera has moved.

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
