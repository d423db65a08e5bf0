"""Runs cells in processes of their own on this machine, one GPU each where there are several.

A process that crashes, or is killed for its memory, costs its cell and nothing else. What any
engine reports while cells run (`Event`) stands here too.
"""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import shutil
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from r3jax.apps.benchmark.cells import Cell
from r3jax.errors import InputError
from r3jax.kernels.native.platform import num_cores

Kind = Literal["started", "stage", "done", "failed"]


@dataclass(frozen=True)
class Event:
    """Something happened to a cell. Each cell ends with one `done` or one `failed`."""

    cell: Cell
    kind: Kind

    text: str = ""
    """The stage, or why it failed."""


Report = Callable[[Event], None]
"""Called in the process that started the engine."""


_STAGE_EVERY = 0.5
"""Minimum interval between reports of a stage [s]."""


def run_here(cells: Sequence[Cell], root: Path, report: Report) -> None:
    """Runs cells one after the other in this process."""
    from r3jax.apps.benchmark.run_cell import run_cell  # imports what trains

    for cell in cells:
        report(Event(cell, "started"))
        try:
            run_cell(cell, root, lambda stage, cell=cell: report(Event(cell, "stage", stage)))
        except Exception as error:
            report(Event(cell, "failed", describe_error(error)))
        else:
            report(Event(cell, "done"))


def run_in_processes(cells: Sequence[Cell], root: Path, report: Report, *, jobs: int = 1) -> None:
    """Runs cells in `jobs` processes; each takes the next cell when it is free.

    Args:
        cells: the cells to compute.
        root: folder of the benchmark.
        report: called with every event.
        jobs: processes at a time, at least 1.

    Raises:
        ValueError: jobs below 1.
        KeyboardInterrupt: Ctrl-C; the processes are ended; complete cells stay.
    """
    if jobs < 1:
        raise InputError(f"jobs must be at least 1, got {jobs}")
    waiting = deque(cells)
    environments = worker_environments(min(jobs, len(cells)))
    workers = [_Worker(environment) for environment in environments]
    try:
        while waiting or any(worker.cell for worker in workers):
            for worker in workers:
                if worker.cell is None and waiting:
                    worker.start(waiting.popleft(), root)
                    report(Event(worker.cell, "started"))  # pyright: ignore[reportArgumentType]
            busy = {worker.pipe: worker for worker in workers if worker.cell is not None}
            for pipe in multiprocessing.connection.wait(list(busy)):  # pyright: ignore[reportArgumentType]
                event = busy[pipe].receive()  # pyright: ignore[reportArgumentType]
                report(event)
    finally:
        for worker in workers:
            worker.kill()


class _Worker:
    """A process, started when it is first needed and again after it died."""

    def __init__(self, environment: dict[str, str]):
        self._environment = environment
        self._process: Any = None
        self.pipe: Connection | None = None
        self.cell: Cell | None = None

    def start(self, cell: Cell, root: Path) -> None:
        """Gives it a cell."""
        if self._process is None:
            # JAX runs threads, which do not survive a fork.
            context = multiprocessing.get_context("spawn")
            self.pipe, far_end = context.Pipe()
            self._process = context.Process(target=_serve, args=(far_end,), daemon=True)
            with _environment(self._environment):
                self._process.start()
            far_end.close()  # so that the pipe ends when the process does
        assert self.pipe is not None
        self.cell = cell
        self.pipe.send((cell, root))

    def receive(self) -> Any:
        """Waits for the next event of its cell; the death of the process counts as a failure."""
        assert self.pipe is not None
        assert self.cell is not None
        cell = self.cell
        try:
            kind, text = self.pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            kind, text = "failed", _death(self._process.exitcode)
            self.kill()
        if kind in ("done", "failed"):
            self.cell = None
        return Event(cell, kind, text)

    def kill(self) -> None:
        """Ends the process at once: whatever it was writing is whole or absent."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process, self.cell = None, None
        if self.pipe is not None:
            self.pipe.close()
            self.pipe = None


def _death(exit_code: int) -> str:
    if exit_code == -signal.SIGKILL:
        return "its process was killed, perhaps because the memory ran out"
    return f"its process ended with code {exit_code}"


def describe_error(error: BaseException) -> str:
    """Formats an error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Generator[None]:
    """Changes the environment for a process that begins here.

    Numba reads it when it is imported: in the new process that would be too late.
    """
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _serve(pipe: Connection) -> None:
    """Runs a worker: receives cells, sends stages and ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends us
    threading.Thread(target=_die_with_parent, daemon=True).start()
    while True:
        try:
            cell, root = pipe.recv()
        except EOFError:
            return
        pipe.send(_outcome(cell, root, pipe))


def _outcome(cell: Cell, root: Path, pipe: Connection) -> tuple[str, str]:
    last = -_STAGE_EVERY

    def on_stage(stage: str) -> None:
        nonlocal last
        if time.monotonic() - last >= _STAGE_EVERY:
            last = time.monotonic()
            pipe.send(("stage", stage))

    try:
        from r3jax.apps.benchmark.run_cell import run_cell

        run_cell(cell, root, on_stage)
    except Exception as error:
        return "failed", describe_error(error)
    return "done", ""


def _die_with_parent() -> None:
    """Waits for the parent to end, and exits: a killed parent cannot end its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def worker_environments(count: int) -> list[dict[str, str]]:
    """Returns the environment of each of `count` workers: its GPU and its share of memory or cores.

    Variables that the user has set are not changed.
    """
    gpus = visible_gpus()
    wanted: list[dict[str, str]] = []
    for index in range(count):
        if gpus:
            sharing = -(-count // len(gpus))
            environment = {"CUDA_VISIBLE_DEVICES": gpus[index % len(gpus)]}
            if sharing > 1 and "XLA_PYTHON_CLIENT_MEM_FRACTION" not in os.environ:
                environment["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 / sharing:.3f}"
        elif "NUMBA_NUM_THREADS" not in os.environ:
            threads = max(1, num_cores() // count)
            environment = {"NUMBA_NUM_THREADS": str(threads)}
        else:
            environment = {}
        wanted.append(environment)
    return wanted


def visible_gpus() -> list[str]:
    """Returns a value of CUDA_VISIBLE_DEVICES for each GPU; empty without GPUs.

    JAX is not used for this: it would reserve the memory of all GPUs.
    """
    if "CUDA_VISIBLE_DEVICES" in os.environ:
        given = os.environ["CUDA_VISIBLE_DEVICES"].split(",")
        return [gpu.strip() for gpu in given if gpu.strip() not in ("", "-1")]
    if os.environ.get("JAX_PLATFORMS", "").lower() == "cpu" or shutil.which("nvidia-smi") is None:
        return []
    try:
        listed = subprocess.run(
            ["nvidia-smi", "--list-gpus"], capture_output=True, text=True, timeout=30, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return []
    return [str(i) for i in range(listed.stdout.count("GPU "))]
