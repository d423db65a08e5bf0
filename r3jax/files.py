"""Writes that are either complete or not there, and one writer at a time."""

import fcntl
import os
import secrets
from io import FileIO
from pathlib import Path


def write_atomic(path: Path, data: bytes) -> None:
    """Writes a file under a temporary name, flushes it to the disk, then renames it.

    A reader sees the old file or the new one, never a part. Of several writers at once, the last
    to rename wins; each has a temporary name of its own, on whatever machine it runs.

    Raises:
        OSError: the disk is full, not writable, ...; nothing is left behind then.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def append_line(path: Path, line: str) -> None:
    """Appends one line and flushes it to the disk; a failed append is taken back.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    with open(path, "ab") as file:
        before = file.tell()
        try:
            file.write(line.encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            # A torn line would hide behind the next one; readers skip only the last line.
            os.truncate(path, before)
            raise


def sync_folder(path: Path) -> None:
    """Makes the names in a folder survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock_folder(folder: Path) -> FileIO:
    """Takes the lock of a folder: an open file `lock` in it; closing it frees the lock.

    The lock dies with its process, so that none is ever stale.

    Raises:
        BlockingIOError: another process, or another part of this one, holds it.
        OSError: the folder cannot be written.
    """
    # For reading too: a pipe of that name would wait for a reader.
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    file = FileIO(descriptor, "w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        file.close()
        raise
    return file
