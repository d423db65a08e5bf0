"""Bags of ROS 1 and ROS 2, opened by `rosbags`: topics, and messages by topic and time.

A bag is a file of ROS 1 (.bag), of ROS 2 (.mcap or .db3), or the folder that `ros2 bag record`
writes (metadata.yaml). All errors of `rosbags` about damaged bags are converted to one type, and
chunks are never unpacked to more than their declared size.
"""

import bz2
import dataclasses
import io
import os
import sys
import weakref
from collections.abc import Collection, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Protocol, runtime_checkable

from r3jax.errors import InputError
from r3jax.formats.errors import FormatError, naming
from r3jax.validation.database import check_database
from r3jax.validation.errors import ForeignFileError, why_not_imported
from r3jax.validation.files import check_regular

SUFFIXES = (".bag", ".mcap", ".db3")
"""Files of ROS 1, and of ROS 2's two storages."""

_METADATA = "metadata.yaml"

_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")
"""Of a .db3."""

_LANGUAGES = {"MSG": "ros2msg", "IDL": "ros2idl", "NONE": ""}
"""Of rosbags' formats of definitions."""

_SCHEMAS = ("ros2msg", "ros2idl", "omgidl", "")
"""Encodings of schemas in an MCAP that rosbags reads."""


class Stamped(NamedTuple):
    """A message as it lies in a bag."""

    topic: str
    time: int
    """When it was recorded [ns]; its own stamp may be another."""

    message: Any


@runtime_checkable
class AnyBag(Protocol):
    """What is read of a bag, whether it is whole or grows."""

    path: Path
    types: dict[str, str]
    """Type of the messages of every topic that has some, such as sensor_msgs/msg/Image."""

    left_out: list[str]
    """Topics whose type cannot be parsed."""

    def topics(self, *types: str) -> list[str]:
        """Lists the topics of these types, sorted."""
        ...

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[Stamped]:
        """Yields messages of some topics, recorded from `start` until before `stop` [ns]."""
        ...

    def first(self, topic: str) -> Any:
        """Reads the first message of a topic."""
        ...


