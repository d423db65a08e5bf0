"""What all files of bags have in common while they grow: they are read up to what is whole."""

import os
import weakref
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable


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


@runtime_checkable
class Follower(Protocol):
    """Reads a file that grows."""

    def advance(self) -> list[Note]:
        """Finds the messages that have come since; raises ForeignFileError, OSError."""
        ...

    def read(self, note: Note) -> bytes:
        """Reads a message's data; raises ForeignFileError, OSError."""
        ...


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
        """The bytes from `begin` to `end`; None where they have not all been written."""
        if end > self.size:
            return None
        found = os.pread(self._file.fileno(), end - begin, begin)
        return found if len(found) == end - begin else None
