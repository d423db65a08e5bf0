"""The tables that a benchmark ends with, one for each snapshot, for a terminal."""

from collections.abc import Sequence
from typing import Any

from r3jax.apps.benchmark.results.table_parts import Entry, Table
from r3jax.apps.benchmark.results.tables import quality_table
from r3jax.cli.console import Console, Text
from r3jax.cli.console import Table as RichTable
from r3jax.evaluation.comparison import snapshots_of

_MARKS = {1: "bold", 2: "italic"}


def print_results(console: Console, records: Sequence[dict[str, Any]]) -> None:
    """Prints methods x metrics by scenes, every number a mean over seeds.

    Args:
        console: where to.
        records: of one benchmark, as `benchmark.record.read_records` gives them.
    """
    notes: dict[str, None] = {}
    for snapshot in snapshots_of(records):
        chosen = [record for record in records if record["snapshot"] == snapshot]
        table = quality_table(chosen)
        console.print(_for_terminal(table))
        notes |= dict.fromkeys(table.notes)
    for note in notes:
        console.print(note, style="dim")


def _for_terminal(table: Table) -> RichTable:
    shown = RichTable(*table.heads, title=table.title, box=None, title_justify="left")
    for column in table.columns:
        shown.add_column(column, justify="right", no_wrap=True)
    last = None
    for row in table.rows:
        method, *others = row.labels
        labels = [method if method != last else "", *others]
        last = method
        shown.add_row(*labels, *map(_entry, row.entries))
    return shown


def _entry(entry: Entry) -> Text:
    return Text("–" if entry.value is None else entry.text, style=_MARKS.get(entry.rank, ""))
