"""Commands in names of policies: `exec:python my_policy.py`. Imports nothing heavy."""

import shlex
import shutil
from pathlib import Path

from r3jax.errors import InputError

COMMAND = "exec:"
"""Prefix of the names of such policies."""


def words_of(command: str) -> list[str]:
    """Splits a command into its program and arguments, as a shell does.

    Raises:
        ValueError: there is no such program, or a quotation mark is open.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"policy {COMMAND}{command}: {error}") from None
    if not words:
        raise InputError(f"policy {COMMAND!r} needs a command: {COMMAND}PROGRAM ARGUMENTS")
    if shutil.which(words[0]) is None:
        raise InputError(
            f"policy {COMMAND}{command}: there is no program {words[0]!r}; a script needs its "
            f"interpreter, as in {COMMAND}python my_policy.py"
        )
    return words


def short_name(name: str) -> str:
    """Returns the name of a policy in folders.

    It is the class of `package.module:Class`, or the script of a command.
    """
    if not name.startswith(COMMAND):
        return name.rpartition(":")[2]
    words = [word for word in words_of(name.removeprefix(COMMAND)) if not word.startswith("-")]
    # The script, not its interpreter, nor what the script is told.
    # A number is no suffix: `python3.11` is no script.
    scripts = [word for word in words if Path(word).suffix.strip(".0123456789")] or words[:1]
    return Path(scripts[0]).stem
