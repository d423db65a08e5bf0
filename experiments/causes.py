"""What the chosen views were to mend: their utility by cause, early and late in a run.

    python -m experiments.causes --size small --scenes flat office

For all policies by one measure, U = lambda1 U_G + U_R (`scoring.explain`), whatever they chose by,
on what was known before each view. The runs are those of `experiments.extensions`. Causes that one
policy can tell apart and another cannot matter as much as they take up here.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.extensions import Options, requests_of
from experiments.pages.artifacts import Origin, markdown_table, write_csv, write_markdown
from experiments.suite import Records, by_method_and_scene, origin, run_requests
from r3jax.evaluation.comparison import snapshots_of, with_short_names
from r3jax.exploration.explain_run import explain_run
from r3jax.scoring.explain import CAUSES
from r3jax.trace.reader import read_run

NAME = "causes"

PARTS = 3
"""Number of parts of a run, one after the other."""


def main(options: Options) -> Path:
    """Explains every run, writes the page, and returns its folder."""
    root, _, records = run_requests(options, "views", requests_of(options))
    last = snapshots_of(records)[-1]
    records = with_short_names([record for record in records if record["snapshot"] == last])
    totals = [totals_of(root / record["run"]) for record in records]
    folder = options.out / NAME / options.size
    write_page(folder, table_rows(records, totals), origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def totals_of(run: Path) -> np.ndarray:
    """What each view after the first promised when it was chosen, by cause, [views - 1, 4]."""
    return np.array([why.totals for why in explain_run(read_run(run)) if why is not None])


def table_rows(records: Records, totals: Sequence[np.ndarray]) -> list[dict[str, Any]]:
    """A line per method, scene and part of the runs: means over its views and the seeds.

    Args:
        records: one per run.
        totals: of `totals_of`, for the same runs.
    """
    rows: list[dict[str, Any]] = []
    for method, scene, runs in by_method_and_scene(records, totals):
        parts = zip(*(np.array_split(run, PARTS) for run in runs), strict=True)
        for number, part in enumerate(parts, start=1):
            mean = np.concatenate(part).mean(axis=0)
            lack = float(mean[1:].sum())
            share = 100.0 * float(mean[2]) / lack if lack else None
            rows.append(
                {"method": method, "scene": scene, "part": f"{number} of {PARTS}"}
                | dict(zip(CAUSES, mean.tolist(), strict=True))
                | {"inconsistent, share of U_R [%]": share}
            )
    return rows


def write_page(folder: Path, rows: Sequence[dict[str, Any]], source: Origin) -> None:
    """Writes the table."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / f"{NAME}.csv", rows, source)
    page = [
        "# What the chosen views were to mend",
        "Utility of a view when it was chosen, by cause, means over views and seeds: lambda1 times "
        "the unexplored cells that it would see, and of the voxels that it would see 1 - R, "
        "divided among too oblique, inconsistent in color, and too far. No view can mend what is "
        "inconsistent.",
        markdown_table(rows),
    ]
    write_markdown(folder / f"{NAME}.md", page, source)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
