"""Compiles all kernels, `python -m r3jax.cli.kernels NOTE`: what `kernels.native.ahead` starts."""

import os
import sys
from pathlib import Path

from r3jax.files import make_folder, write_atomic


def main(note: Path) -> None:
    """Compiles all kernels, and leaves a note."""
    # What takes longest first, then what is needed last: who waits opens a scene, renders, and
    # compiles the map's kernels meanwhile.
    from r3jax.kernels.scoring import bridge as scoring

    for name in (scoring.SUMS, scoring.SUMS_OF_FEW, scoring.PIXELS):
        scoring.register(name)
    from r3jax.kernels.mapping import bridge as mapping

    for name in (mapping.MARK, mapping.LOOK, mapping.ADD):
        mapping.register(name)
    scoring.register(scoring.CHANGES)
    from r3jax.kernels.splatting import bridge as splatting

    splatting.register()
    from r3jax.kernels.training import bridge as training

    for name in (training.LOSS, training.ADAM):
        training.register(name)
    scoring.register(scoring.ROWS)
    make_folder(note.parent)
    write_atomic(note, b"")


if __name__ == "__main__":
    if hasattr(os, "nice"):  # Windows has no such thing
        os.nice(5)  # the command itself goes first
    main(Path(sys.argv[1]))
