"""What the panel and the legend say: candidates, promises, colors in use, and nothing as markup."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

from r3jax.apps.viewer.drawing import CAUSE, ORDER, SCORES, UNSEEN, UTILITY_MAP, css_color, paint
from r3jax.apps.viewer.facts import (
    HINTS,
    LAYERS,
    Caption,
    best_candidates,
    busy_html,
    chosen_rank,
    head_html,
    image_url,
    legend_html,
    menu_of,
    note_html,
    pending_html,
    pictures_html,
    promise_of,
    stale_html,
    view_html,
)
from r3jax.exploration.taken_views import Choice, Coverage, StepRow
from r3jax.plots.style import CAUSE_COLORS
from r3jax.runs.replay import Reason
from r3jax.scoring.explain import CAUSES

TOP = {
    "utility": [6560.2, 6100.9, None, 2041.2, 12.0, 11.0],
    "path": [5.764, 5.179, None, 0.04, 1.0, 1.0],
    "total": [0.00977, 0.00966, 0.00877, 0.00864, 0.001, 0.0],
}
PHOTO = np.zeros((8, 8, 3), np.uint8)


def make_choice(score: float = 0.00977, top=TOP) -> Choice:
    return Choice(np.eye(4), score, np.zeros((2, 3)), 1.0, 100, 98, top)


def make_row(choice: Choice | None) -> StepRow:
    coverage = Coverage(10, 10, 0, 10, 0.626, 10, 0.688, 0.536)
    charged = {"planning": 2.1, "mapping": 0.1, "flight": 5.4}
    return StepRow(29, np.eye(4), "", choice, 88.4, 37.4, 47.6, charged, coverage)


def make_reason(totals=(48.0, 24.0, 8.0, 0.0)) -> Reason:
    shares = [[0.6, 0.0, 0.1, 0.2], [0.1, 0.0, 0.0, 0.2], [0.0, 0.0, 0.4, 0.2]]
    return Reason(
        np.array(totals), np.array([3, 5, 6, 9]), np.array(shares, np.float32),
        np.zeros((3, 3), np.float32),
    )  # fmt: skip


def words(html: str) -> str:
    """What is read of a part of the page."""
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


@pytest.mark.parametrize(
    ("choice", "chosen", "expected"),
    [
        (make_choice(), 0, ["utility 6,560 · 5.8 m away · chosen", "utility 6,101 · 5.2 m away",
                            "score 0.00877 · out of reach", "utility 2,041 · 0.0 m away",
                            "utility 12 · 1.0 m away"]),
        (make_choice(0.00966), 1, None),
        (make_choice(0.5), None, None),
        (make_choice(3.0, {"total": [3.0, 250.0], "path": [0.5, 1.5]}), 0,
         ["score 3 · 0.5 m away · chosen", "score 250 · 1.5 m away"]),
        (make_choice(1.0, {}), None, []),
    ],
)  # fmt: skip
def test_the_best_candidates_are_listed_and_the_chosen_one_is_marked(choice, chosen, expected):
    lines = best_candidates(choice)
    assert chosen_rank(choice) == chosen
    assert [line["is_chosen"] for line in lines] == [rank == chosen for rank in range(len(lines))]
    assert [line["rank"] for line in lines] == ["1st", "2nd", "3rd", "4th", "5th"][: len(lines)]
    assert expected is None or [line["text"] for line in lines] == expected


def test_a_view_tells_its_numbers_its_choice_and_its_promise():
    text = words(view_html(make_row(make_choice()), 48, PHOTO, make_reason()))
    for part in (
        "view 30 of 48", "mission clock 88.4 s", "this view cost 7.6 s", "explored 63 %",
        "from 100 candidates, 98 within reach", "2nd utility 6,101", "utility 80",
    ):  # fmt: skip
        assert part in text
    start = words(view_html(make_row(None), 48, PHOTO, "not known yet"))
    assert "not known yet" in start
    assert "candidates" not in start


@pytest.mark.parametrize("totals", [(48.0, 24.0, 8.0, 0.0), (0.0, 0.0, 0.0, 0.0)])
def test_a_promise_is_divided_among_the_causes(totals):
    found = promise_of(make_reason(totals))
    total = max(sum(totals), 1.0)
    assert found["utility"] == f"{sum(totals):.0f}"
    assert [cause["name"] for cause in found["causes"]] == list(CAUSES)
    assert [cause["color"] for cause in found["causes"]] == list(CAUSE_COLORS)
    assert [float(c["percent"]) for c in found["causes"]] == [100 * t / total for t in totals]
    counts = [cause["count"] for cause in found["causes"]]
    assert counts == ["3 cells", "3 voxels", "2 voxels", "2 voxels"]


def test_names_from_outside_are_never_markup():
    bad = "<b>&\"'x"
    caption = Caption(LAYERS[1], bad, bad)
    parts = (
        head_html(bad), note_html(bad), stale_html("", bad), busy_html(bad, ""),
        pictures_html([(bad, PHOTO)], PHOTO), legend_html(caption),
        view_html(make_row(None), 3, PHOTO, bad),
    )  # fmt: skip
    for part in parts:
        assert "&lt;b&gt;&amp;" in part
        assert "<b>&" not in part


def test_what_is_stale_is_not_done():
    done = pending_html().replace("computing", "done")
    stale = stale_html(done, "opening view 3")
    assert 'data-state="computing"' in stale
    assert 'data-state="done"' not in stale
    assert words(stale).startswith("opening view 3")


@pytest.mark.parametrize(("width", "kind"), [(64, "png"), (192, "jpeg")])
def test_pictures_travel_in_their_addresses(width, kind):
    image = np.full((16, width, 3), (10, 200, 90), np.uint8)
    head, _, data = image_url(image).partition(",")
    assert head == f"data:image/{kind};base64"
    back = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
    assert back.shape == image.shape
    assert np.abs(back.astype(int) - image).max() < 6


def legend(layer, **more) -> str:
    return legend_html(Caption(layer, "after view 3 of 9", "12 voxels of 5 cm"), **more)


def bars(text: str) -> list[tuple[str, str]]:
    """The first and the last color of each bar."""
    stops = [bar.split(",") for bar in re.findall(r"linear-gradient\(90deg,([^)]*)\)", text)]
    return [(colors[0], colors[-1]) for colors in stops]


def ends(name: str) -> tuple[str, str]:
    low, high = (css_color(color) for color in paint(np.array([0.0, 1.0]), name))
    return low, high


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: layer.name)
def test_a_legend_explains_the_colors_in_use_and_no_others(layer):
    text = legend(layer)
    assert bars(text) == ([ends(SCORES)] if layer.has_score else []) + [ends(ORDER)]
    assert (css_color(UNSEEN) in text) == (layer.has_score or layer.quantity == CAUSE)
    for color, cause in zip(CAUSE_COLORS, CAUSES, strict=True):
        assert (color in text and cause in words(text)) == (layer.quantity == CAUSE)
        assert HINTS[cause]
    assert "after view 3 of 9 · 12 voxels of 5 cm" in words(text)
    assert bars(legend(layer, with_candidates=True))[-1] == ends(UTILITY_MAP)


def test_what_is_being_computed_stands_above_what_is_drawn_until_then():
    text = words(busy_html("View 7: replaying", legend(LAYERS[1])))
    assert text.index("View 7: replaying") < text.index("after view 3 of 9")


def test_a_menu_begins_with_splats_or_with_colors():
    names = lambda *surfaces, **more: [
        layer.name for layer in menu_of(surfaces, **{"with_causes": True, **more})
    ]
    assert names("voxels", "points", "splats", "mesh") == [layer.name for layer in LAYERS]
    assert names("voxels", "splats")[0] == "splats"
    assert names("voxels", "points")[0] == "colors"
    live = menu_of(("voxels",), with_causes=False)
    assert {layer.surface for layer in live} == {"voxels"}
    assert CAUSE not in {layer.quantity for layer in live}
