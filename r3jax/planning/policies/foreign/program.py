"""A program that answers messages: started under limits, runs only while asked, always ended.

No sandbox: it has the rights of the user who starts it (`docs/howto/policy.md`).
"""

import contextlib
import functools
import os
import selectors
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

import psutil

from r3jax.planning.policies.foreign.commands import words_of
from r3jax.planning.policies.foreign.messages import (
    PREFIX,
    Message,
    MessageError,
    decode,
    encode,
    length_of,
)
from r3jax.planning.policy import PolicyError

_LAUNCH = Path(__file__).with_name("launch.py")

_CHUNK = 1 << 16
_TAIL = 2000
"""Last bytes of its standard error that are kept."""

_GRACE = 1.0
"""A program whose input has ended may take so long to end [s]."""

_MEASURE_EVERY = 0.25
"""Pause between two measurements of its memory while it computes [s]."""


@functools.cache
def network() -> str:
    """`none` where this system lets a program be cut off from the network, else `shared`."""
    if sys.platform != "linux":
        return "shared"
    words = [sys.executable, "-I", "-S", str(_LAUNCH), "0", "none", "true"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        if subprocess.run(words, capture_output=True, timeout=20).returncode == 0:
            return "none"
    return "shared"


def limits_memory() -> bool:
    """Whether this system holds a program to its memory."""
    return sys.platform == "linux"


class Program:
    """A program, paused between an answer and the next question: what it computes is charged."""

    def __init__(self, command: str, memory: float) -> None:
        """Starts it.

        Args:
            command: program and arguments, as for a shell.
            memory: that it and all that it has started may take [GiB]; 0: no limit.

        Raises:
            ValueError: there is no such program.
            PolicyError: it cannot be started.
        """
        self.command = command
        self._memory = int(memory * (1 << 30))
        limits = [sys.executable, "-I", "-S", str(_LAUNCH), str(self._memory), network()]
        try:
            self._process = subprocess.Popen(
                [*limits, *words_of(command)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                # A group of its own: it is ended with the program, and Ctrl-C is the loop's.
                start_new_session=True,
            )
        except OSError as error:
            raise PolicyError(f"{command!r} cannot be started ({error})") from error
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        self._said = b""
        self._paused: list[psutil.Process] = []
        self.close = weakref.finalize(self, _end, self._process)

    def ask(self, message: Message, seconds: float) -> Message:
        """Sends a message and waits for the answer.

        Raises:
            PolicyError: no answer in time, none at all, or something else than a message; more
                memory than allowed. The program has ended then.
        """
        if not self.close.alive:
            raise PolicyError(f"the program {self.command!r} has ended")
        _signal_all(self._process, self._paused, signal.SIGCONT)
        try:
            answer = decode(self._exchange(encode(message), time.monotonic() + seconds))
            self._paused = _pause(self._process)
            self._check_memory()
            return answer
        except TimeoutError:
            reason = f"gave no answer to `{message.kind}` within {seconds:g} s"
        except MemoryError as error:
            reason = str(error)
        except EOFError as error:
            reason = self._death(str(error))
        except MessageError as error:
            reason = f"sent no answer to `{message.kind}`: {error}"
        self.close()
        said = " ".join(self._said.decode("utf-8", "replace").split())
        last = f"; it said: {said[-600:]}" if said else ""
        raise PolicyError(f"the program {self.command!r} {reason}{last}")

    def _exchange(self, data: bytes, end: float) -> bytes:
        """Writes and reads at the same time, so that neither side waits for the other for ever.

        Raises:
            TimeoutError: it is past `end` on the monotonic clock.
            EOFError: the program has closed its `input` or its `output`, as the text says.
            MemoryError: the program takes more than it may.
            MessageError: what comes is no message, or comes before the question is sent.
        """
        streams = self._process.stdin, self._process.stdout, self._process.stderr
        into, out, errors = (pipe.fileno() for pipe in streams if pipe is not None)
        left, inbox = memoryview(data), bytearray()
        measured = time.monotonic()
        with selectors.DefaultSelector() as selector:
            selector.register(into, selectors.EVENT_WRITE)
            selector.register(out, selectors.EVENT_READ)
            selector.register(errors, selectors.EVENT_READ)
            while True:
                if (patience := end - time.monotonic()) <= 0.0:
                    raise TimeoutError
                ready = {key.fd for key, _ in selector.select(min(patience, _MEASURE_EVERY))}
                if time.monotonic() - measured > _MEASURE_EVERY:
                    self._check_memory()
                    measured = time.monotonic()
                if errors in ready and not self._listen(errors):
                    selector.unregister(errors)
                if out in ready:
                    inbox += (chunk := os.read(out, _CHUNK))
                    if _is_whole(inbox, not left):
                        return bytes(inbox)
                    if not chunk:
                        raise EOFError("output")
                elif into in ready:  # an answer comes first: it may close its input after that
                    if not left:
                        raise EOFError("input")
                    left = left[_write(into, left) :]
                    if not left:  # there is nothing to read: ready once nobody is at the other end
                        selector.modify(into, selectors.EVENT_READ)

    def _check_memory(self) -> None:
        """Measures what a limit on each process cannot see: many of them, and what they share.

        Raises:
            MemoryError: the program and all that it has started take more than it may.
        """
        if not self._memory:
            return
        family = _family(self._process.pid)
        # What processes share is in the size of each: only if that is too much, it is divided.
        taken = sum(_size(one) for one in family)
        if taken > self._memory:
            taken = sum(_size(one, shared=True) for one in family)
        if taken > self._memory:
            raise MemoryError(
                f"takes {taken / (1 << 30):.2f} GiB with all that it has started, its memory is "
                f"{self._memory / (1 << 30):g} GiB"
            )

    def _listen(self, errors: int) -> bool:
        """Keeps the end of what the program says; False once it says nothing more."""
        said = os.read(errors, _CHUNK)
        self._said = (self._said + said)[-_TAIL:]
        return bool(said)

    def _death(self, closed: str) -> str:
        """How the program ended, or what it closed instead: its `input` or its `output`."""
        code = _wait(self._process)
        assert self._process.stderr is not None
        with contextlib.suppress(BlockingIOError):
            while self._listen(self._process.stderr.fileno()):
                pass
        if code is None:
            return f"closed its {closed} and went on"
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}, perhaps for its memory"
        return f"ended with code {code}"


def _is_whole(inbox: bytearray, asked: bool) -> bool:
    """Whether a message is there.

    Args:
        inbox: what has come.
        asked: the question is sent to its end.

    Raises:
        MessageError: too long, more than one, or before the question.
    """
    is_short = len(inbox) < PREFIX.size
    missing = (PREFIX.size if is_short else length_of(bytes(inbox[: PREFIX.size]))) - len(inbox)
    if missing < 0:
        raise MessageError(f"{-missing} bytes more than one message were sent")
    if inbox and not asked:  # taken for the answer, it would shift all later ones by one
        raise MessageError(
            f"it sent {len(inbox)} bytes before it was asked: send one message for each question, "
            "after reading it, and print to the standard error"
        )
    return missing == 0


def _write(into: int, left: memoryview) -> int:
    """Writes what the pipe takes.

    Raises:
        EOFError: nobody reads.
    """
    try:
        return os.write(into, left[:_CHUNK])
    except BlockingIOError:
        return 0
    except BrokenPipeError:
        raise EOFError("input") from None


def _wait(process: "subprocess.Popen[bytes]") -> int | None:
    """Waits a moment for a program to end; its code as `Popen` has it, None: it has not ended."""
    end = time.monotonic() + _GRACE
    while True:
        # Left to be reaped: until then its number, that of its group, cannot become another's.
        how = os.WEXITED | os.WNOHANG | os.WNOWAIT
        if (found := os.waitid(os.P_PID, process.pid, how)) is not None:
            return found.si_status if found.si_code == os.CLD_EXITED else -found.si_status
        if time.monotonic() > end:
            return None
        time.sleep(0.005)


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Ends a program, its group, and what it has started outside of the group."""
    started = _pause(process)  # so that nothing is started meanwhile
    _signal_all(process, started, signal.SIGCONT)
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        pipe.close()
    _wait(process)  # the end of its input is its sign to go
    _signal_all(process, [*started, *_family(process.pid)], signal.SIGKILL)
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


def _pause(process: "subprocess.Popen[bytes]") -> list[psutil.Process]:
    """Stops a program and all that it has started; returns them."""
    _signal_all(process, [], signal.SIGSTOP)
    family = _family(process.pid)
    _signal_all(process, family, signal.SIGSTOP)
    return family


def _signal_all(
    process: "subprocess.Popen[bytes]", family: list[psutil.Process], signum: int
) -> None:
    """Signals a program, its group, and what it has started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signum)
    for one in family:
        with contextlib.suppress(psutil.Error):
            one.send_signal(signum)


def _family(pid: int) -> list[psutil.Process]:
    """A process and all that descends from it.

    What loses its parent becomes the program's own child on Linux, as `launch.py` has it, for as
    long as the program is there.
    """
    with contextlib.suppress(psutil.Error):
        program = psutil.Process(pid)
        return [program, *program.children(recursive=True)]
    return []


def _size(process: psutil.Process, *, shared: bool = False) -> int:
    """Memory of a process [bytes]; `shared`: of what it shares its part, where that is known."""
    with contextlib.suppress(psutil.Error):
        if shared and sys.platform == "linux":
            return int(process.memory_full_info().pss)
        return int(process.memory_info().rss)
    return 0
