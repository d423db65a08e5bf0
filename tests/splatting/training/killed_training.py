"""One process of a training that is to be killed: begins it, or goes on with it. Not a test itself.

python -m tests.splatting.training.killed_training FOLDER
"""

import sys
from pathlib import Path

import jax

from r3jax.splatting.ply import write_scene
from r3jax.splatting.training.train import fit
from tests.splatting.ball import ball_views, config


def go_on(folder: Path) -> None:
    """Begins a training in `folder`, or goes on with the one that is there."""
    checkpoints = folder / "checkpoints"
    result = fit(
        ball_views(),
        config(background="random"),
        folder=checkpoints,
        resume=any(path.name.isdigit() for path in checkpoints.glob("*")),
        checkpoint_every=2,
    )
    write_scene(folder / "scene.ply", result.scene)


if __name__ == "__main__":
    # Below the suite's threshold too: a process that lives for seconds must not compile anything.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    go_on(Path(sys.argv[1]))
