"""Pictures of tables: each is drawn from the table that stands on its page, and from nothing else.

    python -m docs.figures.tables

After a number on a page of `docs/results` has changed, run it again: a test compares the numbers
that a picture was drawn from with those of its page.
"""

import json
import re
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from r3jax.plots import style

PAGES, IMAGES = Path("docs/results"), Path("docs/images/results")
COLORS = (style.ACCENT, style.SECOND, style.TOO_OBLIQUE)
_NUMBER = r"[-+]?\d+(?:\.\d+)?"
_ESTIMATE = re.compile(rf"({_NUMBER})(?: \[({_NUMBER}), ({_NUMBER})\])?(?: %)?")
_TIME = re.compile(r"(\d+(?:\.\d+)?) (min|s|ms)\b")
_SECONDS = {"min": 60.0, "s": 1.0, "ms": 1e-3}


class Estimate(NamedTuple):
    """A number of a table, with its interval, which is the number itself where there is none."""

    value: float
    low: float
    high: float


class Marks(NamedTuple):
    """The numbers of one cell, and where they stand in the picture."""

    label: str
    series: str
    text: str
    estimates: tuple[Estimate, ...]


@dataclass(frozen=True)
class Picture:
    """What of the first table of a page is drawn."""

    page: str
    columns: tuple[str, ...]
    """Beginnings of the headings of the columns that are drawn."""
    axis: str
    reference: float | str | None = None
    """Where the dashed line is; a label stands for the value in its row."""
    transposed: bool = False
    """One line for each column, one color for each row."""
    form: str = "dots"
    """`dots`, `bars` from zero, or `log` for dots on a logarithmic axis."""


PICTURES = (
    Picture("captures", ("wall time",), "wall time of the audit [s]", form="bars"),
    Picture("expected-error", ("with PSNR", "with SSIM", "with LPIPS"),
            "Spearman correlation within a model", 0.0),
    Picture("extensions", ("minus",), "PSNR minus that of r3-pano [dB]", 0.0),
    Picture("ours-demand", ("house", "flat", "office"), "PSNR [dB]", transposed=True),
    Picture("performance", ("time",), "time, on a logarithmic axis", form="log"),
    Picture("refine", ("with",), "PSNR with --refine 4, minus without [dB]", 0.0),
    Picture("renderability", ("flat", "office", "house"),
            "Spearman correlation with PSNR within a model", 0.0),
    Picture("team", ("80 %", "90 %", "95 %"),
            "time of two cameras over that of one (dashed)", 1.0, form="bars"),
    Picture("utilities", ("PSNR",), "PSNR [dB] (dashed: r3)", "r3"),
    Picture("without-depth", ("Spearman of R, regions", "Spearman of R, from the same",
                              "Spearman of R, frames"),
            "Spearman correlation with the audit with depth", 0.0),
)  # fmt: skip


def read_table(markdown: str) -> list[list[str]]:
    """Returns the cells of the first table of a page, its heading first, without emphasis."""
    found = re.search(r"^\|.*\n(?:\|.*(?:\n|$))+", markdown, re.MULTILINE)
    if found is None:
        raise ValueError("the page has no table")
    lines = re.sub(r"[*`]", "", found[0]).splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:1] + lines[2:]]


def read_cell(cell: str) -> tuple[Estimate, ...]:
    """Reads `0.2 [0.1, 0.3]`, `0.5`, `12 %`, times in seconds, or several of them between ` / `."""
    unit = re.search(r" (?:ms|s)$", cell)
    found: list[Estimate] = []
    for part in filter(None, cell.split(" / ")):
        whole = part + unit[0] if unit and not _TIME.search(part) else part
        times, number = _TIME.findall(whole), _ESTIMATE.fullmatch(whole)
        if number:
            value = float(number[1])
            found.append(Estimate(value, float(number[2] or value), float(number[3] or value)))
        elif times and not _TIME.sub("", whole).strip():
            value = sum(float(amount) * _SECONDS[name] for amount, name in times)
            found.append(Estimate(value, value, value))
        else:
            raise ValueError(f"'{part}' is not a number, a number with an interval, or a time")
    return tuple(found)


def marks_of(picture: Picture, markdown: str) -> list[Marks]:
    """Returns what a picture shows of the table of its page; empty cells are left out."""
    heading, *rows = read_table(markdown)
    found: list[Marks] = []
    for name in picture.columns:
        (column,) = (at for at, title in enumerate(heading) if title.startswith(name))
        title = heading[column].split(" [")[0]
        for row in (row for row in rows if row[column]):
            label, series = (title, row[0]) if picture.transposed else (row[0], title)
            found.append(Marks(label, series, row[column].split(" [")[0], read_cell(row[column])))
    return found


def draw(picture: Picture, marks: list[Marks]) -> Figure:
    """Draws one line for each label, one color for each series, the first on top."""
    labels = list(dict.fromkeys(mark.label for mark in marks))
    names = list(dict.fromkeys(mark.series for mark in marks))
    step = {1: 0.5, 2: 0.3}.get(len(names), 0.22)
    figure = style.new_figure(8.0, 0.75 + len(labels) * (0.3 + 0.14 * len(names)))
    axes = style.dress(figure.subplots(), x=picture.axis)
    for mark in marks:
        series = names.index(mark.series)
        height = -labels.index(mark.label) - step * (series - (len(names) - 1) / 2)
        thickness = 0.9 * step if picture.form == "bars" else 0.0
        _draw_mark(axes, mark, height, COLORS[series], thickness)
    if isinstance(picture.reference, str):
        line = next(mark.estimates[0].value for mark in marks if mark.label == picture.reference)
    else:
        line = picture.reference
    if line is not None:
        axes.axvline(line, color=style.MUTED, linewidth=1, linestyle="--", zorder=1)
    if picture.form == "log":
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda s, _: f"{s:g} s" if s >= 1 else f"{1e3 * s:g} ms")
        axes.xaxis.set_minor_locator(NullLocator())
    axes.set_yticks([-at for at in range(len(labels))], [textwrap.fill(n, 46) for n in labels])
    axes.tick_params(axis="y", labelsize=9, labelcolor=style.INK, length=0)
    axes.set_ylim(0.6 - len(labels), 0.6)
    axes.margins(x=0.12)
    axes.grid(visible=False, axis="y")
    if len(names) > 1:
        handles = [Line2D([], [], color=c, marker="o", linestyle="") for c in COLORS[: len(names)]]
        figure.legend(handles, names, loc="outside upper left", ncols=3, fontsize=9, frameon=False)
    return figure


def _draw_mark(axes: Axes, mark: Marks, height: float, color: str, thickness: float) -> None:
    for value, low, high in mark.estimates:
        if thickness > 0.0:
            axes.barh([height], [value], height=thickness, color=color)
        else:
            axes.plot([low, high], [height, height], color=color, linewidth=2)
            axes.plot([value], [height], "o", color=color, markersize=7)
    right = max(estimate.high for estimate in mark.estimates)
    axes.annotate(mark.text, (right, height), (8, 0), textcoords="offset points",
                  va="center", fontsize=8, color=style.INK,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})  # fmt: skip


def main() -> None:
    """Draws all pictures; each carries the numbers that it shows."""
    for picture in PICTURES:
        marks = marks_of(picture, (PAGES / f"{picture.page}.md").read_text(encoding="utf-8"))
        about = {"Software": "r3jax", "Description": json.dumps(marks)}
        draw(picture, marks).savefig(IMAGES / f"{picture.page}.png", metadata=about)


if __name__ == "__main__":
    main()
