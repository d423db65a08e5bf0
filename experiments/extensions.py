"""What goes beyond the paper, against `ours-pano` on equal budgets: quality, paths, revisits.

    python -m experiments.extensions --size smoke

A variant is a policy, or a policy with settings: `ours-pano:refine=4,lambda1=0.5`. The cells lie
beside those of `experiments.replica_dense_views`, and what is done there is not done again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.degeneracy import missions, revisit_rate
from experiments.pages.artifacts import Origin, markdown_table, write_csv, write_markdown
from experiments.pages.table_formats import to_markdown
from experiments.replica_dense import REFERENCE, tables_of
from experiments.suite import Options as SuiteOptions
from experiments.suite import Records, by_method_and_scene, origin, request_of, run_requests
from r3jax.apps.benchmark.conditions import parse_settings
from r3jax.apps.benchmark.plan import Request
from r3jax.evaluation.comparison import (
    methods_of,
    scores_by_method,
    snapshots_of,
    with_short_names,
)
from r3jax.evaluation.statistics import paired_difference

NAME = "beyond"


@dataclass(frozen=True)
class Options(SuiteOptions):
    """What is compared."""

    variants: tuple[str, ...] = (REFERENCE, f"{REFERENCE}:refine=4", "ours-ahead")
    """Policies, with settings if given: `NAME` or `NAME:SETTING=VALUE,SETTING=VALUE`."""


def main(options: Options) -> Path:
    """Runs what is left of the cells, writes the page, and returns the folder of the results."""
    root, _, records = run_requests(options, "views", requests_of(options))
    folder = options.out / NAME / options.size
    write_page(folder, root, records, origin("experiments.extensions", records))
    print(f"results  {folder}")
    return folder


def requests_of(options: Options) -> list[Request]:
    """What the benchmark is asked for, scene by scene: the first to be done can be compared.

    Raises:
        ValueError: the reference is missing, or a variant is not one.
    """
    variants = [parse_variant(text) for text in options.variants]
    if (REFERENCE, {}) not in variants:
        raise ValueError(f"--variants lacks {REFERENCE}, which the others are compared with")
    common = request_of(options, "views")
    return [
        replace(common, scenes=(scene,), policies=(policy,), settings=settings)
        for scene in common.scenes
        for policy, settings in variants
    ]


def parse_variant(text: str) -> tuple[str, dict[str, Any]]:
    """Policy and settings of `NAME:SETTING=VALUE,...`; `NAME` alone has none.

    Raises:
        ValueError: a setting without a value.
    """
    policy, _, settings = text.partition(":")
    try:
        return policy, parse_settings(filter(None, settings.split(",")))
    except ValueError as error:
        raise ValueError(f"variant {text!r} takes {error}") from None


def write_page(folder: Path, root: Path, records: Records, source: Origin) -> None:
    """Writes the benchmark's tables at the whole budget, those of the paths, and the aim."""
    folder.mkdir(parents=True, exist_ok=True)
    last = snapshots_of(records)[-1]
    tables = tables_of([record for record in records if record["snapshot"] == last])
    paths = path_rows(missions(root, with_short_names(records)))
    aims = aim_rows(records)
    write_csv(folder / "paths.csv", paths, source)
    write_csv(folder / "with_fewer_views.csv", aims, source)
    page = [
        *(to_markdown(table) for table in tables.values()),
        "**Paths**, means over seeds; a view *revisits* as in `experiments.degeneracy`",
        markdown_table(paths),
        f"**Fewer views**: PSNR [dB] minus that of {REFERENCE} after {last}, the same test views",
        markdown_table([{k: _text(v) for k, v in row.items()} for row in aims]),
    ]
    write_markdown(folder / f"{NAME}.md", page, source)


def path_rows(found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per method and scene: what it went and saw, means over the seeds."""
    records = [mission["record"] for mission in found]
    rows: list[dict[str, Any]] = []
    for method, scene, mine in by_method_and_scene(records, found):
        done = [mission["record"]["exploration"] for mission in mine]
        rows.append(
            {
                "method": method,
                "scene": scene,
                "revisit rate": float(np.mean([revisit_rate(m["poses"]) for m in mine])),
                "path [m]": float(np.mean([d["metres"] for d in done])),
                "turns [rad]": float(np.mean([d["radians"] for d in done])),
                "share of the box explored": float(np.mean([d["known_share"] for d in done])),
                "mean R": float(np.mean([d["mean_renderability"] for d in done])),
            }
        )
    return rows


def aim_rows(records: Records) -> list[dict[str, Any]]:
    """How far every method is, at every snapshot, from what the reference has at the last one.

    Returns:
        A line per method and snapshot: the difference of the mean PSNR [dB] and its interval of
        95 %, over scenes, test views and seeds.
    """
    snapshots = snapshots_of(records)
    records = with_short_names(records)
    by_snapshot = {
        snapshot: scores_by_method([r for r in records if r["snapshot"] == snapshot], "psnr")
        for snapshot in snapshots
    }
    goal = by_snapshot[snapshots[-1]][REFERENCE]
    rows: list[dict[str, Any]] = []
    for method in methods_of(records):
        for snapshot in snapshots:
            if (method, snapshot) == (REFERENCE, snapshots[-1]):
                continue
            estimate = paired_difference(by_snapshot[snapshot][method], goal)
            rows.append(
                {
                    "method": method,
                    "after": snapshot,
                    "difference": estimate.value,
                    "from": estimate.low,
                    "to": estimate.high,
                }
            )
    return rows


def _text(value: Any) -> str:
    return f"{value:+.2f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
