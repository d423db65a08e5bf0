"""A very large hall, a very large table, a very long run: nothing slows down, nothing leaks.

    export MALLOC_ARENA_MAX=2 MALLOC_MMAP_THRESHOLD_=1048576
    pytest -m slow tests/exploration/test_limits.py -s

takes most of an hour and prints what a step costs along the run: by the clock, and in seconds of
the processor, which do not depend on what else the machine does. The two variables have glibc hand
freed blocks back; otherwise it keeps more and more of them between those in use, and the memory
of the process tells of that and not of what we hold.
"""

import ctypes
import gc
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.policy import Policy
from r3jax.planning.registry import make_policy
from r3jax.runs.header import camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.writer import RunWriter
from r3jax.scoring.config import ScoringConfig
from tests.exploration.hall import Hall
from tests.exploration.killed_run import CONFIG, small_policy
from tests.runs.runs import make_header

_PAGE = os.sysconf("SC_PAGE_SIZE")
ALLOCATOR = {"MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": "1048576"}


@dataclass
class Watch:
    """Follows a run."""

    every: int = 1
    """Views from one look at the memory to the next; half way between two stored states, whose
    writing in the background holds copies of all tables for a while."""

    memory: list[int] = field(default_factory=list)
    """Of the process [bytes], once free memory was given back: what the allocator keeps for later
    comes and goes by a tenth from view to view."""

    processor: list[float] = field(default_factory=list)
    """Of all cores together, from the start of the process to after every view [s]."""

    def on_view(self, view, planner) -> None:
        self.processor.append(time.process_time())
        if (view.row.step + 1) % self.every != self.every // 2:
            return
        self.look()

    def look(self) -> None:
        """Notes the memory of the process."""
        gc.collect()
        _give_back()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.memory.append(pages * _PAGE)


def _give_back() -> None:
    """Has glibc return free memory to the system; other C libraries do as they like."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)


def long_run(
    path: Path, hall: Hall, policy: Policy, config: ExplorationConfig, views: int, every: int = 1
) -> Watch:
    """Explores and records, and watches the memory."""
    watch = Watch(every)
    with RunWriter(path, make_header(camera=camera_fields(hall.camera))) as recorder:
        explore(
            hall,
            policy,
            budget=f"views:{views}",
            config=config,
            recorder=recorder,
            on_view=watch.on_view,
        )
    return watch


def memory_rise(memory: list[int]) -> float:
    """Rise over the second half, as a share: the median of its last fifth over its first."""
    half = np.asarray(memory[len(memory) // 2 :], dtype=np.float64)
    fifth = max(1, len(half) // 5)
    return float(np.median(half[-fifth:]) / np.median(half[:fifth]) - 1.0)


def test_a_rise_is_noticed():
    flat = [1000] * 100
    assert memory_rise(flat) == 0.0
    leaking = [1000 + 2 * k for k in range(100)]
    assert memory_rise(leaking) > 0.03


def test_the_hall_has_walls_and_pillars():
    """From (1.5, 3, 1.5) along x: the pillar at (3, 3) begins at 2.7 m; beside it the next row."""
    hall = Hall()
    pose = np.asarray(pose_along(jnp.asarray([1.5, 3.0, 1.5]), jnp.asarray([1.0, 0.0, 0.0])))
    depth = np.asarray(hall.render(np.float64(pose)).depth)
    np.testing.assert_allclose(depth[48, 46:50], 1.2, rtol=1e-5)
    assert depth[48, 0] > 1.2
    assert depth[95, 47] < 1.6  # the floor, 1.5 m below, at 45 degrees


@pytest.mark.full
def test_a_short_run_in_a_small_hall(tmp_path):
    """The same code at a size for every day; memory still settles, so it is not asked."""
    policy = small_policy("r3-pano")
    hall = Hall((4.0, 3.0, 2.4), Camera.from_fov(48, 48, 90.0))
    watch = long_run(tmp_path / "run", hall, policy, CONFIG, 6)
    assert len(watch.memory) == 6
    rows = read_run(tmp_path / "run").rows
    assert rows[-1].coverage.voxels > rows[0].coverage.voxels > 500
    assert rows[-1].coverage.dropped == 0


@pytest.mark.slow
def test_a_thousand_views_of_a_hall_of_sixty_meters(tmp_path, capsys):
    if any(os.environ.get(name) != value for name, value in ALLOCATOR.items()):
        settings = " ".join(f"{name}={value}" for name, value in ALLOCATOR.items())
        pytest.fail(f"start pytest with {settings}: see the head of this file")
    scoring = ScoringConfig(zbuffer_size=64, panorama_size=64)
    policy = make_policy("r3-pano", num_candidates=12, num_frontier=6, scoring=scoring)
    # Room for 5.9 million voxels, 70 % of the rows: a table that doubles on the way, as one of
    # 4 million rows does at view 700, is more memory and no leak.
    # Few probes: the coverage numbers are beside the mission, and not what is watched here.
    config = ExplorationConfig(
        capacity=1 << 23, max_still_views=1000, num_probes=1, checkpoint_every=10
    )
    watch = long_run(tmp_path / "run", Hall(), policy, config, 1000, every=10)
    run = read_run(tmp_path / "run")
    assert len(run.rows) == 1000
    assert run.rows[-1].coverage.dropped == 0
    with capsys.disabled():
        print()
        for first in range(0, 1000, 100):
            timings = run.timings[first : first + 100]
            stages = {k: np.median([t.get(k, 0.0) for t in timings]) for k in timings[-1]}
            del stages["step"]
            text = ", ".join(f"{k} {1e3 * v:.0f}" for k, v in stages.items() if "plan." not in k)
            row = run.rows[first + 99]
            spent = np.median(np.diff(watch.processor[first : first + 100]))
            print(
                f"{first + 100} views, {row.coverage.voxels} voxels, ms: {text}; cpu {spent:.2f} s"
            )
        rise = memory_rise(watch.memory)
        memory = [m // 1_000_000 for m in watch.memory]
        print("memory every 10 views [MB]:", memory)
        jax.clear_caches()
        watch.look()
        programs = (watch.memory[-2] - watch.memory[-1]) / 1e6
        print(
            f"memory {memory[-1]} MB, {programs:.0f} MB of it compiled programs; "
            f"rise {100 * rise:.1f} % over the last 500 views"
        )
    assert rise < 0.03