class _File(io.BufferedReader):
    """A file that makes no more room for a damaged number of bytes than it has itself."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(min(-1 if size is None else size, os.fstat(self.fileno()).st_size))


class _BagPath(type(Path())):
    """A path that rosbags opens in that way, and all paths below it."""

    def open(self, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        return _File(io.FileIO(self)) if mode == "rb" else super().open(mode, *args, **kwargs)


class Bag:
    """An opened bag; it closes itself when it is garbage-collected."""

    def __init__(self, path: Path):
        """Opens it and reads what topics it has.

        Args:
            path: the file or folder.

        Raises:
            FormatError: rosbags is not installed; no bag, one that is damaged, or not finished.
        """
        rosbag1, rosbag2, _ = _load_rosbags(path)
        self.path = path
        files = [path] if path.is_file() else list(path.iterdir())
        for file in files:
            with naming(file):
                check_regular(file)
        is_ros1 = path.suffix.lower() == ".bag"
        with self._reading("opened"):
            for file in files:
                if file.suffix.lower() == ".db3":
                    check_database(file, _TABLES)
            self._reader: Any = (rosbag1 if is_ros1 else rosbag2).Reader(_BagPath(path))
            self._reader.open()
            weakref.finalize(self, self._reader.close)
        self._messages = MessageTypes(path, is_ros1=is_ros1)
        self.types: dict[str, str] = {}
        """Type of the messages of every topic that has some, such as sensor_msgs/msg/Image."""

        self.left_out: list[str] = []
        """Topics whose type cannot be parsed, such as those of a recorded service, sorted."""

        for one in sorted(self._reader.connections, key=lambda one: one.topic):
            if one.msgcount and self._messages.register(
                one.msgtype, one.msgdef.data, _LANGUAGES[one.msgdef.format.name]
            ):
                self.types[one.topic] = one.msgtype
            elif one.msgcount and one.topic not in self.left_out:
                self.left_out.append(one.topic)

    def topics(self, *types: str) -> list[str]:
        """Lists the topics of these types, sorted."""
        return sorted(name for name, one in self.types.items() if one in types)

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[Stamped]:
        """Yields messages of some topics in the order of their recording.

        Args:
            topics: their names.
            start: recorded then or later [ns]; None: from the beginning.
            stop: recorded before [ns]; None: to the end.

        Raises:
            FormatError: the bag is damaged there.
        """
        wanted = [one for one in self._reader.connections if one.topic in topics and one.msgcount]
        if not wanted:
            return
        with self._reading("read"):
            found = self._reader.messages(wanted, start, stop)
            for connection, time, data in found:
                message = self._messages.read(data, connection.msgtype)
                yield Stamped(connection.topic, time, message)

    def first(self, topic: str) -> Any:
        """Reads the first message of a topic.

        Raises:
            FormatError: the bag is damaged there, or promises messages that are not there.
        """
        for stamped in self.messages([topic]):
            return stamped.message
        raise FormatError(self.path, f"there is no message on {topic}")

    def _reading(self, what: str) -> AbstractContextManager[None]:
        return reading(self.path, what)


@contextmanager
def reading(path: Path, what: str) -> Generator[None]:
    """Names the bag in whatever goes wrong in rosbags, SQLite or a decompressor.

    Raises:
        FormatError: the block raised anything.
    """
    try:
        yield
    except (FormatError, GeneratorExit):
        raise
    except Exception as error:
        reason = f"{error!s:.200}" or type(error).__name__
        raise FormatError(
            path,
            f"the bag cannot be {what} ({reason}): record or copy it again, or try "
            "`ros2 bag reindex` or `rosbag reindex`",
        ) from None


class MessageTypes:
    """Types of messages by what bags say of them, for bags that rosbags does not open."""

    def __init__(self, path: Path, *, is_ros1: bool):
        """Knows none yet; raises FormatError where rosbags is not installed.

        Args:
            path: for what is wrong.
            is_ros1: messages are stored as ROS 1 does it.
        """
        *_, self._typesys = _load_rosbags(path)
        self._store: Any = self._typesys.get_typestore(self._typesys.Stores.EMPTY)
        self._known: set[str] = set()
        self._is_ros1 = is_ros1

    def register(self, kind: str, definition: str, language: str) -> bool:
        """Takes note of a type, once; False where it cannot be parsed.

        Args:
            kind: the type, such as sensor_msgs/msg/Image.
            definition: what its messages look like; empty: as in the latest ROS 2.
            language: ros2msg, or one of the kinds of IDL.
        """
        if kind not in self._known:
            try:
                self._register(kind, definition, language)
            except Exception:  # of a definition, its grammar, or the code that is made of it
                return False
        return kind in self._store.fielddefs

    def read(self, data: bytes, kind: str) -> Any:
        """Makes a message of its data, of a type that is registered; raises what rosbags does."""
        read = self._store.deserialize_ros1 if self._is_ros1 else self._store.deserialize_cdr
        return read(data, kind)

    def _register(self, kind: str, definition: str, language: str) -> None:
        if not definition:  # bags of ROS 2 before Iron have none
            latest = self._typesys.get_typestore(self._typesys.Stores.LATEST)
            new = dict(latest.fielddefs)
        elif language == "ros2msg":
            new = self._typesys.get_types_from_msg(definition, kind)
        else:
            line = "=" * 80 + "\n"
            parts = [part.partition("\n")[2] for part in definition.split(line)[1:]]
            new = {}
            for part in parts or [definition]:
                new |= self._typesys.get_types_from_idl(part)
        known = self._store.fielddefs
        self._store.register({name: fields for name, fields in new.items() if name not in known})
        self._known.add(kind)


def find_bag(path: Path) -> Path | None:
    """Finds the bag at a path: the path itself, or the only bag file in a folder."""
    if path.is_file():
        return path if path.suffix.lower() in SUFFIXES else None
    if not path.is_dir():
        return None
    bags = [one for one in sorted(path.iterdir()) if one.suffix.lower() in SUFFIXES]
    if (path / _METADATA).exists() and (bags or any(path.glob("*.zstd"))):
        return path
    return bags[0] if len(bags) == 1 and bags[0].is_file() else None


def is_bag(path: Path) -> bool:
    """Returns True if a file or folder looks like a bag of ROS."""
    return find_bag(path) is not None


def _load_rosbags(path: Path) -> tuple[ModuleType, ModuleType, ModuleType]:
    try:
        from rosbags import rosbag1, rosbag2, typesys
    except ImportError as error:
        reason = why_not_imported(error, "rosbags", "ROS bags are read by", "ros")
        raise FormatError(path, reason) from None
    _limit_chunks()
    _pass_over_schemas()
    return rosbag1, rosbag2, typesys


def _pass_over_schemas() -> None:
    """Makes rosbags open an MCAP that holds channels of another language beside those of ROS."""
    from rosbags.rosbag2 import storage_mcap

    with suppress(AttributeError):  # another version: it keeps its own
        read = storage_mcap.get_msgdef
        if read.__module__ == storage_mcap.__name__:
            storage_mcap.get_msgdef = lambda schema: read(
                schema if schema is None or schema.encoding in _SCHEMAS else None
            )


def _limit_chunks() -> None:
    """Makes rosbags unpack no more of a chunk than it says, and than a recorder puts into one."""
    from rosbags.rosbag1 import reader
    from rosbags.rosbag2 import storage_mcap

    with suppress(AttributeError):  # another version: it keeps its own
        for name in storage_mcap.DECOMPRESSORS:
            storage_mcap.DECOMPRESSORS[name] = lambda data, size, name=name: unpack_chunk(
                data, name, size
            )
    with suppress(AttributeError):
        for name in reader.decompressors:
            reader.decompressors[name] = lambda data, name=name: unpack_chunk(data, name)


MAX_CHUNK = 256 << 20
"""Recorders begin another chunk after about a megabyte; some users let them wait longer [bytes]."""


def unpack_chunk(data: bytes, compression: str, size: int | None = None) -> bytes:
    """Unpacks a chunk.

    Args:
        data: as it is stored.
        compression: lz4, zstd or bz2; nothing or none: it is not packed.
        size: what it must come to [bytes]; None: not known.

    Raises:
        ForeignFileError: another compression, damaged, of another size, or too large.
    """
    most = MAX_CHUNK if size is None else size
    if most > MAX_CHUNK:
        raise ForeignFileError(f"a chunk of {size} bytes exceeds the limit of {MAX_CHUNK}")
    found = data if compression in ("", "none") else _unpacked(data, compression, most + 1)
    if len(found) > most or size not in (None, len(found)):
        raise ForeignFileError(f"a chunk does not unpack to {most} bytes")
    return found


def _unpacked(data: bytes, compression: str, most: int) -> bytes:
    """Reads at most this number of bytes of it."""
    decompressor = _decompressor(compression)
    try:
        return decompressor.decompress(data, max_length=most)
    except Exception as error:  # each decompressor has its own
        raise ForeignFileError(f"a chunk cannot be unpacked ({error!s:.200})") from None


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    if compression == "zstd":
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
        return zstd.ZstdDecompressor()
    raise ForeignFileError(f"unsupported compression of chunks: {compression[:20]!r}")


@dataclass(frozen=True)
class Topics:
    """Names of topics and frames; None is guessed."""

    color: str | None = None
    """Color images."""

    depth: str | None = None
    """Depth images."""

    info: str | None = None
    """Camera of the color images."""

    depth_info: str | None = None
    """Camera of the depth images."""

    pose: str | None = None
    """Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped in place of tf."""

    frame: str | None = None
    """Frame that the poses of `pose` are of; by default the message's child_frame_id, else the
    optical frame of the camera."""

    world: str | None = None
    """Frame of tf that poses are given in; by default the root, such as map."""


def parse_topics(text: str | None) -> Topics | None:
    """Reads names such as "color=/camera/color/image_raw,pose=/odom"; None stays None.

    Raises:
        ValueError: a word that is no such pair, or another key.
    """
    if text is None:
        return None
    known = [field.name for field in dataclasses.fields(Topics)]
    found: dict[str, str] = {}
    for word in filter(None, (word.strip() for word in text.split(","))):
        key, _, name = (part.strip() for part in word.partition("="))
        if key not in known or not name:
            raise InputError(
                f"topics are named like color=/camera/color/image_raw,pose=/odom with "
                f"{', '.join(known)}; got {word!r}"
            )
        found[key] = name
    return Topics(**found)
