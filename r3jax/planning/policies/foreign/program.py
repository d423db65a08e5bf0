"""Runs a program that exchanges messages, with limits of time and memory, and stops it at the end.

This is not a sandbox: the program has the rights of the user who starts it
(`docs/howto/policy.md`).
"""

import contextlib
import queue
import signal
import subprocess
import tempfile
import threading
import time
import weakref
from typing import IO

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

_TAIL = 600
"""Bytes at the end of its standard error that a message quotes."""

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
            memory: limit for it and its child processes together [GiB]; 0: none.

        Raises:
            ValueError: there is no such program.
            PolicyError: it cannot be started.
        """
        self.command, self._memory = command, memory
        # A file, which nothing has to read in time.
        words, pipe = words_of(command), subprocess.PIPE
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        try:
            # A separate session: Ctrl-C is handled by the loop.
            self._process = subprocess.Popen(
                words,
                stdin=pipe, stdout=pipe, stderr=self._errors, bufsize=0, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            self._errors.close()
            raise PolicyError(f"{command!r} cannot be started ({error})") from error
        self.close = weakref.finalize(self, _end, self._process, self._errors)

    def ask(self, message: Message, seconds: float) -> Message:
        """Sends a message and waits for the reply.

        Raises:
            PolicyError: no reply, no reply in time, an invalid message, or more memory than
                allowed. The program has been stopped.
        """
        if not self.close.alive:
            raise PolicyError(f"the program {self.command!r} has ended")
        try:
            return self._exchange(encode(message), time.monotonic() + seconds)
        except TimeoutError:
            reason = f"did not reply to `{message.kind}` within {seconds:g} s"
        except MemoryError as error:
            reason = str(error)
        except (EOFError, BrokenPipeError):
            reason = self._death()
        except MessageError as error:
            reason = f"did not reply to `{message.kind}`: {error}"
        said = self._last_words()
        self.close()
        raise PolicyError(f"the program {self.command!r} {reason}{said}")

    def _exchange(self, data: bytes, end: float) -> Message:
        """Sends bytes and returns the reply, measuring memory meanwhile.

        Raises:
            TimeoutError: `end` on the monotonic clock has passed.
            MemoryError: the program takes more than allowed.
            EOFError, BrokenPipeError: it has closed its input or output.
            MessageError: the reply is not a message.
        """
        replies = queue.SimpleQueue[Message | Exception]()
        # In a thread, so that no program can block the loop: it ends with the pipes.
        threading.Thread(target=_talk, args=(self._process, data, replies), daemon=True).start()
        reply = None
        while reply is None:
            left = end - time.monotonic()
            with contextlib.suppress(queue.Empty):
                reply = replies.get(timeout=max(0.0, min(left, _MEASURE_EVERY)))
            self._check_memory()
            if reply is None and left <= 0.0:
                raise TimeoutError
        if isinstance(reply, Exception):
            raise reply
        return reply

    def _check_memory(self) -> None:
        """Measures the memory of its processes together.

        Raises:
            MemoryError: they take more than allowed.
        """
        if not self._memory:
            return
        taken = sum(map(_size, _family(self._process.pid))) / (1 << 30)
        if taken > self._memory:
            raise MemoryError(
                f"takes {taken:.2f} GiB with its child processes, the limit is {self._memory:g} GiB"
            )

    def _death(self) -> str:
        """Describes how the program ended, or that it only closed its input or output."""
        code = _wait(self._process)
        if code is None:
            return "closed its input or output but kept running"
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}, perhaps because of its memory"
        return f"ended with code {code}"

    def _last_words(self) -> str:
        """Quotes the end of its standard error, if it wrote something there."""
        self._errors.seek(max(0, self._errors.seek(0, 2) - _TAIL))
        said = " ".join(self._errors.read().decode("utf-8", "replace").split())
        return f"; its standard error ends with: {said}" if said else ""


def _talk(
    process: "subprocess.Popen[bytes]",
    data: bytes,
    replies: "queue.SimpleQueue[Message | Exception]",
) -> None:
    """Writes a message, reads the reply, and puts it or the error into a queue."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        left = memoryview(data)
        while left:
            left = left[process.stdin.write(left) :]
        prefix = _read(process.stdout, PREFIX.size)
        replies.put(decode(prefix + _read(process.stdout, length_of(prefix) - PREFIX.size)))
    except Exception as error:  # raised again by the thread that waits
        replies.put(error)


def _read(stream: IO[bytes], count: int) -> bytes:
    """Reads exactly `count` bytes.

    Raises:
        EOFError: there are fewer.
    """
    data = bytearray()
    while len(data) < count:
        if not (chunk := stream.read(count - len(data))):
            raise EOFError
        data += chunk
    return bytes(data)


def _wait(process: "subprocess.Popen[bytes]") -> int | None:
    """Waits briefly for a program to end; returns its exit code as `Popen` does, or None."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.wait(_GRACE)
    return None


def _end(process: "subprocess.Popen[bytes]", errors: IO[bytes]) -> None:
    """Stops a program and its child processes, and closes its files."""
    started = _family(process.pid)
    assert process.stdin is not None
    process.stdin.close()
    _wait(process)  # the end of its input tells it to exit
    for one in [*started, *_family(process.pid)]:
        with contextlib.suppress(psutil.Error):
            one.kill()
    process.wait()
    assert process.stdout is not None
    process.stdout.close()
    errors.close()


def _family(pid: int) -> list[psutil.Process]:
    """Lists a process and all its descendants."""
    with contextlib.suppress(psutil.Error):
        program = psutil.Process(pid)
        return [program, *program.children(recursive=True)]
    return []


def _size(process: psutil.Process) -> int:
    """Measures the memory of a process [bytes]."""
    with contextlib.suppress(psutil.Error):
        taken = process.memory_full_info()
        # On Linux shared pages count by their share, elsewhere once for each process.
        return int(getattr(taken, "pss", taken.rss))
    return 0
