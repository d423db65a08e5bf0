"""Milliseconds of planning against key frames, for every policy.

    python -m experiments.planner_latency --size smoke

The parts of a step: *decide* (travel, candidates, scoring), *integrate* the frame into the map,
update the coarse *grid*, and let the policy *observe* the frame. Compiling does not count, nor do
the simulator and the bookkeeping. Percentiles are taken over the decisions of all missions of a
policy whose number of key frames falls into the same group.

The time on a machine that does other things too says little: run this on an idle one.
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
from experiments.pages.cost_figures import latency_figure
from experiments.planner_runs import PLANNING, SIZES, STAGES, Options, bucket_of, fly_all

NAME = "planner_latency"
_COLUMNS = (*STAGES, *(f"decide.{part}" for part in PLANNING))

Records = Sequence[dict[str, Any]]


def main(options: Options) -> Path:
    """Measures, writes the results, and returns their folder."""
    records = fly_all(options)
    folder = options.out / NAME / options.size
    folder.mkdir(parents=True, exist_ok=True)
    origin = origin_of(f"experiments.{NAME}", records)
    bucket = SIZES[options.size].bucket
    write_csv(folder / "steps.csv", step_rows(records), origin)
    write_csv(folder / "percentiles.csv", percentile_rows(records, bucket), origin)
    figure = latency_figure(decide_samples(records, bucket), "A decision's time")
    write_figure(folder / "latency.png", figure, origin)
    write_markdown(folder / "latency.md", page(records, bucket, options.size), origin)
    print(f"results  {folder}")
    return folder


def step_rows(records: Records) -> list[dict[str, Any]]:
    """Returns one row per decision, in milliseconds."""
    return [
        {key: record["flight"][key] for key in ("policy", "scene", "seed")}
        | {"key_frames": row["key_frames"]}
        | {f"{name}_ms": round(row[f"{name}_ms"], 4) for name in _COLUMNS}
        for record in records
        for row in record["rows"]
    ]


def samples_of(records: Records, policy: str, name: str) -> list[tuple[int, float]]:
    """Returns the key frames and milliseconds of every step of a policy."""
    return [
        (row["key_frames"], row[f"{name}_ms"])
        for record in records
        if record["flight"]["policy"] == policy
        for row in record["rows"]
    ]


def policies_of(records: Records) -> list[str]:
    """In the order of their first missions."""
    return list(dict.fromkeys(record["flight"]["policy"] for record in records))


def percentile_rows(records: Records, bucket: int) -> list[dict[str, Any]]:
    """Returns p50, p95 and p99 of every part of a step, per policy and group of key frames."""
    rows = []
    for policy in policies_of(records):
        for name in _COLUMNS:
            groups: dict[tuple[int, int], list[float]] = {}
            for key_frames, milliseconds in samples_of(records, policy, name):
                groups.setdefault(bucket_of(key_frames, bucket), []).append(milliseconds)
            for (first, last), values in sorted(groups.items()):
                rows.append(
                    {"policy": policy, "part": name, "first": first, "last": last}
                    | {"steps": len(values)}
                    | percentiles(values)
                )
    return rows


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Returns p50, p95 and p99, rounded to what can be measured [ms]."""
    return {f"p{p}_ms": round(float(np.percentile(values, p)), 4) for p in (50, 95, 99)}


def decide_samples(records: Records, bucket: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Per policy the middle of each full group of key frames, and the milliseconds in it."""
    found = {}
    for policy in policies_of(records):
        groups: dict[tuple[int, int], list[float]] = {}
        for key_frames, milliseconds in samples_of(records, policy, "decide"):
            groups.setdefault(bucket_of(key_frames, bucket), []).append(milliseconds)
        most = max((len(values) for values in groups.values()), default=0)
        # A run that ended early leaves groups that hold fewer decisions than the others.
        full = {group: values for group, values in sorted(groups.items()) if len(values) == most}
        if full:
            middles = np.array([0.5 * (first + last) for first, last in full])
            found[policy] = middles, np.array(list(full.values()))
    return found


def page(records: Records, bucket: int, size: str) -> list[str]:
    """Returns the table of a decision, the table of a frame, and how to read them."""
    decisions, frames = [], []
    for policy in policies_of(records):
        decide = samples_of(records, policy, "decide")
        groups = sorted({bucket_of(key_frames, bucket) for key_frames, _ in decide})
        inside = lambda group, steps: [ms for k, ms in steps if group[0] <= k <= group[1]]
        medians = (
            {
                f"p50 of frames {a}-{b}": float(np.median(inside((a, b), decide)))
                for a, b in dict.fromkeys((groups[0], groups[-1]))
            }
            if groups
            else {}
        )
        every = percentiles([ms for _, ms in decide])
        decisions.append({"policy": policy, "decisions": len(decide)} | every | medians)
        parts = {
            name: float(np.median([ms for _, ms in samples_of(records, policy, name)]))
            for name in (*STAGES, *(f"decide.{part}" for part in PLANNING))
            if name != "decide"
        }
        frames.append({"policy": policy} | parts)
    return [
        f"# What planning takes ({size})",
        "Milliseconds of a decision: percentiles over all, medians of the first and of the last "
        "key frames.",
        markdown_table(decisions),
        "Median milliseconds of the other parts of a step, and of the parts of a decision.",
        markdown_table(frames),
        "![milliseconds against key frames](latency.png)",
        f"`steps.csv` holds every step, `percentiles.csv` groups of {bucket} key frames.",
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
