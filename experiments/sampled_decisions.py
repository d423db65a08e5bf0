"""Decisions that score a sample of the voxels, against the exact ones in the same places.

    python -m experiments.sampled_decisions --size small

A planner flies on its exact decisions. Each is made again with `scoring.sample`, from the same
place, map, candidates and key, and compared: is the same view chosen, and if not, how much of the
exact plan's worth is lost? Both are timed in turn: run this on an idle machine.
"""

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro

from experiments.pages.artifacts import (
    joint_origin,
    markdown_table,
    write_csv,
    write_markdown,
)
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.geometry.cameras import Camera
from r3jax.planning.planner import Planner, decide, follow, observe, start
from r3jax.planning.policy import Decision
from r3jax.planning.registry import make_policy
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.scenes.registry import open_scene

NAME = "sampled_decisions"

COMPILING = 3
"""First decisions of a flight, whose times do not count."""

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Size:
    """How much is flown."""

    scenes: tuple[str, ...]
    decisions: int
    """Of every policy in every scene."""

    resolution: int
    """Width and height of the images [px]."""


SizeName = Literal["smoke", "small"]
SIZES: dict[SizeName, Size] = {
    "smoke": Size(("flat",), 4, 64),
    "small": Size(("flat", "office", "apartment"), 67, 256),
}
"""A minute; a quarter of an hour on two idle cores."""


@dataclass(frozen=True)
class Options:
    """What is compared."""

    size: SizeName = "smoke"
    """How much is flown."""

    policies: tuple[str, ...] = ("ours-pano", "ours-ahead")
    """Whose decisions."""

    samples: tuple[int, ...] = (4,)
    """One voxel of so many is scored."""

    out: Path = Path("experiments/results")
    """Folder of the results; they go into a folder named after the experiment and the size."""


def main(options: Options) -> Path:
    """Flies, writes the results, and returns their folder."""
    folder = options.out / NAME / options.size
    folder.mkdir(parents=True, exist_ok=True)
    size = SIZES[options.size]
    rows = [
        row
        for policy in options.policies
        for scene in size.scenes
        for row in decisions_of(policy, scene, size, options.samples)
    ]
    origin = joint_origin(f"experiments.{NAME}", [machine()], [source_commit()])
    write_csv(folder / "decisions.csv", rows, origin)
    write_markdown(folder / f"{NAME}.md", page(rows, options.size), origin)
    print(f"results  {folder}")
    return folder


def decisions_of(
    policy: str, scene: str, size: Size, samples: tuple[int, ...]
) -> Iterator[dict[str, Any]]:
    """A row for every decision and sample of a flight on exact decisions."""
    simulator = open_scene(scene, camera=Camera.from_fov(size.resolution, size.resolution))
    pose = np.asarray(simulator.start_pose, dtype=np.float64)
    planner = start(simulator.camera, simulator.bounds, make_policy(policy), starts=[pose])
    estimates = [make_policy(policy, scoring=ScoringConfig(sample=one_of)) for one_of in samples]
    for number, key in enumerate(jax.random.split(jax.random.key(0), size.decisions), 1):
        planner = observe(planner, simulator.render(pose))
        exact, seconds = _timed(planner, pose, key)
        if exact is None:
            return
        for sample, estimate in zip(samples, estimates, strict=True):
            asked = dataclasses.replace(planner, policy=estimate)
            found, sampled_seconds = _timed(asked, pose, key)
            yield {
                "policy": policy,
                "scene": scene,
                "decision": number,
                "sample": sample,
                **compared(exact, found),
                "exact_ms": 1e3 * seconds,
                "sampled_ms": 1e3 * sampled_seconds,
            }
        planner = follow(planner, pose, exact.waypoints)
        pose = exact.T_world_camera


def _timed(planner: Planner, pose: np.ndarray, key: jax.Array) -> tuple[Decision | None, float]:
    begin = time.perf_counter()
    decision, *_ = decide(planner, pose, key)
    return decision, time.perf_counter() - begin


def compared(exact: Decision, found: Decision | None) -> dict[str, Any]:
    """Whether both choose one place and one view, and the share of the exact total that is lost.

    Totals are those of the exact decision, of whose candidates both have the positions. NaN: what
    was chosen has none there, because no path of the exact beam begins at it.
    """
    if found is None:
        return {"same_place": False, "same_view": False, "loss": float("nan")}
    places = exact.candidates[:, :3, 3]
    gap = np.linalg.norm(places - found.T_world_camera[:3, 3], axis=1)
    total = exact.utilities["total"]
    # Padding repeats places: the one that counts has the greatest total.
    own = np.where(gap <= gap.min(), total, -np.inf).max()
    known = total[np.isfinite(total)]
    # From 0 up at least: of a few paths that are all good the worst has not lost everything.
    best, least = known.max(), min(known.min(), 0.0)
    lost = (best - own) / max(best - least, 1e-12) if np.isfinite(own) else float("nan")
    apart = np.abs(found.T_world_camera - exact.T_world_camera).max()
    is_same = np.linalg.norm((found.T_world_camera - exact.T_world_camera)[:3, 3]) < 1e-6
    return {"same_place": bool(is_same), "same_view": bool(apart < 1e-4), "loss": float(lost)}


def page(rows: Rows, size: str) -> list[str]:
    """A row for every policy, scene and sample; medians leave out decisions that compile."""
    groups: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        groups.setdefault((row["policy"], row["scene"], row["sample"]), []).append(row)
    table = [_summary(key, group) for key, group in groups.items()]
    return [
        f"# Decisions on a sample of the voxels ({size})",
        "`place`, `view`: of how many decisions the sample chooses the same; `lost`: what its "
        "choice has less of the exact total, as a share of what the best candidate has over the "
        "worst (over 0, if all have more), where the exact decision gave it one (`rated`); medians "
        "of milliseconds.",
        markdown_table(table),
    ]


def _summary(key: tuple[Any, ...], group: Rows) -> dict[str, Any]:
    column = lambda name: np.array([row[name] for row in group])
    losses = column("loss")[np.isfinite(column("loss"))]
    percent = lambda value, digits=0: f"{100 * value:.{digits}f} %"
    # Of a short flight all decisions, or there would be none.
    settled = COMPILING if len(group) > COMPILING else 0
    milliseconds = lambda name: f"{np.median(column(name)[settled:]):.0f}"
    return {
        **dict(zip(("policy", "scene", "sample"), key, strict=True)),
        "decisions": len(group),
        "place": percent(column("same_place").mean()),
        "view": percent(column("same_view").mean()),
        "rated": percent(len(losses) / len(group)),
        "mean lost": percent(losses.mean(), 1) if len(losses) else "-",
        "95 % lose less than": percent(np.percentile(losses, 95), 1) if len(losses) else "-",
        "exact [ms]": milliseconds("exact_ms"),
        "sampled [ms]": milliseconds("sampled_ms"),
    }


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
