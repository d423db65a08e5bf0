"""Errors that end a command with one line and no traceback."""

from pathlib import Path


class UserError(Exception):
    """Something that the user can mend, in one line."""


def check_folder_name(name: str) -> None:
    """Refuses a --name that would lead out of the folder it is meant for.

    Raises:
        UserError: the name is a path.
    """
    if Path(name).name != name or name == "..":
        raise UserError(f"--name is the name of one folder, without a path, got {name!r}")


def one_line(error: BaseException) -> str:
    """An error's text without line breaks."""
    return " ".join(str(error).split())
