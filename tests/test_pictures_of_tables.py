"""Pictures of results show the tables of their pages: every number, and none of yesterday."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from docs.figures.tables import PICTURES, Estimate, Marks, marks_of, read_cell, read_table

DOCS = Path(__file__).resolve().parents[1] / "docs"
NUMBERS = st.integers(-9999, 9999).map(lambda n: n / 100)


@given(NUMBERS, st.tuples(NUMBERS, NUMBERS).map(sorted))
def test_a_value_with_its_interval_is_read_as_written(value, interval):
    cell = f"{value:+.2f} [{interval[0]:+.2f}, {interval[1]:.2f}]"
    assert read_cell(cell) == (Estimate(value, *interval),)
    assert read_cell(f"{value:.2f}") == (Estimate(value, value, value),)


def test_times_are_read_in_seconds_and_share_the_last_unit():
    assert [e.value for e in read_cell("1.0 / 1.9 ms")] == pytest.approx([0.001, 0.0019])
    assert [e.value for e in read_cell("28 s / 8 s")] == [28.0, 8.0]
    assert [e.value for e in read_cell("1 min 31 s")] == [91.0]
    assert [e.value for e in read_cell("0.5 %")] == [0.5]


@pytest.mark.parametrize(
    "cell", ["297 of 601", "exactly these 12", "0.1 [0.2]", "3 s or more", "-"]
)
def test_a_cell_that_is_no_number_is_refused(cell):
    with pytest.raises(ValueError, match=r"is not a number"):
        read_cell(cell)


def test_the_first_table_of_a_page_is_read_without_emphasis():
    page = (
        "# A\n\nText | more\n\n| | `b` [dB] |\n|---|---|\n| **r3** | **1.5** |\n| x | |\n\n| c |\n"
    )
    assert read_table(page) == [["", "b [dB]"], ["r3", "1.5"], ["x", ""]]


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.page)
def test_a_picture_was_drawn_from_the_numbers_of_its_page(picture):
    page = (DOCS / "results" / f"{picture.page}.md").read_text(encoding="utf-8")
    assert f"](../images/results/{picture.page}.png)" in page
    with Image.open(DOCS / "images" / "results" / f"{picture.page}.png") as image:
        drawn = [Marks(*mark) for mark in json.loads(image.info["Description"])]
    expected = [Marks(*mark) for mark in json.loads(json.dumps(marks_of(picture, page)))]
    assert drawn == expected, "run python -m docs.figures.tables"
