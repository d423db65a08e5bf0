"""Errors about the input: the mistake, its place, and the remedy.

Everything that this package refuses on purpose is an `InputError`, which the command line prints as
one line. Any other `ValueError` is a bug, and keeps its traceback.
"""

from pathlib import Path


class InputError(ValueError):
    """A value, a setting, a name or a file that cannot be used."""


class PathError(InputError):
    """A file or folder that cannot be used; names it and the reason."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason
