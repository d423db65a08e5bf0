"""Runs a program that exchanges messages, with limits of time and memory, and always stops it.

This is not a sandbox: the program has the rights of the user who starts it
(`docs/howto/policy.md`).
"""

import contextlib
import os
import selectors
import shutil
import signal
import subprocess
import sys
import time
import weakref

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

IS_LINUX = sys.platform == "linux"
"""Memory limits are only supported on Linux."""

_CHUNK = 1 << 16
_TAIL = 2000
"""Number of bytes kept of its standard error."""

_GRACE = 1.0
"""Grace period for a program to exit after its input has ended [s]."""

_MEASURE_EVERY = 0.25
"""Interval between two measurements of its memory [s]."""


class Program:
    """A program and its pipes."""

    def __init__(self, command: str, memory: float) -> None:
        """Starts the program.

        Args:
            command: program and arguments, as for a shell.
            memory: limit for it and its child processes [GiB]; 0: none.

        Raises:
            ValueError: there is no such program.
            PolicyError: it cannot be started.
        """
        self.command = command
        self._memory = int(memory * (1 << 30))
        # On Linux the program ends with its parent, even if the parent is killed.
        setpriv = shutil.which("setpriv") if IS_LINUX else None
        first = [setpriv, "--pdeathsig", "KILL"] if setpriv else []
        pipe = subprocess.PIPE
        try:
            # A separate session: it is stopped as a group, and Ctrl-C is handled by the loop.
            self._process = subprocess.Popen(
                [*first, *words_of(command)],
                stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise PolicyError(f"{command!r} cannot be started ({error})") from error
        _limit_memory(self._process.pid, self._memory)
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert stream is not None
            os.set_blocking(stream.fileno(), False)
        self._said = b""
        self.close = weakref.finalize(self, _end, self._process)

    def ask(self, message: Message, seconds: float) -> Message:
        """Sends a message and waits for the reply.

        Raises:
            PolicyError: no reply, no reply in time, an invalid message, or more memory than
                allowed. The program has been stopped.
        """
        if not self.close.alive:
            raise PolicyError(f"the program {self.command!r} has ended")
        try:
            answer = decode(self._exchange(encode(message), time.monotonic() + seconds))
            self._check_memory()
            return answer
        except TimeoutError:
            reason = f"did not reply to `{message.kind}` within {seconds:g} s"
        except MemoryError as error:
            reason = str(error)
        except EOFError as error:
            reason = self._death(str(error))
        except MessageError as error:
            reason = f"did not reply to `{message.kind}`: {error}"
        self.close()
        said = " ".join(self._said.decode("utf-8", "replace").split())
        last = f"; its standard error ends with: {said[-600:]}" if said else ""
        raise PolicyError(f"the program {self.command!r} {reason}{last}")

    def _exchange(self, data: bytes, end: float) -> bytes:
        """Writes and reads at the same time, so that neither side blocks the other.

        Raises:
            TimeoutError: `end` on the monotonic clock has passed.
            EOFError: the program has closed its `input` or its `output`, as the text says.
            MemoryError: the program takes more than allowed.
            MessageError: the bytes are not a message, or come before the request is sent.
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
                elif (
                    into in ready
                ):  # a reply counts first: the program may close its input afterwards
                    if not left:
                        raise EOFError("input")
                    left = left[_write(into, left) :]
                    if (
                        not left
                    ):  # nothing is read from it: it becomes ready when the other end is closed
                        selector.modify(into, selectors.EVENT_READ)

    def _check_memory(self) -> None:
        """Checks the total memory of its processes, which limits per process do not bound.

        Raises:
            MemoryError: the program and its child processes take more than allowed.
        """
        if not self._memory or not IS_LINUX:
            return
        taken = sum(_size(one) for one in _family(self._process.pid))
        if taken > self._memory:
            raise MemoryError(
                f"takes {taken / (1 << 30):.2f} GiB with its child processes, the limit is "
                f"{self._memory / (1 << 30):g} GiB"
            )

    def _listen(self, errors: int) -> bool:
        """Reads its standard error and keeps the last bytes; False at its end."""
        said = os.read(errors, _CHUNK)
        self._said = (self._said + said)[-_TAIL:]
        return bool(said)

    def _death(self, closed: str) -> str:
        """Describes how the program ended, or that it only closed its `input` or `output`."""
        code = _wait(self._process)
        assert self._process.stderr is not None
        with contextlib.suppress(BlockingIOError):
            while self._listen(self._process.stderr.fileno()):
                pass
        if code is None:
            return f"closed its {closed} but kept running"
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}, perhaps because of its memory"
        return f"ended with code {code}"


def _is_whole(inbox: bytearray, asked: bool) -> bool:
    """Checks whether a complete message has arrived; `asked`: the request has been sent.

    Raises:
        MessageError: too long, more than one, or before the request.
    """
    is_short = len(inbox) < PREFIX.size
    missing = (PREFIX.size if is_short else length_of(bytes(inbox[: PREFIX.size]))) - len(inbox)
    if missing < 0:
        raise MessageError(f"{-missing} bytes more than one message were sent")
    if inbox and not asked:  # taken for the reply, it would shift all later ones by one
        raise MessageError(
            f"it sent {len(inbox)} bytes before the request: send one message per request, "
            "after reading it, and print to the standard error"
        )
    return missing == 0


def _write(into: int, left: memoryview) -> int:
    """Writes as much as the pipe accepts.

    Raises:
        EOFError: the other end is closed.
    """
    try:
        return os.write(into, left[:_CHUNK])
    except BlockingIOError:
        return 0
    except BrokenPipeError:
        raise EOFError("input") from None


def _wait(process: "subprocess.Popen[bytes]") -> int | None:
    """Waits briefly for a program to end; returns its exit code as `Popen` does, or None."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.wait(_GRACE)
    return None


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Stops a program, its group, and its descendants."""
    started = _family(process.pid)
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        pipe.close()
    _wait(process)  # the end of its input tells it to exit
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    for one in [*started, *_family(process.pid)]:
        with contextlib.suppress(psutil.Error):
            one.kill()
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


def _limit_memory(pid: int, memory: int) -> None:
    """Limits each process of a program that has just started [bytes]; 0: no limit."""
    if not memory or not IS_LINUX:
        return
    with contextlib.suppress(psutil.Error):
        # Not the address space: GPUs and sparse tables reserve much more than they use. Files in
        # memory (/dev/shm, memfd) count for no process: their size is limited, too.
        for limit in (psutil.RLIMIT_DATA, psutil.RLIMIT_FSIZE):
            psutil.Process(pid).rlimit(limit, (memory, memory))


def _family(pid: int) -> list[psutil.Process]:
    """Lists a process and all its descendants."""
    with contextlib.suppress(psutil.Error):
        program = psutil.Process(pid)
        return [program, *program.children(recursive=True)]
    return []


def _size(process: psutil.Process) -> int:
    """Measures the memory of a process, with its proportion of shared pages [bytes]."""
    with contextlib.suppress(psutil.Error):
        return int(process.memory_full_info().pss)
    return 0
