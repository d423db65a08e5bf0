"""What can go wrong with somebody else's files."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from r3jax.formats.validation.errors import ForeignFileError


class FormatError(ValueError):
    """A file or folder that cannot be read; names it and the reason."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason


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


def check_capture(path: Path) -> None:
    """Refuses what is neither a folder nor nerfstudio's file, before anything heavy is imported.

    Raises:
        FormatError: says what a capture is.
    """
    if not path.exists():
        raise FormatError(path, "there is no such folder")
    if path.is_file() and path.suffix != ".json":
        raise FormatError(path, f"this is a file; {_advice(path)}")


def _advice(path: Path) -> str:
    if path.suffix.lower() == ".r3d":
        return (
            "the archives of Record3D are not read: make nerfstudio's transforms.json of it, with "
            "a depth_file_path for every frame"
        )
    return "a capture is a folder, or nerfstudio's transforms.json"
