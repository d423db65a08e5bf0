"""Compiles all kernels for CPUs, `python -m r3jax.cli.kernels NOTE`: what `native.ahead` starts."""

import os
import sys
from pathlib import Path

from r3jax.files import make_folder, write_atomic


def main(note: Path) -> None:
    """Compiles all kernels, and leaves a note."""
    # What takes longest first, then what is needed last: who waits opens a scene, renders, and
    # compiles the map's kernels meanwhile.
    from r3jax.scoring.backends.numba import bridge as scoring

    for name in (scoring.SUMS, scoring.SUMS_OF_FEW, scoring.PIXELS):
        scoring.register(name)
    from r3jax.mapping.backends.numba import bridge as mapping

    for name in (mapping.MARK, mapping.LOOK, mapping.ADD):
        mapping.register(name)
    scoring.register(scoring.CHANGES)
    from r3jax.splatting.backends.numba import bridge as splatting

    splatting.register()
    from r3jax.splatting.training.backends.numba import bridge as training

    for name in (training.LOSS, training.ADAM):
        training.register(name)
    scoring.register(scoring.ROWS)
    make_folder(note.parent)
    write_atomic(note, b"")


if __name__ == "__main__":
    if hasattr(os, "nice"):  # Windows has no such thing
        os.nice(5)  # the command itself goes first
    main(Path(sys.argv[1]))
