"""One process of a run that is to be killed: begins it, or goes on with it. Not a test itself.

python -m tests.exploration.killed_run FOLDER VIEWS POLICY
"""

import os
import sys
import time
from pathlib import Path

import jax

from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.planning.policy import Policy
from r3jax.planning.registry import make_policy
from r3jax.runs.header import camera_fields
from r3jax.runs.writer import RunWriter
from r3jax.scoring.config import ScoringConfig
from tests.exploration.toys import BoxRoom
from tests.runs.runs import make_header

CONFIG = ExplorationConfig(voxel_size=0.1, capacity=1 << 14, clock="model", num_probes=4)
SCORING = ScoringConfig(zbuffer_size=32, panorama_size=32)


def small_policy(name: str) -> Policy:
    """A policy whose decisions are quick; the same shapes for all tests of the loop."""
    return make_policy(name, num_candidates=8, num_frontier=3, scoring=SCORING)


def go_on(path: Path, views: int, policy: str) -> None:
    """Begins a run in `path`, or goes on with the one that is there."""
    simulator = BoxRoom()
    planner = small_policy(policy)
    run = None
    if (path / "run.json").exists():
        recorder, run = RunWriter.resume(path)
    else:
        camera = camera_fields(simulator.camera)
        recorder = RunWriter(path, make_header(camera=camera, budget=f"views:{views}"))
    with recorder:
        explore(
            simulator,
            planner,
            budget=f"views:{views}",
            config=CONFIG,
            recorder=recorder,
            resume=run,
        )


def _slow_disk() -> None:
    """Every flush takes 10 ms more, so that many kills fall into a write."""
    flush = os.fsync

    def slow(descriptor: int) -> None:
        time.sleep(0.005)
        flush(descriptor)
        time.sleep(0.005)

    os.fsync = slow


if __name__ == "__main__":
    # Below the suite's threshold too: a process that lives for seconds must not compile anything.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    _slow_disk()
    go_on(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
