"""Does a planner go round in circles? Positions in the order of acquisition, revisits, coverage.

    python -m experiments.degeneracy --size smoke

The cells are those of `experiments.paper views`. A view *revisits* if an earlier one was
taken within 0.5 m of it and looked within 30 degrees of the same direction: the new image then
shows little else. The paper shows its own planner trapped (its figure on Office3).
"""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.pages.artifacts import (
    Origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.pages.positions_figure import positions_figure
from experiments.suite import Options, Records, origin, run_suite
from r3jax.evaluation.comparison import method_name, methods_of, snapshots_of, with_short_names
from r3jax.runs.reader import read_run

NAME = "degeneracy"

NEAR = 0.5
"""Two views are at the same place within this distance [m]."""

ALIKE = np.cos(np.deg2rad(30.0))
"""Cosine between the directions of two views that show much the same."""


def main(options: Options) -> Path:
    """Runs the cells, draws where the cameras were, and returns the folder of the results."""
    root, records = run_suite(options, "views")
    folder = options.out / NAME / options.size
    write_page(folder, root, records, origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def revisit_rate(poses: np.ndarray) -> float:
    """Share of the views after the first that revisit an earlier one, from [n, 4, 4] poses."""
    positions, axes = poses[:, :3, 3], poses[:, :3, 2]
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    alike = (distance <= NEAR) & (axes @ axes.T >= ALIKE)
    earlier = np.tril(alike, k=-1).any(axis=1)
    return float(earlier[1:].mean()) if len(poses) > 1 else 0.0


def missions(root: Path, records: Records) -> list[dict[str, Any]]:
    """Returns one row per cell: its poses, and what the last snapshot says of it."""
    last = snapshots_of(records)[-1]
    rows = []
    for record in (record for record in records if record["snapshot"] == last):
        views = record["exploration"]["views"]
        run = read_run(root / record["run"])
        rows.append(
            {
                "record": record,
                "poses": np.stack([np.asarray(row.pose, np.float64) for row in run.rows[:views]]),
                "box": np.asarray(run.header.bounds, np.float64),
            }
        )
    return rows


def write_page(folder: Path, root: Path, records: Records, source: Origin) -> None:
    """Writes a picture for each scene (first seed), the table, and the page."""
    folder.mkdir(parents=True, exist_ok=True)
    found = missions(root, with_short_names(records))
    rows = table_rows(found)
    write_csv(folder / "missions.csv", rows, source)
    by_scene: dict[str, dict[str, np.ndarray]] = defaultdict(dict)
    boxes = {}
    for mission in found:
        record = mission["record"]
        by_scene[record["scene"]].setdefault(method_name(record), mission["poses"][:, :3, 3])
        boxes[record["scene"]] = tuple(mission["box"])
    pictures = []
    for scene, positions in by_scene.items():
        figure = positions_figure(positions, boxes[scene], scene)
        write_figure(folder / f"{scene}.png", figure, source)
        pictures.append(f"![{scene}]({scene}.png)")
    page = [markdown_table(mean_rows(rows, methods_of(records))), *pictures]
    write_markdown(folder / f"{NAME}.md", page, source)


def table_rows(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns one row per cell, numbers only."""
    return [
        {"scene": mission["record"]["scene"], "policy": method_name(mission["record"])}
        | {
            "seed": mission["record"]["seed"],
            "views": len(mission["poses"]),
            "revisit_rate": revisit_rate(mission["poses"]),
            "known_share": mission["record"]["exploration"]["known_share"],
            "metres": mission["record"]["exploration"]["metres"],
        }
        for mission in found
    ]


def mean_rows(rows: list[dict[str, Any]], policies: list[str]) -> list[dict[str, Any]]:
    """Returns means over scenes and seeds, a line per policy."""
    names = {
        "revisit_rate": "revisit rate",
        "known_share": "share of the box explored",
        "metres": "path [m]",
    }
    return [
        {"policy": policy}
        | {
            title: float(np.mean([row[name] for row in rows if row["policy"] == policy]))
            for name, title in names.items()
        }
        for policy in policies
        if any(row["policy"] == policy for row in rows)
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
