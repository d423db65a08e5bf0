"""What the panel says: candidates in words, a tooltip for every quantity, stale numbers marked."""

import base64
import dataclasses
import html
import io
import re

import numpy as np
import pytest
from PIL import Image

from r3jax.apps.viewer.page.facts import (
    candidates_html,
    chosen_rank,
    image_url,
    pending_html,
    stale_html,
    view_html,
)
from r3jax.apps.viewer.page.words import HINTS
from r3jax.trace.rows import Choice, Coverage, StepRow

TOP = {
    "utility": [6560.2, 6100.9, None, 2041.2, 12.0, 11.0],
    "path": [5.764, 5.179, None, 0.04, 1.0, 1.0],
    "total": [0.00977, 0.00966, 0.00877, 0.00864, 0.001, 0.0],
}


def make_row(score: float = 0.00977, top=TOP, **changes) -> StepRow:
    choice = Choice(np.eye(4), score, np.zeros((2, 3)), 1.0, 100, 98, top)
    coverage = Coverage(10, 10, 0, 10, 0.626, 10, 0.688, 0.536)
    charged = {"planning": 2.1, "mapping": 0.1, "flight": 5.4}
    row = StepRow(29, np.eye(4), "", choice, 88.4, 37.4, 47.6, charged, coverage)
    return dataclasses.replace(row, **changes)


def lines_of(row: StepRow) -> list[str]:
    """The rows of the candidates as they are read."""
    rows = re.findall(r"<span[^>]*>(\d\w\w)</span><span>([^<]*)</span>", candidates_html(row))
    return [" ".join(line) for line in rows]


def test_candidates_are_told_in_words_and_the_chosen_one_is_marked():
    assert lines_of(make_row()) == [
        "1st utility 6,560 · 5.8 m away · chosen",
        "2nd utility 6,101 · 5.2 m away",
        "3rd score 0.00877 · out of reach",
        "4th utility 2,041 · 0.0 m away",
        "5th utility 12 · 1.0 m away",
    ]
    assert "chosen from 100 candidates, 98 within reach" in candidates_html(make_row())


def test_another_candidate_may_have_been_chosen_or_none_of_the_best():
    assert lines_of(make_row(0.00966))[1].endswith("chosen")
    assert chosen_rank(make_row(0.5).choice) is None
    assert not any("chosen" in line for line in lines_of(make_row(0.5)))


def test_policies_without_a_utility_are_told_by_their_score():
    row = make_row(3.0, {"total": [3.0, 250.0], "path": [0.5, 1.5]})
    assert lines_of(row) == ["1st score 3 · 0.5 m away · chosen", "2nd score 250 · 1.5 m away"]
    assert lines_of(make_row(1.0, {})) == []


def test_every_fact_of_a_view_has_a_tooltip():
    text = view_html(make_row(), 48, np.zeros((8, 8, 3), np.uint8), "not known")
    facts = re.findall(r'<div title="([^"]*)"[^>]*><span[^>]*>([^<]*)</span>', text)
    told = {name: html.unescape(hint) for hint, name in facts}
    for name in ("mission clock", "path", "explored", "mean renderability", "R before this view"):
        assert told[name] == HINTS[name]
    assert '<span id="r3jax-view">30</span> of 48' in text
    assert 'title="planning 2.1 s + mapping 0.1 s + flight 5.4 s">7.6 s' in text


def test_the_start_was_chosen_by_nobody():
    assert "nothing was chosen" in candidates_html(make_row(choice=None, charged={}))


def test_what_is_stale_is_faint_and_not_done():
    done = pending_html().replace("computing", "done")
    stale = stale_html(done, "opening view <3>")
    assert 'data-state="computing"' in stale
    assert 'data-state="done"' not in stale
    assert "opacity:.3" in stale
    assert "opening view &lt;3&gt;" in stale


@pytest.mark.parametrize(("width", "kind"), [(64, "png"), (192, "jpeg")])
def test_pictures_travel_in_their_addresses(width, kind):
    image = np.full((16, width, 3), (10, 200, 90), np.uint8)
    head, _, data = image_url(image).partition(",")
    assert head == f"data:image/{kind};base64"
    back = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
    assert back.shape == image.shape
    assert np.abs(back.astype(int) - image).max() < 6
