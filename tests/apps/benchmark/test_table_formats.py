"""Tables as text: what is written can be read back, with the marks in the right fields."""

import csv
import io
import re

import pytest

from experiments.pages.comparison_tables import difference_table, tail_table
from r3jax.apps.benchmark.table_formats import to_csv, to_latex, to_markdown
from r3jax.apps.benchmark.tables import quality_table
from tests.evaluation.records import benchmark


@pytest.fixture(scope="module")
def tables():
    cells = benchmark(("random", "active-gs", "r3", "r3-pano"))
    cells = [c for c in cells if (c["policy"], c["scene"]) != ("r3", "house")]
    return [
        quality_table(cells),
        tail_table(cells, resamples=50),
        difference_table(cells, "r3-pano", resamples=50),
    ]


def read_markdown(text):
    """Fields of the lines of a pipe table, without heads and rule."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[f.strip() for f in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def read_latex(text):
    lines = [line.strip() for line in text.splitlines() if line.endswith(r"\\")]
    return [[field.strip() for field in re.split(r"(?<!\\)&", line[:-2])] for line in lines]


def expected(table, marks, missing):
    names, last = [], None
    for row in table.rows:
        names.append([row.labels[0] if row.labels[0] != last else "", *row.labels[1:]])
        last = row.labels[0]
    return [
        [
            *labels,
            *(marks[e.rank] % e.text if e.value is not None else missing for e in row.entries),
        ]
        for labels, row in zip(names, table.rows, strict=True)
    ]


def test_markdown_reads_back(tables):
    for table in tables:
        text = to_markdown(table)
        heads, rule, *lines = read_markdown(text)
        assert heads == [*table.heads, *table.columns]
        assert rule == ["---"] * len(table.heads) + ["---:"] * len(table.columns)
        assert lines == expected(table, ("%s", "**%s**", "_%s_"), "–")
        assert f"**{table.title}**" in text
        assert all(note in text for note in table.notes)
    assert "second best" in to_markdown(tables[0])
    assert "second best" not in to_markdown(tables[2])  # nothing is marked there


def test_latex_reads_back(tables):
    plain = lambda field: (
        field.replace(r"\_", "_").replace(r"\%", "%").replace("$<$", "<").replace("$-$", "-")
    )
    for table in tables:
        text = to_latex(table)
        heads, *lines = read_latex(text)
        assert [plain(head) for head in heads] == [*table.heads, *table.columns]
        found = [[plain(field) for field in line] for line in lines]
        assert found == expected(table, ("%s", r"\textbf{%s}", r"\underline{%s}"), "--")
        for name in ("table", "tabular"):
            assert text.count(rf"\begin{{{name}}}") == text.count(rf"\end{{{name}}}") == 1
        for rule in (r"\toprule", r"\bottomrule"):
            assert text.count(rule) == 1
        assert text.count("{") == text.count("}")
    assert to_latex(tables[0]).count(r"\midrule") == 4  # below the heads and between 4 methods
    assert to_latex(tables[1]).count(r"\midrule") == 1


def test_csv_keeps_every_digit(tables):
    for table in tables:
        lines = list(csv.DictReader(io.StringIO(to_csv(table))))
        assert len(lines) == len(table.rows)
        for line, row in zip(lines, table.rows, strict=True):
            assert tuple(line[head] for head in table.heads) == row.labels
            assert line["seeds"] == row.seeds
            for column, entry in zip(table.columns, row.entries, strict=True):
                if entry.value is None:
                    assert line[column] == ""
                    continue
                assert float(line[column]) == entry.value
                for name, value in entry.extra.items():
                    assert line[f"{column} {name}"] == str(value)
