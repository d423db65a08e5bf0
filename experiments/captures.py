"""Compares capturing while moving, rivals, and the spacing of frames at equal time or views.

    python -m experiments.captures modes --size small --scenes flat office --seeds 0
    python -m experiments.captures spacing --size small --seeds 0 1 2 --snapshots 30 60
    python -m experiments.captures rivals --size small --budget views --snapshots 30

A table is a list of rows, each a policy under settings that differ from the suite's, and each is
compared on the same test views with the row that it changes. The mission clock is the model's: a
decision 0.3 s, one reconsidered on arrival 0.05 s, a frame 0.02 s, a gaze 0.01 s, 1 m/s, turns for
nothing; or, with `--clock wall`, what all of this takes on this machine, which then has nothing
else to do. Policies that do not capture or plan while moving fly as published. With `--budget
views` the views that a policy chose are counted; frames captured while moving come on top. What is
done in `--work` is not done again.

Beside a table lie its records, and the poses of flights that no machine flies twice alike. So
another machine, or another day, adds a seed:

    python -m experiments.captures rivals --size small --seeds 0 1 2 --kept rivals_records.jsonl
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.flights import keep_flights
from experiments.pages.artifacts import (
    Origin,
    markdown_table,
    write_csv,
    write_figure,
    write_markdown,
)
from experiments.pages.comparison_tables import ause_of_renderability
from experiments.suite import Options as SuiteOptions
from experiments.suite import Records, origin, request_of, run_cells, take_over
from r3jax.apps.benchmark.cells import Cell, paths_of
from r3jax.apps.benchmark.figures import curve_figure
from r3jax.apps.benchmark.plan import make_plan
from r3jax.apps.benchmark.record import read_records, write_records
from r3jax.apps.benchmark.tables import metric_named
from r3jax.evaluation.comparison import (
    check_equal_terms,
    paired_difference,
    scores_by_method,
    snapshots_of,
    with_short_names,
)
from r3jax.exploration.config import ClockName
from r3jax.runs.reader import read_run

NAME = "captures"

TableName = Literal["modes", "rivals", "spacing"]


@dataclass(frozen=True)
class Row:
    """One line of a table: who flies, how, and what it is compared with."""

    policy: str
    """The policies."""

    against: str = ""
    """The row whose scores are subtracted; empty: none."""

    loop: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Settings of the mission that differ from the suite's (`Conditions.loop`)."""


REFERENCE = "active-gs"
"""As published: key frames only."""

OURS = "r3-ahead, captures, plans on the way"
"""With everything that captures while moving."""

POLICIES = (REFERENCE, "r3con", "r3-pano", "r3-ahead", "frontier", "random")

CAPTURES: dict[str, Any] = {"capture_every": 0.3}
ON_THE_WAY: dict[str, Any] = {"capture_every": 0.3, "plan_while_moving": True}
CLOSE: dict[str, Any] = ON_THE_WAY | {"capture_every": 0.15}

MODES: dict[str, dict[str, Any]] = {
    "": {},
    ", captures": CAPTURES,
    ", captures, plans on the way": ON_THE_WAY,
}
"""What a policy does on the way, and the settings of the loop for it."""

LONG: dict[str, Any] = {"iterations": 6000}
"""A training that does not punish a policy for its many frames, as the suite's does."""


TABLES: dict[TableName, dict[str, Row]] = {
    # Every policy blind between its views, with captures, and planning while it moves.
    "modes": {
        policy + mode: Row(policy, REFERENCE, loop=loop)
        for policy in POLICIES
        for mode, loop in MODES.items()
    },
    # Others, most with a map of their own: at what it costs here with `--clock wall`, else as if
    # it took no longer than ours.
    "rivals": {
        OURS: Row("r3-ahead", loop=ON_THE_WAY),
        **{
            policy + mode: Row(policy, OURS, loop=loop)
            for policy in (
                REFERENCE,
                "r3-pano",
                "gavis",
                "active-gs-online",
                "fisherrf",
                "gauss-mi",
            )
            for mode, loop in MODES.items()
        },
    },
    # How often it looks, for ours and for the rival; more frames need longer trainings.
    "spacing": {
        REFERENCE: Row(REFERENCE),
        **{
            f"{policy}, a frame every {meters} m": Row(policy, REFERENCE, loop=loop)
            for policy in (REFERENCE, "r3-ahead")
            for meters, loop in ((0.3, ON_THE_WAY), (0.15, CLOSE))
        },
    },
}


