"""The legend shows the colors that are in use; the menu begins with what people want to see."""

import re

import numpy as np
import pytest

from r3jax.apps.report.reasons import COLORS
from r3jax.apps.viewer.blocks import CAUSE
from r3jax.apps.viewer.color_maps import ORDER, SCORES, UNSEEN, UTILITY_MAP, css_color, paint
from r3jax.apps.viewer.page.layers import LAYERS, menu_of
from r3jax.apps.viewer.page.legend import Caption, busy_html, legend_html
from r3jax.scoring.explain import CAUSES

GRAY = css_color(UNSEEN)


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
    assert (GRAY in text) == (layer.has_score or layer.quantity == CAUSE)
    for color, cause in zip(COLORS, CAUSES, strict=True):
        assert (color in text and f">{cause}<" in text) == (layer.quantity == CAUSE)
    assert "after view 3 of 9" in text
    assert "12 voxels of 5 cm" in text
    assert "1 m" in text


def test_candidates_have_a_bar_while_they_are_drawn():
    assert bars(legend(LAYERS[1], with_candidates=True))[-1] == ends(UTILITY_MAP)


def test_what_is_being_computed_stands_above_what_is_drawn_until_then():
    text = busy_html("View 7: replaying <frames>", legend(LAYERS[1]))
    assert text.index("View 7: replaying &lt;frames&gt;") < text.index("after view 3 of 9")
    assert "Shown until then" in text
    assert "Shown until then" not in busy_html("Opening the run", "")


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
