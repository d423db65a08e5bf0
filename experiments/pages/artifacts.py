"""Results on disk: CSV, PNG and Markdown, each with the command, the machine and the commit."""

import csv
import io
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from r3jax.files import write_atomic


@dataclass(frozen=True)
class Origin:
    """Where a result comes from."""

    command: str
    machine: str
    commit: str

    def lines(self) -> list[str]:
        """As text."""
        return [
            f"command: {self.command}",
            f"machine: {self.machine}",
            f"commit: {self.commit}",
        ]


def command_line(module: str) -> str:
    """Returns the command that runs now, as anyone would type it in the repository's root."""
    return shlex.join(["python", "-m", module, *sys.argv[1:]])


def origin_of(module: str, records: Sequence[dict[str, Any]]) -> Origin:
    """Returns the origin of a result that was made of missions, some of them perhaps elsewhere."""
    machines = [record["machine"] for record in records]
    return joint_origin(module, machines, [record["flight"]["commit"] for record in records])


def joint_origin(module: str, machines: Iterable[str], commits: Iterable[str | None]) -> Origin:
    """Returns the origin of a result whose parts came from these machines and commits."""
    sources = {commit or "unknown" for commit in commits}
    return Origin(
        command_line(module), " and ".join(sorted(set(machines))), " and ".join(sorted(sources))
    )


def write_csv(path: Path, rows: Sequence[dict[str, Any]], origin: Origin) -> None:
    """A table; its first lines, marked by #, say where it comes from."""
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in origin.lines())
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomic(path, text.getvalue().encode())


def write_figure(path: Path, figure: Figure, origin: Origin) -> None:
    """A picture; its text fields say where it comes from."""
    data = io.BytesIO()
    fields = {"Software": "r3jax", "Description": "\n".join(origin.lines())}
    figure.savefig(data, format="png", metadata=fields)
    write_atomic(path, data.getvalue())


def write_markdown(path: Path, paragraphs: Sequence[str], origin: Origin) -> None:
    """A page that ends with where it comes from."""
    source = "\n".join(f"    {line}" for line in origin.lines())
    write_atomic(path, "\n\n".join([*paragraphs, source, ""]).encode())


def markdown_table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns rows with the same keys, as a table: text to the left, numbers to the right."""
    names = list(rows[0])
    is_text = [isinstance(rows[0][name], str) for name in names]
    lines = [names, ["---" if text else "---:" for text in is_text]]
    lines += [[_cell(row[name]) for name in names] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100.0 else f"{value:.0f}"
    return "–" if value is None else str(value)
