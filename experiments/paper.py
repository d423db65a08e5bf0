"""The paper's tables and curves (arXiv 2601.07484): budgets of 300 views and of 300 seconds.

    python -m experiments.paper views --size smoke
    python -m experiments.paper seconds --size paper --scenes flat

Methods x SSIM, PSNR, LPIPS by scenes, the tails of the test views and the differences to `r3-pano`;
PSNR against views and seconds, views against seconds, the spread of the test views, areas. `paper`
has the size of the paper's experiments: 512 px, every view of the lattice, five snapshots (three
but in the flat), and a row for `r3-ahead` that captures while moving. What is done in `--work` is
not done again, so it runs in parts: a machine that is stopped goes on where it was.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from experiments.flights import keep_flights
from experiments.pages.artifacts import Origin, write_figure, write_markdown
from experiments.pages.comparison_tables import area_table, difference_table, tail_table
from experiments.pages.distribution_figures import ridge_figure
from experiments.suite import Options as SuiteOptions
from experiments.suite import Records, origin, request_of, run_requests
from r3jax.apps.benchmark.figures import curve_figure
from r3jax.apps.benchmark.plan import Request
from r3jax.apps.benchmark.record import write_records
from r3jax.apps.benchmark.table_formats import to_csv, to_latex, to_markdown
from r3jax.apps.benchmark.tables import (
    Table,
    groups_on_equal_terms,
    quality_table,
    without_empty_columns,
)
from r3jax.evaluation.comparison import methods_of, snapshots_of
from r3jax.files import write_atomic

Unit = Literal["views", "seconds"]

NAMES: dict[Unit, str] = {"views": "replica_dense_views", "seconds": "replica_dense_time"}
"""Folders of the results."""

REFERENCE = "r3-pano"
"""The method that the others are compared with on the same views."""

CURVES = {
    "psnr_over_views": ("views", "psnr"),
    "psnr_over_seconds": ("seconds", "psnr"),
    "views_over_seconds": ("seconds", "views"),
}
"""Quantities on the two axes, by the picture's name."""

_FEWER = (60, 180, 300)
"""Snapshots of the scenes other than the flat, at the paper's size."""

_MOVING = {"capture_every": 0.3, "plan_while_moving": True}


@dataclass(frozen=True)
class Options(SuiteOptions):
    """What is compared, and at which kind of budget."""

    unit: Annotated[Unit, tyro.conf.Positional] = "views"
    """What the budget counts."""


def main(options: Options) -> Path:
    """Runs the cells of one kind of budget; returns the folder of tables, records and poses."""
    name = NAMES[options.unit]
    root, cells, records = run_requests(options, options.unit, requests_of(options))
    folder = options.out / name / options.size
    folder.mkdir(parents=True, exist_ok=True)
    write_records(folder / f"{name}_records.jsonl", records)
    by_policy = {cell.policy: [c for c in cells if c.policy == cell.policy] for cell in cells}
    keep_flights(folder, name, root, by_policy, options.kept)
    source = origin("experiments.paper", records)
    write_tables(folder, name, records, source)
    write_curves(folder, records, source)
    print(f"results  {folder}")
    return folder


def requests_of(options: Options) -> list[Request]:
    """Makes the requests to the benchmark: the suite's, or at the paper's size one for each scene.

    There a second one of each scene is for `r3-ahead`, capturing while it moves.
    """
    if options.size != "paper":
        return [request_of(options, options.unit)]
    requests: list[Request] = []
    for scene in request_of(options, options.unit).scenes:
        amounts = options.snapshots or (() if scene == "flat" else _FEWER)
        own = request_of(replace(options, scenes=(scene,), snapshots=amounts), options.unit)
        moving = replace(own.conditions, loop=_MOVING)
        requests += [own, replace(own, policies=("r3-ahead",), conditions=moving)]
    return requests


def write_tables(folder: Path, name: str, records: Records, source: Origin) -> None:
    """Writes the tables of the last snapshot: Markdown, LaTeX and CSV each.

    Args:
        folder: where to.
        name: of the page.
        records: of all snapshots.
        source: command, machine, commit.
    """
    last = snapshots_of(records)[-1]
    tables = tables_of([record for record in records if record["snapshot"] == last])
    for kind, table in tables.items():
        write_atomic(folder / f"{kind}.tex", to_latex(table).encode())
        comment = "".join(f"# {line}\n" for line in source.lines())
        write_atomic(folder / f"{kind}.csv", (comment + to_csv(table)).encode())
    pages = [to_markdown(table) for table in tables.values()]
    write_markdown(folder / f"{name}.md", pages, source)


def tables_of(records: Records) -> dict[str, Table]:
    """Returns the quality, tails, and differences where the reference was run.

    What captured while moving has tables of its own: its frames are not those of its views alone.
    """
    tables: dict[str, Table] = {}
    for number, group in enumerate(groups_on_equal_terms(records)):
        mark = f"-{number}" if number else ""
        tables[f"quality{mark}"] = quality_table(group)
        tables[f"tails{mark}"] = without_empty_columns(tail_table(group))
        if REFERENCE in methods_of(group):
            tables[f"differences{mark}"] = difference_table(group, REFERENCE)
    return tables


def write_curves(folder: Path, records: Records, source: Origin) -> None:
    """Writes the pictures, the table of areas, and the page that shows them."""
    key_frames = [record for record in records if not record["sensing"].get("capture_every")]
    for name, (x, y) in CURVES.items():
        write_figure(folder / f"{name}.png", curve_figure(key_frames, x, y), source)
    write_figure(folder / "psnr_by_view.png", ridge_figure(key_frames), source)
    areas = area_table(key_frames)
    comment = "".join(f"# {line}\n" for line in source.lines())
    write_atomic(folder / "areas.csv", (comment + to_csv(areas)).encode())
    pictures = [f"![{name}]({name}.png)" for name in (*CURVES, "psnr_by_view")]
    write_markdown(folder / "curves.md", [*pictures, to_markdown(areas)], source)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
