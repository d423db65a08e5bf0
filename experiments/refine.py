"""What refining a decision gains and takes: the same decisions with it and without.

    r3jax explore --scene apartment --budget views:40 --resolution 256
    python -m experiments.refine runs/apartment-ours-pano-seed0

After every few views of a recorded run each policy decides twice, from the same map with the same
key: as it is, and with its best candidates refined. The utility of both views is worked out anew by
`r3jax.view_utility`, for all policies: a choice by another measure than U (the paths
of `ours-ahead`) need not gain in it. Decisions are made twice and the second is timed, so
that compiling does not count.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.pages.artifacts import (
    Origin,
    command_line,
    markdown_table,
    write_csv,
    write_markdown,
)
from r3jax.apps.benchmark.record import machine, source_commit
from r3jax.exploration.replay import planner_config_of, states_of
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.decision import prepare_decision
from r3jax.planning.policy import Decision
from r3jax.planning.registry import make_policy
from r3jax.scoring.utility import view_utility
from r3jax.trace.reader import Run, read_run

NAME = "refine"


@dataclass(frozen=True)
class Options:
    """What to compare."""

    run: Annotated[Path, tyro.conf.Positional]
    """A run."""

    refine: int = 4
    """Candidates that climb."""

    policies: tuple[str, ...] = ("ours", "ours-pano")
    """Who decides."""

    every: int = 4
    """A decision after every so many views."""

    views: int = 40
    """Views of the run, at most."""

    out: Path = Path("experiments/results")
    """Folder of the results."""


def main(options: Options) -> Path:
    """Decides, compares, and returns the folder of the results."""
    run = read_run(options.run)
    rows = list(all_rows(run, options))
    folder = options.out / NAME / run.path.name
    folder.mkdir(parents=True, exist_ok=True)
    origin = Origin(command_line(f"experiments.{NAME}"), machine(), source_commit() or "unknown")
    write_csv(folder / f"{NAME}.csv", rows, origin)
    write_markdown(folder / f"{NAME}.md", page(rows, run, options), origin)
    print(f"results  {folder}")
    return folder


def all_rows(run: Run, options: Options) -> Iterator[dict[str, Any]]:
    """One for each policy and place."""
    base = vars(planner_config_of(run)) | {"refine": 0}
    policies = {
        (name, num): make_policy(name, **base | {"refine": num})
        for name in options.policies
        for num in (0, options.refine)
    }
    states: dict[Any, Any] = {}
    known = zip(run.rows[: options.views], states_of(run), strict=False)
    for row, (map_state, grid) in known:
        pose = np.asarray(row.pose, dtype=np.float64)
        if not states:
            camera = run.frame(row.step).camera
            key = jax.random.key(0)
            states = {who: policy.init(camera, grid, key=key) for who, policy in policies.items()}
        if (row.step + 1) % options.every == 0:
            for name in options.policies:
                yield compared(name, policies, states, map_state, grid, pose, row.step, options)
        path = np.stack([pose[:3, 3], pose[:3, 3]])
        for who, policy in policies.items():
            states[who] = policy.follow(states[who], map_state, grid, pose, path)


def compared(
    name: str,
    policies: dict[Any, Any],
    states: dict[Any, Any],
    map_state: MapState,
    grid: OccupancyGrid,
    pose: np.ndarray,
    step: int,
    options: Options,
) -> dict[str, Any]:
    """One decision, twice."""
    row: dict[str, Any] = {"policy": name, "views": step + 1}
    for num, word in ((0, "plain"), (options.refine, "refined")):
        who = (name, num)
        decide = lambda who=who: policies[who].decide(
            states[who], map_state, grid, pose, key=jax.random.key(step)
        )
        decide()
        begin = time.perf_counter()
        decision, _, _ = decide()
        milliseconds = 1e3 * (time.perf_counter() - begin)
        config, state = policies[who].config, states[who]
        _, _, masked = prepare_decision(state, map_state, grid, pose, config)
        utility = exact(map_state, masked, state.camera, decision, config)
        row |= {f"{word}_utility": utility, f"{word}_ms": round(milliseconds, 2)}
    return row | {"gain": row["refined_utility"] / max(row["plain_utility"], 1e-9) - 1.0}


def exact(
    map_state: MapState, grid: OccupancyGrid, camera: Any, decision: Decision | None, config: Any
) -> float:
    """U of the view that was chosen; 0 if there was none."""
    if decision is None:
        return 0.0
    T = jnp.asarray(decision.T_world_camera, dtype=jnp.float32)
    return float(view_utility(map_state, grid, camera, T, config.scoring).total)


def page(rows: list[dict[str, Any]], run: Run, options: Options) -> list[str]:
    """A table, and how to read it."""
    table = []
    for name in options.policies:
        own = [row for row in rows if row["policy"] == name]
        gain = np.array([row["gain"] for row in own])
        plain, refined = (
            float(np.median([row[f"{word}_ms"] for row in own])) for word in ("plain", "refined")
        )
        table.append(
            {
                "policy": name,
                "decisions": len(own),
                "gain in U, median [%]": round(100.0 * float(np.median(gain)), 1),
                "mean [%]": round(100.0 * float(gain.mean()), 1),
                "no less [%]": round(100.0 * float((gain >= -1e-5).mean()), 1),
                "decision, median [ms]": round(plain),
                "refined [ms]": round(refined),
            }
        )
    return [
        f"# Refining {options.refine} candidates: {run.path.name}",
        "The view that is chosen, with refinement against without, from the same map with the same "
        "key. U is that of the view alone: a refined view of another candidate may win for a "
        "shorter path.",
        markdown_table(table),
        f"`{NAME}.csv` holds every decision.",
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
