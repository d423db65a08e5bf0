"""Reading bytes from a path that may be a pipe, a device or far too large."""

import codecs
import os
import stat
from pathlib import Path

from r3jax.validation.errors import ForeignFileError

_SMALL = 1 << 20
"""Files of /proc say that they are empty and are not [bytes]."""

_POINTER = b"version https://git-lfs.github.com/spec/"
"""How the file begins that Git leaves in place of one that Git LFS keeps elsewhere."""

_MAX_POINTER = 1024
"""Pointers are smaller than this [bytes]."""


def check_regular(path: str | Path) -> int:
    """Size of a regular file [bytes]; links are followed.

    Opening a pipe would wait for ever, and a device such as /dev/zero has no end.

    Raises:
        ForeignFileError: a folder, a pipe, a device, no name of a file at all, or a pointer of Git
            LFS in place of a file.
        OSError: missing, or not permitted.
    """
    try:
        found = os.stat(path)
    except ValueError as error:  # a zero byte in the name
        raise ForeignFileError(f"this cannot be the name of a file ({error})") from None
    if stat.S_ISDIR(found.st_mode):
        raise ForeignFileError("this is a folder, a file should be here")
    if not stat.S_ISREG(found.st_mode):
        raise ForeignFileError("this is a pipe or a device, a file should be here")
    if len(_POINTER) < found.st_size < _MAX_POINTER:
        with open(path, "rb") as file:
            if file.read(len(_POINTER)) == _POINTER:
                raise ForeignFileError(
                    "this is a pointer of Git LFS and not the file itself: fetch the files by `git "
                    "lfs pull` in the folder of the repository"
                )
    return found.st_size


def read_bytes(path: str | Path, limit: int) -> bytes:
    """The whole content of a regular file.

    Args:
        path: the file.
        limit: files larger than this are not what they claim to be [bytes].

    Raises:
        ForeignFileError: not a regular file, or too large.
        OSError: missing, or not permitted.
    """
    size = check_regular(path)
    if size > limit:
        raise ForeignFileError(
            f"the file has {size >> 20} MiB, more than {limit >> 20} MiB: it is something else"
        )
    with open(path, "rb") as file:
        # Python makes room for all that is asked for, before it reads.
        return file.read(min(limit, max(size, _SMALL)))


def plain_text(data: bytes) -> bytes:
    """Removes a byte order mark, and turns UTF-16 into UTF-8: programs of Windows write both."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def check_tree(folder: Path) -> None:
    """Refuses a folder with pipes or devices below it: a library would wait for them for ever.

    Raises:
        ForeignFileError: says which.
        OSError: not a folder, or not permitted.
    """
    for path in folder.rglob("*"):
        if not path.is_dir():
            try:
                check_regular(path)
            except FileNotFoundError:
                raise ForeignFileError(f"{path.name} is a link that leads nowhere") from None
            except ForeignFileError as error:
                raise ForeignFileError(f"{path.name}: {error}") from None
