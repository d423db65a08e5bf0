"""Compiles all kernels, `python -m r3jax.cli.kernels NOTE`: what `kernels.native.ahead` starts."""

import os
import sys
from pathlib import Path

from r3jax.files import make_folder, write_atomic


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
