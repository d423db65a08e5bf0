"""Writes that are either complete or not there, and one writer at a time."""

import contextlib
import fcntl
import os
import re
import secrets
from collections.abc import Iterable
from io import FileIO
from pathlib import Path

_PARTIAL = re.compile(r"\..+\.[0-9a-f]{8}\.partial")
"""Temporary names of `write_atomic`."""


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


def remove_partial(folder: Path) -> None:
    """Deletes what `write_atomic` left in a folder when it was killed; never through a link.

    Raises:
        OSError: not permitted.
    """
    if folder.is_symlink():
        return
    for entry in folder.glob(".*.partial"):
        if _PARTIAL.fullmatch(entry.name):
            entry.unlink(missing_ok=True)


def remove_own(folder: Path, patterns: Iterable[str]) -> None:
    """Deletes files of a folder by their names, then the folders that have become empty.

    Args:
        folder: where to look.
        patterns: what to delete, relative to it, such as `frames/*.png`. Nothing is deleted
            through a link; a link of such a name is deleted, what it leads to is not.

    Raises:
        OSError: not permitted.
    """
    root = folder.resolve()
    found = [path for pattern in patterns for path in root.glob(pattern)]
    found = [path for path in found if path.parent.resolve() == path.parent]
    for path in found:
        if path.is_symlink() or not path.is_dir():
            path.unlink(missing_ok=True)
    folders = {parent for path in found for parent in path.parents if root in parent.parents}
    folders |= {path for path in found if path.is_dir() and not path.is_symlink()}
    for path in sorted(folders, key=lambda path: len(path.parts), reverse=True):
        with contextlib.suppress(OSError):  # the user keeps something in it
            path.rmdir()


def append_line(path: Path, line: str) -> None:
    """Appends one line and flushes it to the disk; a failed append is taken back.

    Raises:
        OSError: the disk is full, not writable, ...; the file is a link, and so perhaps not ours.
    """
    with open(path, "ab", opener=_open_no_link) as file:
        before = file.tell()
        try:
            file.write(line.encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            # A torn line would hide behind the next one; readers skip only the last line.
            os.truncate(path, before)
            raise


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


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
    descriptor = _open_no_link(str(folder / "lock"), os.O_RDWR | os.O_CREAT)
    file = FileIO(descriptor, "w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        file.close()
        raise
    return file
