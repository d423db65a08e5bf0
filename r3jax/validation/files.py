"""Paths of strangers: pipes, devices and far too large files, and names that lead elsewhere."""

import codecs
import os
import re
import stat
from pathlib import Path, PurePosixPath, PureWindowsPath

from r3jax.validation.errors import ForeignFileError

_SMALL = 1 << 20
"""Files of /proc say that they are empty and are not [bytes]."""

_POINTER = b"version https://git-lfs.github.com/spec/"
"""How the file begins that Git leaves in place of one that Git LFS keeps elsewhere."""

_MAX_POINTER = 1024
"""Pointers are smaller than this [bytes]."""


def check_regular(path: str | Path) -> int:
    """Checks that a file is regular, and returns its size [bytes]; links are followed.

    Opening a pipe would block, and a device such as /dev/zero has no end.

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
    """Reads the whole content of a regular file.

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
        # Python allocates the requested size before it reads.
        return file.read(min(limit, max(size, _SMALL)))


def plain_text(data: bytes) -> bytes:
    """Removes a byte order mark, and turns UTF-16 into UTF-8: programs of Windows write both."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def check_tree(folder: Path) -> None:
    """Refuses a folder with pipes or devices below it: a library would block on them.

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


_LONGEST = 1000
"""No folder structure needs longer names, and messages stay short [characters]."""


def check_relative(name: str) -> PurePosixPath:
    """Checks that a relative path stays below the folder it is relative to.

    Links inside the folder may still lead elsewhere: they are the user's own.

    Raises:
        ForeignFileError: empty, absolute, far too long, with a step upwards (`..`), with a zero
            byte.
    """
    shown = repr(name[:80])
    if not name.strip() or "\0" in name:
        raise ForeignFileError(f"{shown} is no name of a file")
    if len(name) > _LONGEST:
        raise ForeignFileError(f"a name of {len(name)} characters is no name of a file")
    path = PurePosixPath(name)
    if _is_absolute(name):
        raise ForeignFileError(
            f"{shown} is an absolute path, and there is no such file in the folder: make it "
            "relative to the folder"
        )
    if ".." in name.replace("\\", "/").split("/"):
        raise ForeignFileError(f"{shown} leads out of the folder: make it relative to the folder")
    if not path.parts:
        raise ForeignFileError(f"{shown} is a folder, a file should be named")
    return path


def below(folder: Path, name: str) -> Path:
    """Finds a file in `folder` as the computer that wrote its name may have spelled it.

    Where there is no such file, backslashes count as slashes, an ending may be of the other case
    (.PNG for .png), and of an absolute path, or one with steps upwards, that part counts which
    leads to a file in the folder.

    Raises:
        ForeignFileError: see `check_relative`.
    """
    is_plain = "\\" not in name and ".." not in name and not _is_absolute(name)
    if not is_plain and "\0" not in name and len(name) <= _LONGEST:
        name = _respelled(folder, name)
    return _namesake(folder.joinpath(*check_relative(name).parts))


def _is_absolute(name: str) -> bool:
    """Checks for absolute paths of any operating system."""
    return name.startswith(("/", "\\")) or re.match(r"[A-Za-z]:[\\/]", name) is not None


def _respelled(folder: Path, name: str) -> str:
    """Converts a name of Windows, or one that leads elsewhere, to that of a file in the folder."""
    parts = PureWindowsPath(name).parts
    if os.path.exists(folder / name.lstrip("/")):
        return name
    if not _is_absolute(name) and ".." not in parts:
        return "/".join(parts)
    tails = ("/".join(parts[i:]) for i in range(1, len(parts)) if ".." not in parts[i:])
    return next((tail for tail in tails if os.path.exists(_namesake(folder / tail))), name)


def _namesake(path: Path) -> Path:
    """Finds the file, or if it is missing the one whose extension has the other case."""
    if not path.suffix or os.path.exists(path):  # no matter how long the name is
        return path
    others = (path.with_suffix(path.suffix.lower()), path.with_suffix(path.suffix.upper()))
    return next((other for other in others if os.path.exists(other)), path)


def printable(text: str) -> str:
    """Replaces bytes of file names that are not UTF-8, as other systems' archives leave them."""
    return os.fsencode(text).decode(errors="replace")