@dataclass(frozen=True)
class Options(SuiteOptions):
    """What is compared."""

    table: Annotated[TableName, tyro.conf.Positional] = "modes"
    """Which table."""

    rows: tuple[str, ...] = ()
    """Rows of it other than all; `--policies` leaves those of others out, too."""

    budget: Literal["seconds", "views"] = "seconds"
    """What `--snapshots` count: seconds of the mission, or views that the policy chose."""

    clock: ClockName = "model"
    """`model`: the same run on every machine, whatever else it does. `wall`: measured."""

    @property
    def folder(self) -> Path:
        """Folder of the table."""
        return self.out / NAME / self.size

    @property
    def name(self) -> str:
        """What the table's files are called."""
        return self.table if self.budget == "seconds" else f"{self.table}_by_views"

    @property
    def records(self) -> str:
        """File of the table's records."""
        return f"{self.name}_records.jsonl"

    @property
    def is_repeatable(self) -> bool:
        """Whether another machine flies the same: not by a clock, nor by a map that it trains."""
        return self.clock == "model" and self.table != "rivals"


def main(options: Options) -> Path:
    """Runs what is left of the cells, writes the page, and returns the folder of the results."""
    rows = rows_of(options)
    root, folder = options.work / f"{options.size}-{options.budget}", options.folder
    for path in (root, folder):
        path.mkdir(parents=True, exist_ok=True)
    cells = {label: cells_of(options, row, root) for label, row in rows.items()}
    every = [cell for own in cells.values() for cell in own]
    take_over(options.kept, root, every)
    run_cells(every, root, engine=options.engine, jobs=options.jobs)
    found = {label: records_of(root, own) for label, own in cells.items()}
    write_records(folder / options.records, [record for own in found.values() for record in own])
    records = [as_line(record, label, rows) for label, own in found.items() for record in own]
    costs = cost_rows(root, cells) if options.clock == "wall" else []
    if not options.is_repeatable:
        keep_flights(folder, options.name, root, cells, options.kept)
    write_page(folder, options.name, rows, records, origin(f"experiments.{NAME}", records), costs)
    print(f"results  {folder}")
    return folder


def rows_of(options: Options) -> dict[str, Row]:
    """Selects the rows of the table by their names.

    Raises:
        ValueError: a row that is none of the table's, or none is left.
    """
    table = TABLES[options.table]
    unknown = sorted(set(options.rows) - set(table))
    if unknown:
        raise ValueError(f"--rows {unknown[0]!r} is none of {list(table)}")
    chosen = {
        label: row
        for label, row in table.items()
        if label in (options.rows or table) and row.policy in (options.policies or [row.policy])
    }
    if not chosen:
        raise ValueError(f"the table {options.table!r} has no row of {options.policies}")
    return chosen


def cells_of(options: Options, row: Row, root: Path) -> list[Cell]:
    """Returns a row's cells: every scene and seed."""
    request = request_of(replace(options, policies=(row.policy,)), options.budget)
    conditions = replace(request.conditions, clock=options.clock, loop=dict(row.loop), **LONG)
    return list(make_plan(replace(request, conditions=conditions), root))


