"""Follows a bag of ROS 1 (.bag.active): its chunks are readable before the index is there.

    "#ROSBAG V2.0", then records: length, fields "name=value", length, data
    Chunk (op 5)   compression, size; its data are records of connections (7) and messages (2)

(https://wiki.ros.org/Bags/Format/2.0). A chunk counts once its size is there: the recorder writes a
0 first, then the messages, and goes back to the size at the end.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from r3jax.formats.ros.growing.record_files import Channel, GrowingFile, Note
from r3jax.formats.ros.unpack import unpack_chunk
from r3jax.validation.errors import ForeignFileError

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_LENGTH = struct.Struct("<I")
_MAX_HEADER = 1 << 16


class _Record(NamedTuple):
    fields: dict[bytes, bytes]
    begin: int
    """Of its data [bytes]."""

    end: int

    @property
    def operation(self) -> int:
        """What it is; 0: unknown."""
        return int.from_bytes(self.fields.get(b"op", b""), "little")


class Rosbag1Follower:
    """Reads the messages of a bag that grows."""

    def __init__(self, path: Path):
        """Opens the file; raises OSError."""
        self._file, self._at = GrowingFile(path), 0
        self._channels: dict[int, Channel] = {}
        self._chunks: dict[int, tuple[str, int]] = {}
        self._unpacked = (-1, b"")

    def advance(self) -> list[Note]:
        """Finds the messages of all chunks that have become whole since."""
        if self._at == 0:
            magic = self._file.part(0, len(_MAGIC))
            if magic is None:
                return []
            if magic != _MAGIC:
                raise ForeignFileError("this is no bag of ROS 1, version 2.0")
            self._at = len(_MAGIC)
        notes: list[Note] = []
        while (record := self._next()) is not None:
            if record.operation == _CHUNK:
                if record.begin == record.end:  # it is being written
                    break
                notes += self._messages(record)
            self._at = record.end
        return notes

    def read(self, note: Note) -> bytes:
        """Reads a message's data."""
        return self._chunk(note.chunk)[note.begin : note.end]

    def _next(self) -> _Record | None:
        """The next record of the file; None where it is not whole yet."""
        length = self._file.part(self._at, self._at + 4)
        if length is None:
            return None
        (size,) = _LENGTH.unpack(length)
        if size > _MAX_HEADER:
            raise ForeignFileError("a record is damaged")
        begin = self._at + 4
        head = self._file.part(begin, begin + size + 4)
        if head is None:
            return None
        end = begin + size + 4 + _LENGTH.unpack(head[-4:])[0]
        if end > self._file.size:
            return None
        return _Record(_fields(head[:-4]), begin + size + 4, end)

    def _messages(self, record: _Record) -> list[Note]:
        """Messages of a chunk; takes note of its connections."""
        size = int.from_bytes(record.fields.get(b"size", b""), "little")
        name = record.fields.get(b"compression", b"none").decode("utf-8", errors="replace")
        self._chunks[record.begin] = (name, record.end)
        chunk = self._chunk(record.begin, size)
        found: list[Note] = []
        for inner in _records(chunk):
            if inner.operation == _CONNECTION:
                self._connect(inner.fields, chunk[inner.begin : inner.end])
            elif inner.operation == _MESSAGE:
                number = int.from_bytes(inner.fields.get(b"conn", b""), "little")
                stamp = inner.fields.get(b"time", b"")
                if number not in self._channels or len(stamp) != 8:
                    raise ForeignFileError("a message is damaged")
                seconds, rest = struct.unpack("<II", stamp)
                time = seconds * 1_000_000_000 + rest
                found.append(
                    Note(self._channels[number], time, record.begin, inner.begin, inner.end)
                )
        return found

    def _chunk(self, begin: int, size: int | None = None) -> bytes:
        """The records of a chunk, unpacked; the last one is kept."""
        if self._unpacked[0] != begin:
            name, end = self._chunks[begin]
            data = self._file.part(begin, end)
            if data is None:
                raise ForeignFileError("the bag has become shorter")
            self._unpacked = (begin, unpack_chunk(data, name, size))
        return self._unpacked[1]

    def _connect(self, fields: dict[bytes, bytes], data: bytes) -> None:
        """Takes note of a connection."""
        text = lambda value: value.decode("utf-8", errors="replace")
        more = _fields(data)
        package, _, name = text(more.get(b"type", b"")).partition("/")
        topic = text(fields.get(b"topic", b""))
        definition = text(more.get(b"message_definition", b""))
        number = int.from_bytes(fields.get(b"conn", b""), "little")
        self._channels[number] = Channel(topic, f"{package}/msg/{name}", definition, "ros2msg")


def _fields(header: bytes) -> dict[bytes, bytes]:
    """The fields of a header."""
    found: dict[bytes, bytes] = {}
    at = 0
    while at + 4 <= len(header):
        (length,) = _LENGTH.unpack_from(header, at)
        name, is_field, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if at > len(header) or not is_field:
            raise ForeignFileError("a record is damaged")
        found[name] = value
    return found


def _records(data: bytes) -> Iterator[_Record]:
    """The records of a chunk."""
    at = 0
    while at < len(data):
        try:
            (size,) = _LENGTH.unpack_from(data, at)
            (length,) = _LENGTH.unpack_from(data, at + 4 + size)
        except struct.error:
            raise ForeignFileError("a chunk is damaged") from None
        begin = at + 8 + size
        if begin + length > len(data):
            raise ForeignFileError("a chunk is damaged")
        yield _Record(_fields(data[at + 4 : at + 4 + size]), begin, begin + length)
        at = begin + length
