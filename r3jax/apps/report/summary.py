"""The numbers of a run, for the report and for `r3jax info`."""

from dataclasses import dataclass

import numpy as np

from r3jax.exploration.config import budget_words, format_budget
from r3jax.exploration.state import StopReason
from r3jax.runs.reader import Run

STAGES = {
    "plan": "planning",
    "plan.candidates": "– candidates",
    "plan.travel": "– travel",
    "plan.scoring": "– scoring",
    "plan ahead": "planning while moving",
    "reconsider": "reconsidering on arrival",
    "gaze": "gaze while moving",
    "map": "mapping",
    "map.voxels": "mapping: voxels",
    "map.grid": "mapping: grid",
    "map.policy": "mapping: policy's own",
    "render": "simulator",
    "record": "writing to disk",
    "measure": "coverage numbers",
}
"""Stages of timings.jsonl in the order of the table, with their displayed names; older runs split
mapping into three parts."""

ON_CLOCK = (
    "plan",
    "plan ahead",
    "reconsider",
    "gaze",
    "map",
    "map.voxels",
    "map.grid",
    "map.policy",
)
"""Stages that count on the mission clock (beside the flight)."""


@dataclass(frozen=True)
class StageTime:
    """Times of one stage over the views of a run."""

    name: str
    on_clock: bool
    median: float
    """[s]."""

    p95: float
    """95th percentile [s]."""

    total: float
    """[s]."""


def stage_times(run: Run) -> list[StageTime]:
    """Computes the measured times by stage; stages that never ran are left out."""
    table: list[StageTime] = []
    known = [*STAGES, *sorted({k for t in run.timings for k in t} - {"step", *STAGES})]
    for key in known:
        seconds = np.array([t[key] for t in run.timings if key in t])
        if seconds.size:
            median, p95 = (float(v) for v in np.percentile(seconds, [50, 95]))
            total = float(seconds.sum())
            name = STAGES.get(key, f"– {key.partition('.')[2] or key}")
            table.append(StageTime(name, key in ON_CLOCK, median, p95, total))
    return table


def count_of_views(run: Run) -> str:
    """Counts views and, beside them, frames captured while moving."""
    captured = sum(row.captured for row in run.rows)
    views = str(len(run.rows) - captured)
    return f"{views} + {captured} while moving" if captured else views


def outcome(run: Run) -> str:
    """Describes how a run ended; for a spent budget, with its amount."""
    if run.end is None or run.end.outcome != StopReason.BUDGET.value:
        return run.outcome
    spent = run.end.message.partition(": ")[0]
    return f"the budget of {budget_words(run.header.budget)} is used up: {spent}"


def summary(run: Run) -> dict[str, str]:
    """Summarizes a run in short texts under short names."""
    header = run.header
    texts = {
        "scene": str(header.scene.get("name", "?")),
        "policy": str(header.policy.get("name", "?")),
        "budget": format_budget(header.budget),
        "seed": str(header.seed),
        "outcome": outcome(run),
        "views": count_of_views(run),
    }
    if not run.rows:
        return texts
    last = run.rows[-1]
    coverage = last.coverage
    used = coverage.voxels * map_row_bytes(run)
    return texts | {
        "mission": f"{last.seconds:.1f} s on the {header.config.get('clock', '?')} clock",
        "path": f"{last.metres:.1f} m, {np.rad2deg(last.radians):.0f}° turned",
        "explored": f"{100 * coverage.known_share:.1f} % of the box "
        f"({coverage.known_cells} cells; {coverage.frontier_cells} frontier cells left)",
        "mean renderability": f"{coverage.mean_renderability:.3f}",
        "map": f"{coverage.voxels} voxels, {used / 1e6:.1f} MB in use, "
        f"{coverage.map_bytes / 1e6:.1f} MB allocated",
        "dropped observations": str(coverage.dropped),
    }


def map_row_bytes(run: Run) -> int:
    """Returns the bytes of one row of the map.

    A row has two words of key, the bins, count, color, m2, resolution and misses.
    """
    num_words = -(-int(run.header.config.get("num_bins", 64)) // 32)
    misses = int(bool(run.header.config.get("remove_moved", False)))
    return 4 * (2 + num_words + 1 + 3 + 1 + 1) + misses
