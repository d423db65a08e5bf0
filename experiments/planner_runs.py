"""Missions whose every step is timed and weighed: what planner_latency and planner_memory show.

Each mission is flown in a process of its own, so that the memory of that process is the memory of
that policy. A mission that is done is kept and not flown again, as long as its settings and the
commit are the same.
"""

import ctypes
import dataclasses
import gc
import json
import os
import platform
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import jax

from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.exploration.config import ExplorationConfig, parse_budget
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.state import LoopState, Mission, Stop, WallClock
from r3jax.exploration.step import start_state, step
from r3jax.exploration.taken_views import TakenView
from r3jax.files import write_atomic
from r3jax.geometry.cameras import Camera
from r3jax.planning.registry import make_policy, policy_names
from r3jax.simulators.scenes.registry import open_scene

STAGES = {"decide": "plan", "observe": "map"}
"""What is timed, and what the loop calls it."""

PLANNING = ("travel", "candidates", "scoring")
"""Parts of a decision."""

SizeName = Literal["smoke", "small", "paper"]


@dataclass(frozen=True)
class Size:
    """How much is flown."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    views: int
    resolution: int
    """Width and height of the images [px]."""

    bucket: int
    """Key frames that one group of samples spans."""


SIZES: dict[SizeName, Size] = {
    "smoke": Size(("flat",), (0,), 25, 128, 6),
    "small": Size(("apartment",), (0,), 201, 256, 25),
    "paper": Size(("flat", "apartment", "office", "gallery"), (0, 1, 2), 301, 512, 25),
}
"""Ten minutes on two cores; half an hour on two cores; the paper's budget, for GPUs."""


@dataclass(frozen=True)
class Options:
    """What every policy's planning costs, step by step."""

    size: SizeName = "smoke"
    """How much is flown: `smoke` in minutes, `small` in hours, `paper` on GPUs."""

    policies: tuple[str, ...] = policy_names()
    """Whose planning is measured."""

    out: Path = Path("experiments/results")
    """Folder of the results; they go into a folder named after the experiment and the size."""

    work: Path = Path("runs/planner_missions")
    """Folder of the missions that are done."""

    def __post_init__(self) -> None:
        """Refuses unknown policies before anything is flown."""
        unknown = sorted(set(self.policies) - set(policy_names()))
        if unknown or not self.policies:
            raise ValueError(
                f"--policies: unknown {', '.join(unknown) or '(none given)'}; known: "
                f"{', '.join(policy_names())}"
            )


@dataclass(frozen=True)
class Flight:
    """One mission to be flown."""

    policy: str
    scene: str
    seed: int
    views: int
    resolution: int
    commit: str | None

    @property
    def file_name(self) -> str:
        """Where it is kept."""
        return f"{self.policy}-{self.scene}-{self.resolution}px-seed{self.seed}.json"


def fly_all(options: Options) -> list[dict[str, Any]]:
    """The records of all missions of a size, flown one after the other where they are not kept."""
    size, commit = SIZES[options.size], source_commit()
    flights = [
        Flight(policy, scene, seed, size.views, size.resolution, commit)
        for scene in size.scenes
        for seed in size.seeds
        for policy in options.policies
    ]
    options.work.mkdir(parents=True, exist_ok=True)
    # Memory that is set aside at the start would hide what is used.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    records = []
    for number, flight in enumerate(flights, 1):
        begin = time.perf_counter()
        records.append(_kept_or_flown(options.work / flight.file_name, flight))
        seconds = time.perf_counter() - begin
        print(f"{number}/{len(flights)} {flight.file_name} {seconds:.0f} s", flush=True)
    return records


def _kept_or_flown(path: Path, flight: Flight) -> dict[str, Any]:
    asked = dataclasses.asdict(flight)
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["flight"] == asked:
            return kept
    spawn = get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as process:
        record = process.submit(fly, flight).result()
    write_atomic(path, json.dumps(record).encode())
    return record


def fly(flight: Flight) -> dict[str, Any]:
    """Flies one mission.

    Returns:
        The flight, the machine, the memory of the process before the first view and that of
        compiled programs at the end [bytes; None if unknown], and a row per decision. `key_frames`
        of a row are those in the map when the policy decided; its memory is what is held after the
        frame that followed.
    """
    camera = Camera.from_fov(flight.resolution, flight.resolution)
    simulator = open_scene(flight.scene, camera=camera, seed=flight.seed)
    init_key, key = jax.random.split(jax.random.key(flight.seed))
    mission = Mission(
        GuardedSimulator(simulator),
        make_policy(flight.policy),
        parse_budget(f"views:{flight.views}"),
        key,
        ExplorationConfig(),
        WallClock(),
    )
    state = start_state(mission, init_key)
    before, rows = process_memory(), list(_rows(state, mission))
    return {
        "flight": dataclasses.asdict(flight),
        "machine": machine(),
        "backend": jax.default_backend(),
        "process_bytes_before": before,
        "rows": rows,
        "compiled_bytes": compiled_memory(),
    }


def _rows(state: LoopState, mission: Mission) -> Iterator[dict[str, Any]]:
    while True:
        key_frames = state.views
        state, output = step(state, mission)
        if isinstance(output, Stop):
            return
        if key_frames > 0:
            yield {"key_frames": key_frames} | _milliseconds(output) | _bytes(state)


def _milliseconds(view: TakenView) -> dict[str, float]:
    """Returns what the parts of a step took [ms]; 0 for parts that a policy does not have."""
    stages = {name: view.stages[stage] for name, stage in STAGES.items()}
    parts = {f"decide.{part}": view.stages.get(f"plan.{part}", 0.0) for part in PLANNING}
    return {f"{name}_ms": 1e3 * seconds for name, seconds in (stages | parts).items()}


def _bytes(state: LoopState) -> dict[str, int | None]:
    """Returns what a state holds, and what the device and the process hold altogether [bytes]."""
    map_state = state.map_state
    device = jax.local_devices()[0].memory_stats() or {}
    return {
        "map_bytes": size_of(map_state),
        "map_used_bytes": map_state.bytes_per_row * int(map_state.num_occupied),
        "grid_bytes": size_of(state.grid),
        "policy_bytes": size_of(state.policy_state),
        "device_bytes": device.get("bytes_in_use"),
        "device_peak_bytes": device.get("peak_bytes_in_use"),
        "process_bytes": process_memory(),
    }


def size_of(tree: Any) -> int:
    """Returns bytes of all arrays in a pytree."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def process_memory() -> int | None:
    """Returns the resident memory of this process [bytes].

    None where the system does not say (not Linux).
    """
    try:
        resident = Path("/proc/self/statm").read_text().split()[1]
    except OSError:
        return None
    return int(resident) * os.sysconf("SC_PAGE_SIZE")


def compiled_memory() -> int | None:
    """Returns what the process gives back when JAX forgets its programs [bytes].

    None where unknown.
    """
    before = _memory_in_use()
    jax.clear_caches()
    after = _memory_in_use()
    return None if before is None or after is None else before - after


def _memory_in_use() -> int | None:
    """Returns the resident memory without what the allocator only keeps for later."""
    gc.collect()
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)
    return process_memory()


def bucket_of(key_frames: int, width: int) -> tuple[int, int]:
    """Returns the group of key frames that a number belongs to: first and last, from 1 on."""
    first = (key_frames - 1) // width * width + 1
    return first, first + width - 1
