"""Compiles the kernels for CPUs in a process of its own, while a first command reads its scene.

Numba holds Python's lock while it compiles, over a minute of one core for all kernels. A command
that has another core to spare finds them on the disk, or waits for the one that it needs
(`native.ffi.register_handlers`). Afterwards the disk has them, and nothing is started.

    python -m r3jax.cli.kernels NOTE
"""

import contextlib
import hashlib
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

COMMANDS = ("demo", "explore", "team", "benchmark")
"""What decides, and may train afterwards."""

_PACKAGE = Path(__file__).parents[1]


def compile_ahead(cache: Path) -> None:
    """Starts the process, unless it came to its end once with these sources on this machine.

    Args:
        cache: folder for the note that it did.
    """
    note = _note_in(cache)
    if note.exists():
        return
    # What cannot be started is compiled where it is needed.
    with contextlib.suppress(OSError):
        subprocess.Popen(
            [sys.executable, "-m", "r3jax.cli.kernels", str(note)],
            # Kernels are for CPUs: a GPU's memory is the command's.
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C ends the command, and not what the next one needs
        )


def _note_in(cache: Path) -> Path:
    """The file that is there once all kernels of these sources were compiled."""
    sources = sorted(_PACKAGE.glob("**/numba/*.py")) + sorted(_PACKAGE.glob("native/*.py"))
    parts = [f"{path} {path.stat().st_mtime_ns}" for path in sources]
    parts += [version("numba"), version("jaxlib"), platform.python_version(), platform.node()]
    return cache / hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def main(note: Path) -> None:
    """Compiles all kernels, those of decisions first, and leaves a note."""
    # In the order in which a run needs them.
    from r3jax.mapping.backends.numba import bridge as mapping

    for name in (mapping.ADD, mapping.LOOK, mapping.MARK):
        mapping.register(name)
    from r3jax.scoring.backends.numba import bridge as scoring

    for name in (scoring.SUMS, scoring.CHANGES):
        scoring.register(name)
    from r3jax.splatting.backends.numba import bridge as splatting

    splatting.register()
    from r3jax.splatting.training.backends.numba import bridge as training

    for name in (training.LOSS, training.ADAM):
        training.register(name)
    for name in (scoring.PIXELS, scoring.ROWS):
        scoring.register(name)
    note.parent.mkdir(parents=True, exist_ok=True)
    note.touch()


if __name__ == "__main__":
    os.nice(5)  # the command itself goes first
    main(Path(sys.argv[1]))
