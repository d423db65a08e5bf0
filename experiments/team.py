"""How much sooner two cameras know a place than one does.

    python -m experiments.team --size smoke

One camera and two fly through the same scene under the model clock; two start 0.6 m apart and are
in touch all the time, or meet every ten seconds. What counts is when all together know a share
of what the one camera knows at its end: of the cells of the box, and of voxels. A share of 0.6 of
the time is what two cameras are asked for; half of it is the most that two can save if nobody is
in the way of anybody.

A flight that is done is kept and not flown again, as long as its settings and the commit are the
same.
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from experiments.pages.artifacts import markdown_table, origin_of, write_csv, write_markdown
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.apps.team.team import Member, explore_team
from r3jax.exploration.config import ExplorationConfig
from r3jax.files import write_atomic
from r3jax.geometry.cameras import Camera
from r3jax.planning.registry import make_policy
from r3jax.simulators.base import Simulator
from r3jax.simulators.scenes.registry import open_scene
from r3jax.simulators.start import level_pose, places_beside

NAME = "team"

SHARES = (0.8, 0.9, 0.95)
"""Shares of what one camera knows at its end."""

MEASURES = ("known_share", "voxels")

SizeName = Literal["smoke", "small"]


@dataclass(frozen=True)
class Crew:
    """Who flies."""

    cameras: int
    meet_every: float = 0.0
    """Seconds between meetings; 0: always in touch."""


CREWS = {"one": Crew(1), "two in touch": Crew(2), "two every 10 s": Crew(2, 10.0)}


@dataclass(frozen=True)
class Size:
    """How much is flown."""

    scene: str
    seeds: tuple[int, ...]
    seconds: float
    """Duration of the one camera's mission [s]; that of two is two thirds as long."""

    resolution: int = 128
    """Width and height of the images [px]."""

    voxel_size: float = 0.1
    candidates: int = 40


SIZES: dict[SizeName, Size] = {
    "smoke": Size("flat", (0,), 30.0),
    "small": Size("apartment", (0, 1, 2), 60.0),
}
"""Some minutes on two cores; half an hour."""


@dataclass(frozen=True)
class Options:
    """How much sooner two cameras know a place than one does."""

    size: SizeName = "smoke"
    """How much is flown: `smoke` or `small`."""

    policy: str = "ours-pano"
    """Who chooses every camera's views."""

    out: Path = Path("experiments/results")
    """Folder of the results; they go into a folder named after the experiment and the size."""

    work: Path = Path("runs/team")
    """Folder of the flights that are done."""


def main(options: Options) -> Path:
    """Flies, writes the results, and returns their folder."""
    size, commit = SIZES[options.size], source_commit()
    records = [
        _kept_or_flown(options.work, crew, seed, size, options.policy, commit)
        for seed in size.seeds
        for crew in CREWS
    ]
    folder = options.out / NAME / options.size
    folder.mkdir(parents=True, exist_ok=True)
    origin = origin_of(f"experiments.{NAME}", records)
    write_csv(folder / "coverage.csv", coverage_rows(records), origin)
    write_markdown(folder / "team.md", page(records, options.size), origin)
    print(f"results  {folder}")
    return folder


def fly(crew: Crew, seed: int, size: Size, policy: str) -> list[dict[str, Any]]:
    """One mission: what all together knew after every view, by the clock."""
    config = ExplorationConfig(clock="model", voxel_size=size.voxel_size, num_probes=1)
    frontier = round(0.3 * size.candidates)
    members = [
        Member(
            simulator,
            make_policy(policy, num_candidates=size.candidates, num_frontier=frontier),
        )
        for simulator in _simulators(crew.cameras, seed, size)
    ]
    seconds = size.seconds if crew.cameras == 1 else size.seconds * 2.0 / 3.0
    result = explore_team(
        members,
        budget=f"seconds:{seconds:g}",
        seed=seed,
        config=config,
        meet_every=crew.meet_every,
    )
    return [dataclasses.asdict(view) for view in result.views]


def time_to(views: Sequence[dict[str, Any]], measure: str, level: float) -> float | None:
    """The clock when a measure first reached a level [s]; None: it never did."""
    return next((view["seconds"] for view in views if view[measure] >= level), None)


def time_rows(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per measure, share and crew: mean seconds over the seeds, and the share of one camera's."""
    by_crew = {
        crew: {r["flight"]["seed"]: r["views"] for r in records if r["flight"]["crew"] == crew}
        for crew in CREWS
    }
    rows: list[dict[str, Any]] = []
    for measure in MEASURES:
        for share in SHARES:
            levels = {
                seed: share * max(view[measure] for view in views)
                for seed, views in by_crew["one"].items()
            }
            row: dict[str, Any] = {"of": measure, "share": share}
            for crew, flights in by_crew.items():
                times = [time_to(flights[seed], measure, levels[seed]) for seed in levels]
                known = [time for time in times if time is not None]
                mean = float(np.mean(known)) if len(known) == len(times) else None
                row[f"{crew} [s]"] = mean
                if crew != "one":
                    row[f"{crew} / one"] = None if mean is None else mean / row["one [s]"]
            rows.append(row)
    return rows


def coverage_rows(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per view."""
    return [
        {key: record["flight"][key] for key in ("crew", "scene", "seed")} | view
        for record in records
        for view in record["views"]
    ]


def page(records: Sequence[dict[str, Any]], size: SizeName) -> list[str]:
    """The table, and how to read it."""
    given = SIZES[size]
    return [
        f"# Two cameras against one ({size})",
        f"Scene {given.scene}, seeds {', '.join(map(str, given.seeds))}. Seconds of the model "
        "clock until all together know a share of what the one camera knows after "
        f"{given.seconds:g} s, mean over the seeds, and the ratio of the means.",
        markdown_table(time_rows(records)),
        "`coverage.csv` holds every view.",
    ]


def _simulators(cameras: int, seed: int, size: Size) -> list[Simulator]:
    """The scene's own start, and for a second camera the first free place beside it."""
    camera = Camera.from_fov(size.resolution, size.resolution)
    first = open_scene(size.scene, camera=camera, seed=seed)
    found: list[Simulator] = [first]
    for place in places_beside(first.start_pose[:3, 3]):
        if len(found) == cameras:
            break
        try:
            found.append(
                open_scene(size.scene, camera=camera, seed=seed, start_pose=level_pose(place, 0.0))
            )
        except ValueError:
            continue  # in a wall, or too close to one
    return found


def _kept_or_flown(
    work: Path, crew: str, seed: int, size: Size, policy: str, commit: str | None
) -> dict[str, Any]:
    settings = {k: v for k, v in dataclasses.asdict(size).items() if k != "seeds"}
    flight = {"crew": crew, "seed": seed, "policy": policy, "commit": commit} | settings
    path = work / f"{size.scene}-{policy}-{crew.replace(' ', '-')}-seed{seed}.json"
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["flight"] == flight:
            return kept
    views = fly(CREWS[crew], seed, size, policy)
    record = {"flight": flight, "machine": machine(), "views": views}
    work.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps(record).encode())
    print(f"{path.name}: {len(views)} views", flush=True)
    return record


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
