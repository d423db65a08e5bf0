"""Tables as text: Markdown and LaTeX for people, CSV with every digit for machines."""

import csv
import io
import re

from r3jax.apps.benchmark.tables import Entry, Table

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"$<$",
    ">": r"$>$", "–": "--",
}  # fmt: skip


def to_markdown(table: Table) -> str:
    """Returns a pipe table: best in bold, second best in italics, missing as a dash."""
    heads = [*table.heads, *table.columns]
    lines = [
        f"**{table.title}**",
        "",
        _pipes([_unpiped(head) for head in heads]),
        _pipes(["---"] * len(table.heads) + ["---:"] * len(table.columns)),
    ]
    for row, labels in zip(table.rows, _without_repeats(table), strict=True):
        fields = [_unpiped(label) for label in labels]
        lines.append(_pipes([*fields, *(_markdown_entry(entry) for entry in row.entries)]))
    legend = "**Best**, _second best_." if _has_marks(table) else ""
    return "\n".join([*lines, "", " ".join([*table.notes, legend]).strip(), ""])


def _pipes(fields: list[str]) -> str:
    return f"| {' | '.join(fields)} |"


def _markdown_entry(entry: Entry) -> str:
    if entry.value is None:
        return "–"
    mark = {1: "**", 2: "_"}.get(entry.rank, "")
    return f"{mark}{_unpiped(entry.text)}{mark}"


def _unpiped(text: str) -> str:
    """Returns the for a field of a pipe table."""
    return text.replace("|", r"\|")


def to_latex(table: Table) -> str:
    r"""Returns a `table` for the package booktabs: best `\textbf`, second best `\underline`."""
    columns = "l" * len(table.heads) + "r" * len(table.columns)
    lines = [
        r"\begin{table}",
        r"  \centering",
        rf"  \caption{{{_escaped(table.title)}}}",
        rf"  \begin{{tabular}}{{{columns}}}",
        r"    \toprule",
        _ampersands([_escaped(head) for head in (*table.heads, *table.columns)]),
        r"    \midrule",
    ]
    for i, (row, labels) in enumerate(zip(table.rows, _without_repeats(table), strict=True)):
        if i and len(table.heads) > 1 and labels[0]:
            lines.append(r"    \midrule")
        fields = [_escaped(label) for label in labels]
        lines.append(_ampersands([*fields, *(_latex_entry(entry) for entry in row.entries)]))
    marks = [r"\textbf{Best}, \underline{second best}."] if _has_marks(table) else []
    notes = " ".join([*(_escaped(note) for note in table.notes), *marks])
    lines += [
        r"    \bottomrule",
        r"  \end{tabular}",
        rf"  \par\smallskip\footnotesize {notes}",
        r"\end{table}",
    ]
    return "\n".join([*lines, ""])


def _ampersands(fields: list[str]) -> str:
    return rf"    {' & '.join(fields)} \\"


def _latex_entry(entry: Entry) -> str:
    if entry.value is None:
        return "--"
    # A hyphen before a digit is a minus, unless it is inside a name.
    text = re.sub(r"(?<![\w.])-(?=\d)", "$-$", _escaped(entry.text))
    command = {1: r"\textbf", 2: r"\underline"}.get(entry.rank)
    return f"{command}{{{text}}}" if command else text


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)


def to_csv(table: Table) -> str:
    """Returns one line per row with every digit; an empty field where there is no value.

    After the labels and the number of seeds, every column is followed by what belongs to it:
    `mean`, `mean low`, `mean high`.
    """
    extras = [
        list(dict.fromkeys(name for row in table.rows for name in row.entries[i].extra))
        for i in range(len(table.columns))
    ]
    header = [*table.heads, "seeds"]
    for column, names in zip(table.columns, extras, strict=True):
        header += [column, *(f"{column} {name}" for name in names)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in table.rows:
        fields: list[object] = [*row.labels, row.seeds]
        for entry, names in zip(row.entries, extras, strict=True):
            fields += [entry.value, *(entry.extra.get(name) for name in names)]
        writer.writerow(fields)
    return text.getvalue()


def _without_repeats(table: Table) -> list[tuple[str, ...]]:
    """Labels with the method named once, on its first line."""
    labels: list[tuple[str, ...]] = []
    last = None
    for row in table.rows:
        labels.append(row.labels if row.labels[0] != last else ("", *row.labels[1:]))
        last = row.labels[0]
    return labels


def _has_marks(table: Table) -> bool:
    return any(entry.rank for row in table.rows for entry in row.entries)
