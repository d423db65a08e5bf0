"""Errors that end a command with one line and no traceback."""

import contextlib
import importlib.util
import shlex
from collections.abc import Generator
from pathlib import Path

from r3jax.errors import InputError

_BLANKS = "\n\u00a0"
"""Characters that are not printable by name, but harmless."""


def check_viser() -> None:
    """Checks that viser, which shows pages, is installed.

    Raises:
        InputError: it is not installed; the message says how to get it.
    """
    if importlib.util.find_spec("viser") is None:
        raise InputError(
            "the viewer needs viser, which is not installed: pip install 'r3jax[viewer]'"
        )


def resume_command(command: str, path: Path) -> str:
    """Returns the command that resumes a run, to be copied into a shell."""
    return f"r3jax {command} --resume {shlex.quote(str(path))}"


@contextlib.contextmanager
def resumable(command: str, path: Path) -> Generator[None]:
    """Names, where Ctrl-C interrupts, the command that resumes from the files on disk.

    Raises:
        KeyboardInterrupt: as it came, with a message.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"resume with `{resume_command(command, path)}`") from None


def one_line(error: BaseException) -> str:
    """Writes an error's text without line breaks."""
    return " ".join(str(error).split())


def printable(text: str) -> str:
    """Spells out the control characters of a text: a name may contain some that move the cursor."""
    return "".join(c if c.isprintable() or c in _BLANKS else _spelled(c) for c in text)


def _spelled(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
