"""Names of files that somebody else's file gives: they may not lead out of its folder."""

import os
import re
from pathlib import Path, PurePosixPath, PureWindowsPath

from r3jax.validation.errors import ForeignFileError

_LONGEST = 1000
"""No folder structure needs longer names, and messages stay short [characters]."""


def check_relative(name: str) -> PurePosixPath:
    """A relative path that stays below the folder it is relative to.

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
    """The path of a file in `folder`, as the computer that wrote its name may have spelled it.

    Where there is no such file, backslashes count as slashes, an ending may be of the other case
    (.PNG for .png), and of an absolute path that part counts which leads to a file in the folder.

    Raises:
        ForeignFileError: see `check_relative`.
    """
    is_plain = "\\" not in name and not _is_absolute(name)
    if not is_plain and "\0" not in name and len(name) <= _LONGEST:
        name = _respelled(folder, name)
    return _namesake(folder.joinpath(*check_relative(name).parts))


def _is_absolute(name: str) -> bool:
    """True for the absolute paths of any system."""
    return name.startswith(("/", "\\")) or re.match(r"[A-Za-z]:[\\/]", name) is not None


def _respelled(folder: Path, name: str) -> str:
    """A name of Windows, or an absolute one, as a file of the folder is called here."""
    parts = PureWindowsPath(name).parts
    if ".." in parts or os.path.exists(folder / name.lstrip("/")):
        return name
    if not _is_absolute(name):
        return "/".join(parts)
    tails = ("/".join(parts[i:]) for i in range(1, len(parts)))
    return next((tail for tail in tails if os.path.exists(_namesake(folder / tail))), name)


def _namesake(path: Path) -> Path:
    """The file, or where it is missing the one whose ending has the other case."""
    if not path.suffix or os.path.exists(path):  # no matter how long the name is
        return path
    others = (path.with_suffix(path.suffix.lower()), path.with_suffix(path.suffix.upper()))
    return next((other for other in others if os.path.exists(other)), path)