def records_of(root: Path, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """The records of a row's cells at the times that the table asks for, not those of another's."""
    asked = cells[0].conditions.snapshots
    return [record for record in read_records(root, cells) if record["snapshot"] in asked]


def as_line(record: Mapping[str, Any], label: str, rows: Mapping[str, Row]) -> dict[str, Any]:
    """Returns a record under its row's name; what rows differ in on purpose is no unequal term."""
    compared = {name for row in rows.values() for name in row.loop}
    sensing = {name: value for name, value in record["sensing"].items() if name not in compared}
    return {**record, "sensing": sensing, "policy": label, "settings": {}}


def cost_rows(root: Path, cells: Mapping[str, Sequence[Cell]]) -> list[dict[str, str]]:
    """A line per row: what its flights were charged for, medians of all scenes and seeds [s]."""
    lines: list[dict[str, str]] = []
    for label, own in cells.items():
        runs = [run for cell in own if (run := paths_of(root, cell).run).exists()]
        steps = [step for run in runs for step in read_run(run).rows]
        costs = {
            "a decision": [s.charged["planning"] + s.hidden for s in steps if s.choice is not None],
            "a frame into the map": [step.charged["mapping"] for step in steps],
            "a look on the way": [s.charged["gaze"] for s in steps if "gaze" in s.charged],
        }
        medians = {name: f"{np.median(took):.3f}" if took else "" for name, took in costs.items()}
        lines.append({"row": label} | medians)
    return lines


def write_page(
    folder: Path,
    name: str,
    rows: Mapping[str, Row],
    records: Records,
    source: Origin,
    costs: Sequence[dict[str, str]] = (),
) -> None:
    """Writes a table for every snapshot, differences from the rows' references, and costs."""
    records = with_short_names(records)
    page: list[str] = []
    for snapshot in snapshots_of(records):
        now = [record for record in records if record["snapshot"] == snapshot]
        check_equal_terms(now)
        lines = quality_rows(rows, now)
        write_csv(folder / f"{name}_{snapshot.replace(':', '_')}.csv", lines, source)
        page += [
            f"**After {_amount(snapshot)}**: PSNR in dB, in brackets the 5th percentile "
            "of the test views, then frames, means over seeds; and PSNR minus that of another row "
            "on the same test views, with its interval of 95 %",
            markdown_table(lines),
        ]
    if costs:
        page += [
            "**What this took here**, medians in seconds; a decision with the part that was hidden",
            markdown_table(costs),
        ]
    # Two points are no curve.
    if len(rows) * len(snapshots_of(records)) > 2:
        write_figure(folder / f"{name}_by_frames.png", frames_figure(records), source)
        page.append(f"![PSNR against the number of frames]({name}_by_frames.png)")
    write_markdown(folder / f"{name}.md", page, source)


def _amount(snapshot: str) -> str:
    unit, _, number = snapshot.partition(":")
    return f"{number} {'s' if unit == 'seconds' else unit}"


def frames_figure(records: Records) -> Figure:
    """Returns PSNR against the frames taken, a panel per scene.

    What a row does looks like a setting.
    """
    named = [{**record, "policy": _as_method(record["policy"])} for record in records]
    figure = curve_figure(named, "views", "psnr")
    for axes in figure.axes:
        axes.set_xlabel("frames")  # a record's views are all that the model is trained on
    return figure


def _as_method(label: str) -> str:
    policy, comma, how = label.partition(", ")
    return f"{policy} ({how})" if comma else policy


def quality_rows(rows: Mapping[str, Row], records: Records) -> list[dict[str, str]]:
    """A line per row: every scene, the mean over them, AUSE, and the difference from another."""
    scores = scores_by_method(records, "psnr")
    lines: list[dict[str, str]] = []
    for label, row in rows.items():
        mine = scores[label]
        line = {"row": label}
        for scene, values in mine.items():
            frames = [
                record["exploration"]["views"]
                for record in records
                if (record["policy"], record["scene"]) == (label, scene)
            ]
            low = float(np.mean(np.percentile(values, 5, axis=1)))
            line[scene] = f"{values.mean():.2f} [{low:.1f}] / {np.mean(frames):.0f}"
        line["mean"] = f"{np.mean([values.mean() for values in mine.values()]):.2f}"
        by_seed = np.mean([values.mean(axis=1) for values in mine.values()], axis=0)
        if len(by_seed) > 1:
            line["mean by seed"] = " / ".join(f"{value:.2f}" for value in by_seed)
        area = ause_of_renderability(records, label, list(mine), metric_named("psnr"))
        line["AUSE of R"] = "" if area is None else f"{area:.2f}"
        line["difference"] = _difference(mine, row.against, scores, label)
        lines.append(line)
    return lines


def _difference(
    mine: dict[str, np.ndarray], against: str, scores: Mapping[str, Any], label: str
) -> str:
    if against not in scores or against == label:
        return ""
    found = paired_difference(mine, scores[against])
    return f"{found.value:+.2f} [{found.low:+.2f}, {found.high:+.2f}] to {against}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
