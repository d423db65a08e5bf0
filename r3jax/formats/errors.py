"""Errors of files of other programs."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from r3jax.errors import PathError
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular


class FormatError(PathError):
    """A file or folder cannot be read; names it and the reason."""


@contextmanager
def naming(path: Path) -> Generator[None]:
    """Adds the name of the file to what is wrong with it.

    Raises:
        FormatError: the block raised an OSError or a ForeignFileError.
    """
    try:
        yield
    except FileNotFoundError:
        raise FormatError(path, "the file is missing") from None
    except OSError as error:
        raise FormatError(path, f"the file cannot be read ({error.strerror})") from None
    except ForeignFileError as error:
        raise FormatError(path, str(error)) from None


CAPTURE_FILES = (".json", ".zip", ".r3d", ".sens", ".bag", ".mcap", ".db3", ".db")
"""Suffixes of the files that may be a capture; all others are folders."""

_ADVICE = {
    **dict.fromkeys(
        (".mp4", ".mov", ".m4v", ".avi"),
        "this is a video without poses: ns-process-data video --data {} --output-dir OUT finds "
        "them by COLMAP, then audit OUT",
    ),
    **dict.fromkeys(
        (
            ".ply",
            ".glb",
            ".gltf",
            ".obj",
            ".usdz",
            ".usd",
            ".las",
            ".laz",
            ".e57",
            ".fbx",
            ".splat",
        ),
        "this is a file; a capture is a folder of the images that a model was made of, which no "
        "model holds: export raw data of the scan",
    ),
}
"""What to do with other files; {} is the path."""


def check_capture(path: Path) -> None:
    """Refuses a path that is neither a folder nor a capture's file. Imports nothing heavy.

    Raises:
        FormatError: lists the supported formats.
    """
    if not path.exists():
        kind = "file" if path.suffix.lower() in (*CAPTURE_FILES, *_ADVICE) else "folder"
        raise FormatError(path, f"there is no such {kind}")
    if path.is_file():
        with naming(path):
            check_regular(path)
    if path.is_file() and path.suffix.lower() not in CAPTURE_FILES:
        default = (
            "this is a file; a capture is a folder, nerfstudio's transforms.json, or an app's file "
            f"({', '.join(CAPTURE_FILES[1:])})"
        )
        raise FormatError(path, _ADVICE.get(path.suffix.lower(), default).format(path))
