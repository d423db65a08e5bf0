"""Ctrl-C of a command: obeyed at once where that is safe, and never lost.

Python raises KeyboardInterrupt wherever the main thread happens to be. In a finalizer, in a
callback of the garbage collector (JAX has one) or of ctypes it prints the exception and drops it,
and a library may catch it. A command therefore notes the signal as well: an exception that Python
dropped is raised again a moment later, and `check_interrupt`, called between the steps of every
long loop, raises one that was lost in any other way. A second Ctrl-C ends the process.

Only commands install this (`caught_interrupts`); for a program that imports r3jax, Python's own
handler stays.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

_RESEND_AFTER = 0.05
"""Pause before an exception that Python dropped is raised again [s]."""


class _CtrlC:
    """The handler of SIGINT, and what it has noted."""

    def __init__(self, *, ends_process: bool):
        self.is_pending = False
        """A Ctrl-C was noted that has ended nothing yet."""
        self.is_dropped = False
        """Python has dropped the exception that it raised, which is sent again."""
        self.deferrals = 0
        self._ends_process, self._presses = ends_process, 0

    def handle(self, *_: object) -> None:
        """Notes the signal, and raises KeyboardInterrupt unless that is deferred."""
        if self.is_dropped:
            self.is_dropped = False
            if not self.is_pending:
                return
        else:
            self._presses += 1
            self.is_pending = True
            if self._presses > 1 and self._ends_process:
                end_process(INTERRUPTED)
        if self._presses > 1 or not self.deferrals:
            raise KeyboardInterrupt

    def resend(self) -> None:
        """Raises KeyboardInterrupt once more in the main thread, which may be waiting."""
        if not self.is_dropped:
            return
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        else:
            signal.raise_signal(signal.SIGINT)


_command: _CtrlC | None = None
"""The handler of the command that runs in this process, if one does."""


@contextlib.contextmanager
def caught_interrupts(*, stays: bool = False) -> Generator[None]:
    """Handles Ctrl-C while a command runs.

    Does nothing outside of the main thread, and where another handler is installed or the signal
    is ignored, as in a shell's background job.

    Args:
        stays: a Ctrl-C after the end ends the process: for a process that ends with its command.
    """
    global _command
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    before = sys.unraisablehook
    ctrl_c = _command = _CtrlC(ends_process=True)

    def on_dropped(dropped: "sys.UnraisableHookArgs") -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            before(dropped)
        elif ctrl_c.is_pending:
            ctrl_c.is_dropped = True
            again = threading.Timer(_RESEND_AFTER, ctrl_c.resend)
            again.daemon = True
            again.start()

    sys.unraisablehook = on_dropped
    signal.signal(signal.SIGINT, ctrl_c.handle)
    try:
        yield
    finally:
        end = lambda *_: end_process(INTERRUPTED)
        signal.signal(signal.SIGINT, end if stays else signal.default_int_handler)
        sys.unraisablehook, _command = before, None


def is_interrupted() -> bool:
    """Returns whether Ctrl-C was noted that has ended nothing yet."""
    return _command is not None and _command.is_pending


def check_interrupt() -> None:
    """Raises what Ctrl-C has raised before and a callback or a library has dropped.

    Raises:
        KeyboardInterrupt: Ctrl-C was noted, and has ended nothing yet.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if _command is not None and _command.is_pending and is_main:
        _command.is_dropped = False
        raise KeyboardInterrupt


def settle_interrupt() -> None:
    """Notes that Ctrl-C has ended what it was meant for: what follows may run to its end."""
    if _command is not None:
        _command.is_pending = False


@contextlib.contextmanager
def deferred_interrupt() -> Generator[Callable[[], bool]]:
    """Lets Ctrl-C wait until the body checks it, so that no step is torn; a second does not wait.

    Works outside of commands, too, unless the program has a handler of its own, which stays.

    Yields:
        Whether Ctrl-C was noted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    ctrl_c = _command or _CtrlC(ends_process=False)
    before = signal.getsignal(signal.SIGINT)
    is_default = before is signal.default_int_handler
    if is_default:
        signal.signal(signal.SIGINT, ctrl_c.handle)
    ctrl_c.deferrals += 1
    try:
        yield lambda: ctrl_c.is_pending
    finally:
        ctrl_c.deferrals -= 1
        if is_default:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def end_process(code: int) -> None:
    """Ends the process at once: what it was writing is whole or absent.

    Without waiting for threads, which may compile or compute for half a minute.
    """
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        if sys.stderr.isatty():
            sys.stderr.write("\x1b[?25h\n")  # a progress bar hides the cursor
        sys.stderr.flush()
        sys.stdout.flush()
    os._exit(code)
