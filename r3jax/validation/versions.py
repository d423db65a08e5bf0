"""Format versions: a file of another one is told as such, before anything else about it."""

from r3jax.validation.errors import ForeignFileError


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
