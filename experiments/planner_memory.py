"""Bytes of planning against key frames, for every policy.

    python -m experiments.planner_memory --size smoke

Three answers, from the narrowest to the widest: the arrays that outlive a step (map, coarse grid,
the policy's own state); what the device holds at its peak, scoring included (GPUs only); and what
the process has taken since before the first view, compiled programs included (Linux only; on a
CPU it holds the arrays too). Beside that stands what it gives back when JAX forgets its programs.
The missions are those of `experiments.planner_latency`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.pages.artifacts import (
    markdown_table,
    origin_of,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.pages.cost_figures import memory_figure
from experiments.planner_runs import Options, fly_all

NAME = "planner_memory"

PAPER_LIMIT = 300e6
"""What the paper says its planner stays under on a GPU [bytes]."""

_COLUMNS = (
    "map_bytes",
    "map_used_bytes",
    "grid_bytes",
    "policy_bytes",
    "device_bytes",
    "device_peak_bytes",
    "process_bytes",
)

Records = Sequence[dict[str, Any]]
Curves = dict[str, tuple[np.ndarray, np.ndarray]]


def main(options: Options) -> Path:
    """Measures, writes the results, and returns their folder."""
    records = fly_all(options)
    folder = options.out / NAME / options.size
    folder.mkdir(parents=True, exist_ok=True)
    origin = origin_of(f"experiments.{NAME}", records)
    write_csv(folder / "steps.csv", step_rows(records), origin)
    curves = {"arrays": held_curves(records)} | dict([total_curves(records)])
    titles = {
        "arrays": "Map, grid and the policy's state",
        "device": "Device memory, peak",
        "process": "Process memory since before the first view",
    }
    shown = {kind: found for kind, found in curves.items() if found}
    for kind, found in shown.items():
        limit = PAPER_LIMIT if kind == "device" else None
        write_figure(folder / f"{kind}.png", memory_figure(found, titles[kind], limit), origin)
    pictures = [f"![{titles[kind]}]({kind}.png)" for kind in shown]
    write_markdown(folder / "memory.md", [*page(records, options.size), *pictures], origin)
    print(f"results  {folder}")
    return folder


def step_rows(records: Records) -> list[dict[str, Any]]:
    """Returns one row per decision, in bytes; empty where the machine does not say."""
    return [
        {key: record["flight"][key] for key in ("policy", "scene", "seed")}
        | {"key_frames": row["key_frames"]}
        | {name: row[name] for name in _COLUMNS}
        | {"process_growth_bytes": growth(record, row)}
        for record in records
        for row in record["rows"]
    ]


def held(row: dict[str, Any]) -> int:
    """Returns bytes of the arrays that outlive a step."""
    return row["map_bytes"] + row["grid_bytes"] + row["policy_bytes"]


def growth(record: dict[str, Any], row: dict[str, Any]) -> int | None:
    """Returns the memory that the process has taken since before the first view [bytes]; None.

    Not known.
    """
    before, now = record["process_bytes_before"], row["process_bytes"]
    return None if before is None or now is None else now - before


def held_curves(records: Records) -> Curves:
    """Returns bytes of the arrays against key frames: the largest over a policy's missions."""
    return _largest(records, lambda record, row: held(row))


def total_curves(records: Records) -> tuple[str, Curves]:
    """Returns what the device holds at its peak, or the process where there is no other device."""
    device = _largest(records, lambda record, row: row["device_peak_bytes"])
    return ("device", device) if device else ("process", _largest(records, growth))


def _largest(records: Records, value: Any) -> Curves:
    found: dict[str, dict[int, int]] = {}
    for record in records:
        for row in record["rows"]:
            measured = value(record, row)
            if measured is not None:
                curve = found.setdefault(record["flight"]["policy"], {})
                curve[row["key_frames"]] = max(measured, curve.get(row["key_frames"], 0))
    return {
        policy: (np.array(sorted(curve)), np.array([curve[k] for k in sorted(curve)]))
        for policy, curve in found.items()
    }


def page(records: Records, size: str) -> list[str]:
    """The table: megabytes after each policy's last frame, the largest over its missions."""
    policies = dict.fromkeys(record["flight"]["policy"] for record in records)
    table = []
    for policy in policies:
        lasts = [
            (record, record["rows"][-1])
            for record in records
            if record["flight"]["policy"] == policy and record["rows"]
        ]
        most = lambda values: max((v / 1e6 for v in values if v is not None), default=None)
        table.append(
            {
                "policy": policy,
                "key frames": max(row["key_frames"] for _, row in lasts),
                "map, in use": most(row["map_used_bytes"] for _, row in lasts),
                "map, allocated": most(row["map_bytes"] for _, row in lasts),
                "grid": most(row["grid_bytes"] for _, row in lasts),
                "policy's own": most(row["policy_bytes"] for _, row in lasts),
                "device, peak": most(row["device_peak_bytes"] for _, row in lasts),
                "process, growth": most(growth(record, row) for record, row in lasts),
                "compiled programs": most(record["compiled_bytes"] for record, _ in lasts),
            }
        )
    return [f"# What planning holds ({size})", "Megabytes.", markdown_table(table)]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
