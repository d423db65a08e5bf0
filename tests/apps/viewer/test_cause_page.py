"""The page of a run tells what each view was chosen for, and colors the map by it."""

import re
import time

import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")

from r3jax.apps.viewer.drawing import CAUSE, CAUSE_COLORS, UNSEEN
from r3jax.apps.viewer.facts import LAYERS
from r3jax.apps.viewer.run_page import open_run_page
from r3jax.runs.replay import explain_run
from tests.apps.viewer.conftest import VIEWS

PATIENCE = 240.0  # seconds; of a machine with other work, that compiles
STEP = VIEWS - 1
CAUSES_SHOWN = next(layer.name for layer in LAYERS if layer.quantity == CAUSE)


@pytest.fixture(scope="module")
def viewer(run):
    with open_run_page(run, with_scene=False) as viewer:
        wait_until(lambda: not isinstance(viewer.app.story.reason(STEP), str))
        yield viewer


@pytest.fixture(scope="module")
def reason(run):
    """Why the last view was taken, worked out beside the page."""
    return list(explain_run(run))[STEP]


def wait_until(is_true) -> None:
    end = time.monotonic() + PATIENCE
    while not is_true():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)


def is_gray(colors: np.ndarray) -> np.ndarray:
    """Which of the colors [n, 3] have as little color as the gray of what is unseen."""
    return np.ptp(colors.astype(int), axis=1) <= np.ptp(UNSEEN)


def legend_of(viewer) -> str:
    return viewer.app.controls._legend.content


def test_the_panel_tells_the_shares_once_they_are_known(viewer, reason):
    facts = lambda: viewer.app.controls._facts.content.partition("predicted utility")[2]
    wait_until(lambda: " %<" in facts())  # the page asks again by itself
    shown = [float(share) for share in re.findall(r">([\d.]+) %<", facts())]
    np.testing.assert_allclose(shown, 100.0 * reason.totals / reason.utility, atol=0.0501)
    assert f"<b>{reason.utility:,.0f}</b>" in facts()


def test_the_map_before_the_view_is_colored_by_cause(viewer, reason):
    """Below the cut every voxel in view has the color of its largest share; the rest is gray."""
    app, cut = viewer.app, viewer.app.controls.settings.cut
    assert app.controls.settings.step == STEP
    app.controls._layer.value = CAUSES_SHOWN
    wait_until(lambda: f"just before view {STEP + 1}" in legend_of(viewer))
    scene = app.controls._server.scene
    shown = scene.get_handle_by_name("/map").colors
    state = app.story.moment(STEP - 1).map_state
    below = np.asarray(state.occupied) & (np.asarray(state.center)[2] <= cut + 1e-4)
    assert len(shown) == below.sum()
    lacks = (reason.shares.max(axis=0) > 0.0) & below[reason.rows]
    largest = np.argmax(reason.shares[:, lacks], axis=0)
    for number, color in enumerate(CAUSE_COLORS[1:]):
        assert (shown == color).all(axis=1).sum() == (largest == number).sum()
    assert len(np.unique(largest)) > 1
    assert is_gray(shown).sum() == len(shown) - lacks.sum()
    cells = scene.get_handle_by_name("/unexplored").points
    assert len(cells) == (reason.cells[:, 2] <= cut).sum() > 0
    app.controls._layer.value = "colors"
    wait_until(lambda: "before view" not in legend_of(viewer))
    assert scene.get_handle_by_name("/unexplored") is None


def test_the_start_was_chosen_by_nobody(viewer):
    viewer.app.controls._layer.value = CAUSES_SHOWN
    viewer.app.controls.set_step(0, VIEWS)
    wait_until(lambda: "nothing was chosen" in legend_of(viewer))
    shown = viewer.app.controls._server.scene.get_handle_by_name("/map").colors
    assert is_gray(shown).all()
