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
