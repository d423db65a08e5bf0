"""The paper's table of one kind of budget: quality, tails and differences, from records."""

from pathlib import Path
from typing import Literal

from experiments.flights import keep_flights
from experiments.pages.artifacts import Origin, write_markdown
from experiments.pages.comparison_tables import difference_table, tail_table
from experiments.suite import Options, Records, origin, request_of, run_requests
from r3jax.apps.benchmark.record import write_records
from r3jax.apps.benchmark.table_formats import to_csv, to_latex, to_markdown
from r3jax.apps.benchmark.tables import Table, quality_table
from r3jax.evaluation.comparison import methods_of, snapshots_of
from r3jax.files import write_atomic

REFERENCE = "r3-pano"
"""The method that the others are compared with on the same views."""


def make_tables(options: Options, name: str, unit: Literal["views", "seconds"]) -> Path:
    """Runs the cells of one kind of budget, and returns the folder of tables, records and poses."""
    root, cells, records = run_requests(options, unit, [request_of(options, unit)])
    folder = options.out / name / options.size
    folder.mkdir(parents=True, exist_ok=True)
    write_records(folder / f"{name}_records.jsonl", records)
    by_policy = {cell.policy: [c for c in cells if c.policy == cell.policy] for cell in cells}
    keep_flights(folder, name, root, by_policy, options.kept)
    write_tables(folder, name, records, origin(f"experiments.{name}", records))
    print(f"results  {folder}")
    return folder


def write_tables(folder: Path, name: str, records: Records, origin: Origin) -> None:
    """Writes the tables of the last snapshot: Markdown, LaTeX and CSV each.

    Args:
        folder: where to.
        name: of the page.
        records: of all snapshots.
        origin: command, machine, commit.
    """
    last = snapshots_of(records)[-1]
    tables = tables_of([record for record in records if record["snapshot"] == last])
    for kind, table in tables.items():
        write_atomic(folder / f"{kind}.tex", to_latex(table).encode())
        comment = "".join(f"# {line}\n" for line in origin.lines())
        write_atomic(folder / f"{kind}.csv", (comment + to_csv(table)).encode())
    pages = [to_markdown(table) for table in tables.values()]
    write_markdown(folder / f"{name}.md", pages, origin)


def tables_of(records: Records) -> dict[str, Table]:
    """Returns the quality, tails, and differences where the reference was run."""
    tables = {"quality": quality_table(records), "tails": tail_table(records)}
    if REFERENCE in methods_of(records):
        tables["differences"] = difference_table(records, REFERENCE)
    return tables
