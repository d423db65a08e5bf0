"""Describes mistakes in a file or in a name that was typed.

The reader adds the name of the file.
"""

import difflib
from collections.abc import Iterable

from r3jax.errors import InputError


class ForeignFileError(InputError):
    """A reason not to read on."""


class VersionError(ForeignFileError):
    """The file may be whole; it is this package that does not read it."""


def check_version(found: object, newest: int, *, oldest: int = 1) -> None:
    """Refuses a format version that this package does not read.

    Args:
        found: what the file says.
        newest: the version that this package writes.
        oldest: the first one that it still reads.

    Raises:
        VersionError: says which r3jax to use.
    """
    if isinstance(found, int) and not isinstance(found, bool) and oldest <= found <= newest:
        return
    known = f"version {newest}" if oldest == newest else f"versions {oldest} to {newest}"
    age = "newer" if isinstance(found, int) and found > newest else "other"
    raise VersionError(
        f"format version {found!s:.20}, this package reads {known}: use the {age} r3jax that "
        "wrote it"
    )


def why_not_imported(error: ImportError, package: str, what_for: str, extra: str) -> str:
    """Says why a package cannot be imported, and the command that mends it.

    Args:
        error: what importing it raised.
        package: its name, which is the module's too.
        what_for: the beginning of the sentence, such as "ROS bags are read by".
        extra: the extra of r3jax that installs it.
    """
    if isinstance(error, ModuleNotFoundError) and error.name == package:
        return f"{what_for} {package}, which is not installed: pip install 'r3jax[{extra}]'"
    return (
        f"{what_for} {package}, which is installed but cannot be imported ({error!s:.200}): "
        f"pip install --force-reinstall 'r3jax[{extra}]'"
    )


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """Suggests the known name that is most like this one, as a question; else nothing."""
    close = difflib.get_close_matches(given, list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else ""
