"""Compiles the CPU kernels in a separate process while the first planner starts.

Numba holds Python's lock while it compiles, over a minute of one core for all kernels. With a spare
core the main process finds them in the cache, or waits only for the one that it needs
(`ffi.register_handlers`). Afterwards they are on disk, and no process is started.
"""

import contextlib
import functools
import hashlib
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from r3jax.files import make_folder, write_atomic

COMPILER = "r3jax.kernels.native.ahead"
"""This module, which the process runs: `python -m r3jax.kernels.native.ahead NOTE`."""

_PACKAGE = Path(__file__).parents[2]


def cache_folder() -> Path:
    """Returns the folder where this package caches results that take long to compute."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "r3jax"


@functools.cache
def compile_ahead(cache: Path | None = None) -> None:
    """Starts the process, unless it has finished before with these sources on this machine.

    Args:
        cache: folder for the note that it did; None: in the package's own.
    """
    if find_spec("numba") is None:
        return
    note = _note_in(cache_folder() / "kernels" if cache is None else cache)
    # Where a program embeds Python, it is the executable, and would start once more.
    is_python = Path(sys.executable or "").name.startswith("python")
    if note.exists() or not is_python:
        return
    # If it cannot be started, kernels are compiled when needed.
    with contextlib.suppress(OSError):
        subprocess.Popen(
            [sys.executable, "-m", COMPILER, str(note)],
            # Kernels are for CPUs: leave the GPU's memory to the main process.
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C ends the command, and not what the next one needs
        )


def _note_in(cache: Path) -> Path:
    """Returns the file whose existence marks that all kernels of these sources were compiled."""
    sources = sorted(_PACKAGE.glob("kernels/**/*.py"))
    parts = [f"{path} {path.stat().st_mtime_ns}" for path in sources]
    parts += [version("numba"), version("jaxlib"), platform.python_version(), platform.node()]
    return cache / hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def main(note: Path) -> None:
    """Compiles all kernels but rare ones, and leaves a note."""
    from r3jax.kernels import bridge

    for name in bridge.HANDLERS:
        if name not in bridge.RARE:
            bridge.register(name)
    make_folder(note.parent)
    write_atomic(note, b"")


if __name__ == "__main__":
    if hasattr(os, "nice"):  # Windows has no such thing
        os.nice(5)  # the command itself goes first
    main(Path(sys.argv[1]))
