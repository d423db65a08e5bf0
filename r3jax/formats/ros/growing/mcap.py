"""Follows an MCAP: its records are readable before the summary at its end is there.

    magic, then records: operation (1 byte), length (8 bytes), content
    Schema    id, name, encoding, data                  Channel  id, schema, topic, encoding, ...
    Message   channel, sequence, time, time, data       Chunk    times, size, crc, packed records

(https://mcap.dev/spec). Nothing is read twice but what is asked for again.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

from r3jax.formats.ros.growing.record_files import Channel, GrowingFile, Note
from r3jax.formats.ros.unpack import unpack_chunk
from r3jax.validation.errors import ForeignFileError

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
        """Messages of one record of the file; takes note of schemas and channels."""
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
        """The records of a chunk, unpacked; the last one is kept."""
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
    """Operation, beginning and end of each record of a chunk."""
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
    """A text with its length before it, and where it ends."""
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    if end > len(data):
        raise struct.error
    return data[at + 4 : end].decode("utf-8", errors="replace"), end
