"""Names of files that somebody else's file gives: they may not lead out of its folder."""

from pathlib import Path, PurePosixPath

from r3jax.formats.validation.errors import ForeignFileError

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
    if path.is_absolute():
        raise ForeignFileError(f"{shown} is an absolute path, it must be relative to the folder")
    if ".." in name.replace("\\", "/").split("/"):
        raise ForeignFileError(f"{shown} leads out of the folder: make it relative to the folder")
    if not path.parts:
        raise ForeignFileError(f"{shown} is a folder, a file should be named")
    return path


def below(folder: Path, name: str) -> Path:
    """The path of a file in `folder`.

    Raises:
        ForeignFileError: see `check_relative`.
    """
    return folder.joinpath(*check_relative(name).parts)
