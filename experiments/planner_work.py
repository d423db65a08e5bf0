"""A decision's time against its work: voxels in range, candidates, threads; and its memory.

    python -m experiments.planner_work --size smoke

The map is that of an apartment after the given number of views from the middles of its rooms; a
decision of `r3-pano` is made on it again and again, from where the last view was taken. Run it on
an idle machine.
"""

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numba
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.pages.artifacts import (
    joint_origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.planner_runs import process_memory
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.planner import Planner, decide, observe, start
from r3jax.planning.policies.r3 import R3Pano
from r3jax.plots import style
from r3jax.simulators.scenes import procedural
from r3jax.simulators.scenes.registry import open_scene

NAME, SCENE = "planner_work", "apartment"
RANGE = 5.0
"""Of the sensor [m]."""

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Size:
    """What is measured."""

    views: tuple[int, ...]
    """Sizes of the map, in views."""

    candidates: tuple[int, ...]
    resolution: int
    """Width and height of the images [px]."""

    repeats: int
    """Decisions of which the median counts."""


SizeName = Literal["smoke", "small"]
SIZES: dict[SizeName, Size] = {
    "smoke": Size((2, 4), (10, 20), 64, 3),
    "small": Size((5, 15, 30), (10, 30, 100), 256, 7),
}
"""Half a minute; two minutes, both on two idle cores."""


@dataclass(frozen=True)
class Options:
    """What a decision costs, against what there is to do."""

    size: SizeName = "smoke"
    """How much is measured."""

    threads: tuple[int, ...] = (1, 2)
    """Threads that scoring may use."""

    out: Path = Path("experiments/results")
    """Folder of the results; they go into a folder named after the experiment and the size."""


def main(options: Options) -> Path:
    """Measures, writes the results, and returns their folder."""
    folder = options.out / NAME / options.size
    folder.mkdir(parents=True, exist_ok=True)
    size, before = SIZES[options.size], process_memory() or 0
    rows = [
        row
        for views, planner, pose in grown_maps(size)
        for row in measured(planner, pose, size, options.threads, {"views": views}, before)
    ]
    origin = joint_origin(f"experiments.{NAME}", [machine()], [source_commit()])
    write_csv(folder / "decisions.csv", rows, origin)
    write_figure(folder / "work.png", work_figure(rows), origin)
    write_markdown(folder / "work.md", page(rows, options.size), origin)
    print(f"results  {folder}")
    return folder


def grown_maps(size: Size) -> Iterator[tuple[int, Planner, np.ndarray]]:
    """Yields the planner and the latest pose after each number of views."""
    edge = size.resolution
    simulator = open_scene(SCENE, camera=Camera.from_fov(edge, edge, 60.0))
    rooms, rng = list(procedural.rooms(SCENE).values()), np.random.default_rng(0)
    planner = start(simulator.camera, simulator.bounds)
    for taken in range(max(size.views)):
        x0, y0, x1, y1 = rooms[taken % len(rooms)]
        position = jnp.asarray([0.5 * (x0 + x1), 0.5 * (y0 + y1), 1.4], dtype=jnp.float32)
        direction = jnp.asarray(rng.standard_normal(3) * [1.0, 1.0, 0.3], dtype=jnp.float32)
        pose = np.asarray(pose_along(position, direction), dtype=np.float64)
        planner = observe(planner, simulator.render(pose))
        if taken + 1 in size.views:
            yield taken + 1, planner, pose


def measured(
    planner: Planner,
    pose: np.ndarray,
    size: Size,
    threads: tuple[int, ...],
    known: Any,
    before: int,
) -> Rows:
    """Median milliseconds of a decision, for every number of threads and of candidates."""
    state, rows = planner.map_state, []
    gap = np.linalg.norm(np.asarray(state.center).T - pose[:3, 3], axis=1)
    in_range = int(np.sum(np.asarray(state.present) & (gap <= RANGE)))
    for workers in threads:
        numba.set_num_threads(workers)
        jax.clear_caches()  # programs know the number of threads that they were made for
        for num in size.candidates:
            base = R3Pano()
            settings = dataclasses.replace(
                base.config, num_candidates=num, num_frontier=min(base.config.num_frontier, num)
            )
            asked = dataclasses.replace(planner, policy=R3Pano(config=settings))
            seconds, scoring = [], []
            for _ in range(size.repeats + 1):  # the first one compiles
                begin = time.perf_counter()
                info = decide(asked, pose, jax.random.key(1))[2]
                seconds.append(time.perf_counter() - begin)
                scoring.append(info.stage_seconds["scoring"])
            rows.append(
                known
                | {"voxels": int(state.num_occupied), "in_range": in_range}
                | {"candidates": num, "threads": workers}
                | {"decision_ms": 1e3 * float(np.median(seconds[1:]))}
                | {"scoring_ms": 1e3 * float(np.median(scoring[1:]))}
                | {"map_mb": state.capacity * state.bytes_per_row / 1e6}
                | {"process_mb": ((process_memory() or 0) - before) / 1e6}
            )
    return rows


def work_figure(rows: Rows) -> Figure:
    """Milliseconds against voxels in range, at most candidates, and against candidates."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    most, largest = max(r["candidates"] for r in rows), max(r["in_range"] for r in rows)
    panels = [
        ("in_range", "Voxels in range", [r for r in rows if r["candidates"] == most]),
        ("candidates", "Candidates", [r for r in rows if r["in_range"] == largest]),
    ]
    for axes, (key, label, chosen) in zip(figure.subplots(1, 2), panels, strict=True):
        style.dress(axes, "A decision of r3-pano", label, "Time [ms]")
        for workers in sorted({row["threads"] for row in chosen}):
            curve = sorted((r[key], r["decision_ms"]) for r in chosen if r["threads"] == workers)
            axes.plot(*zip(*curve, strict=True), marker="o", label=f"threads: {workers}")
        axes.set_xlim(0.0, 1.05 * max(row[key] for row in chosen))
        axes.set_ylim(0.0, 1.05 * max(row["decision_ms"] for row in chosen))
        axes.legend()
    return figure


def page(rows: Rows, size: str) -> list[str]:
    """Returns the table and the figure."""
    return [
        f"# What a decision costs against its work ({size})",
        "Median milliseconds of a decision of `r3-pano`, and of its scoring alone; megabytes of "
        "the map's table, and what the process has taken since its start, programs and scene "
        "included.",
        markdown_table(rows),
        "![milliseconds against voxels in range and candidates](work.png)",
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
