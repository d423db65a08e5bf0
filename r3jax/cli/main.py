"""The entry point of the command line: handles Ctrl-C before a command's imports begin."""

import os
import sys
import traceback
from collections.abc import Sequence

from r3jax.cli.errors import one_line, printable
from r3jax.errors import InputError
from r3jax.extras import naming_extras
from r3jax.interrupts import (
    INTERRUPTED,
    caught_interrupts,
    end_process,
    is_interrupted,
    settle_interrupt,
)

USER_ERROR = 2
"""Exit code of wrong input: an unknown name, a folder that exists, a broken file."""

NO_READER = 141
"""Exit code when the reader of the output is gone (`r3jax info | head`), as in shells."""


BUG = 1
"""Exit code of a bug in r3jax or in the user's policy; the traceback is printed."""

_MENDABLE = (InputError, OSError, ImportError)
"""Errors printed as one line: wrong input, a broken file, a full disk, a missing package."""


_REPORT = """
r3jax: this is a bug in r3jax, or in a policy or program that you gave it. Please report it with the
lines above, the command and the output of `r3jax info`."""


def main(args: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        args: the words after `r3jax`; None: those of this process, which ends with the command.

    Returns:
        The exit code: 0 done, 1 stopped by the disk, a cell failed, a replay differed, or a bug,
        2 wrong input, 130 interrupted, 141 the reader of the output is gone.
    """
    with caught_interrupts(stays=args is None):
        code = _main(args)
        if code == INTERRUPTED and args is None:
            # Python would wait for threads that compile, and for what an interrupted import left.
            end_process(code)
        return code


def _main(args: Sequence[str] | None) -> int:
    """Runs one command, and turns errors into messages and exit codes."""
    try:
        # Imported here: the imports of a command take a second, in which Ctrl-C works, too.
        from r3jax.cli.command_line import run_command

        with naming_extras():
            code = run_command(sys.argv[1:] if args is None else args)
        return INTERRUPTED if code == 0 and is_interrupted() else code
    except BrokenPipeError:
        # Python would fail once more when it flushes at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NO_READER
    except (KeyboardInterrupt, Exception) as error:
        # A library may make another error of a KeyboardInterrupt that passes through it.
        if isinstance(error, KeyboardInterrupt) or is_interrupted():
            return _interrupted(error)
        if not isinstance(error, _MENDABLE):
            traceback.print_exc()
            print(_REPORT, file=sys.stderr)
            return BUG
        print(f"r3jax: {printable(one_line(error))}", file=sys.stderr)
        return USER_ERROR


def _interrupted(error: BaseException) -> int:
    """Prints how to resume, if the command supports it."""
    settle_interrupt()
    how = str(error) if isinstance(error, KeyboardInterrupt) else ""
    how = printable(how) or "what was recorded before is complete"
    print(f"r3jax: interrupted; {how}", file=sys.stderr)
    return INTERRUPTED
