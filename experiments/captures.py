"""At equal time: every policy blind between its views, with captures, and planning while it moves.

    python -m experiments.captures --size small --scenes flat office --seeds 0

The mission clock is the model's: a decision 0.3 s, one reconsidered on arrival 0.05 s, a frame
0.02 s, a gaze 0.01 s, 1 m/s, turns for nothing. Whoever does not look or plan on the way flies as
published. What is done in `--work` is not done again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.pages.artifacts import Origin, markdown_table, write_csv, write_markdown
from experiments.suite import Options as SuiteOptions
from experiments.suite import Records, by_method_and_scene, origin, request_of, run_requests
from r3jax.apps.benchmark.plan import Request
from r3jax.evaluation.comparison import (
    check_equal_terms,
    scores_by_method,
    snapshots_of,
    with_short_names,
)
from r3jax.evaluation.statistics import paired_difference

NAME = "captures"

REFERENCE = "active-gs"
"""As published: key frames only. The others are compared with it on the same test views."""

MODES: dict[str, dict[str, Any]] = {
    "": {},
    "captures": {"capture_every": 0.3},
    "captures, plans on the way": {"capture_every": 0.3, "plan_while_moving": True},
}
"""What a policy does on the way, and the settings of the loop for it."""


@dataclass(frozen=True)
class Options(SuiteOptions):
    """What is compared."""

    policies: tuple[str, ...] = ("active-gs", "r3con", "ours-pano", "ours-ahead")
    """Who chooses the views."""

    modes: tuple[str, ...] = tuple(MODES)
    """What they do on the way."""


def main(options: Options) -> Path:
    """Runs what is left of the cells, writes the page, and returns the folder of the results."""
    records = run_modes(options)
    folder = options.out / NAME / options.size
    write_page(folder, records, origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def requests_of(options: Options) -> list[Request]:
    """What the benchmark is asked for, mode by mode.

    Raises:
        ValueError: a mode that is none, or without the one that all are compared with.
    """
    unknown = sorted(set(options.modes) - set(MODES))
    if unknown:
        raise ValueError(f"--modes {unknown[0]!r} is none of {list(MODES)}")
    if "" not in options.modes:
        # Else a policy that looks on the way would pass for the one as published.
        raise ValueError("--modes must contain '', key frames only: all are compared with it")
    common = request_of(options, "seconds")
    # The model clock: the same run on every machine, whatever else it does meanwhile.
    conditions = [
        replace(common.conditions, clock="model", loop=common.conditions.loop | MODES[mode])
        for mode in options.modes
    ]
    return [replace(common, conditions=each) for each in conditions]


def run_modes(options: Options) -> Records:
    """Runs what is left; the mode stands among the settings of the policy, for its name."""
    # What is compared here is no unequal term: the tables' own check would refuse it.
    compared = {name for settings in MODES.values() for name in settings}
    found: list[Mapping[str, Any]] = []
    for mode, request in zip(options.modes, requests_of(options), strict=True):
        _, _, records = run_requests(options, "seconds", [request])
        for record in records:
            settings = record["settings"] | ({"on the way": mode} if mode else {})
            sensing = {k: v for k, v in record["sensing"].items() if k not in compared}
            found.append({**record, "settings": settings, "sensing": sensing})
    return with_short_names(found)


def write_page(folder: Path, records: Records, source: Origin) -> None:
    """Writes a table for every snapshot, and the differences from the reference."""
    folder.mkdir(parents=True, exist_ok=True)
    page: list[str] = []
    for snapshot in snapshots_of(records):
        now = [record for record in records if record["snapshot"] == snapshot]
        check_equal_terms(now)
        rows = quality_rows(now)
        write_csv(folder / f"{snapshot.replace(':', '_')}.csv", rows, source)
        page += [
            f"**After {snapshot.partition(':')[2]} s**: PSNR in dB, in brackets the 5th percentile "
            "of the test views, then frames, means over seeds; and PSNR minus that of "
            f"{REFERENCE} with key frames only on the same test views, with its interval of 95 %",
            markdown_table(rows),
        ]
    write_markdown(folder / f"{NAME}.md", page, source)


def quality_rows(records: Records) -> list[dict[str, str]]:
    """A line per method: every scene, the mean over them, and the difference from the reference."""
    scores = scores_by_method(records, "psnr")
    rows: dict[str, dict[str, str]] = {}
    frames = [record["exploration"]["views"] for record in records]
    for method, scene, mine in by_method_and_scene(records, frames):
        values = scores[method][scene]
        low = float(np.mean(np.percentile(values, 5, axis=1)))
        row = rows.setdefault(method, {"method": method})
        row[scene] = f"{values.mean():.2f} [{low:.1f}] / {np.mean(mine):.0f}"
    for method, row in rows.items():
        mine = scores[method]
        row["mean"] = f"{np.mean([values.mean() for values in mine.values()]):.2f}"
        row[f"minus {REFERENCE}"] = _difference(mine, scores.get(REFERENCE))
    return list(rows.values())


def _difference(mine: dict[str, np.ndarray], reference: dict[str, np.ndarray] | None) -> str:
    if reference is None or mine is reference:
        return ""
    found = paired_difference(mine, reference)
    return f"{found.value:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
