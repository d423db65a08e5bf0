"""Why a view was taken: as a run is replayed, and on the voxels that it was to see."""

import dataclasses

import numpy as np
import pytest

from r3jax.apps.viewer.drawing import UNSEEN, Blocks, block_causes, cause_colors
from r3jax.apps.viewer.story import RecordedStory
from r3jax.plots import style
from r3jax.runs.replay import Reason, explain_run
from tests.apps.viewer.conftest import VIEWS

CAPACITY = 16


@pytest.fixture(scope="module")
def reasons(run):
    return list(explain_run(run))


@pytest.fixture
def story(run):
    return RecordedStory(run)


def test_reasons_come_as_the_run_is_replayed(story, reasons):
    assert story.reason(0) == "the start: nothing was chosen"
    for step in range(1, VIEWS):
        assert story.reason(step) == "is being computed …"
    num_turns = 0
    while story.advance():
        num_turns += 1
        for step in range(1, VIEWS):
            assert isinstance(story.reason(step), Reason) == (step < num_turns)
    assert num_turns == VIEWS
    for step in range(1, VIEWS):
        found, expected = story.reason(step), reasons[step]
        np.testing.assert_allclose(found.totals, expected.totals, rtol=1e-5)
        np.testing.assert_array_equal(found.cells, expected.cells)
        assert len(found.rows) == len(expected.rows)
        assert found.utility > 0.0


def test_rows_are_those_of_the_map_that_the_story_shows(story):
    """The last view's own map comes from a checkpoint, where rows may stand otherwise."""
    story.moment(VIEWS - 1)
    while story.advance():
        pass
    for step in range(1, VIEWS):
        moment, reason = story.moment(step - 1), story.reason(step)
        assert isinstance(reason, Reason)
        assert np.asarray(moment.map_state.occupied)[reason.rows].all()


def test_a_merged_run_is_replayed_without_reasons(run):
    header = dataclasses.replace(run.header, parent={"merged": ["a", "b"], "merged_views": [2, 3]})
    story = RecordedStory(dataclasses.replace(run, header=header))
    assert sum(story.advance() for _ in range(VIEWS + 2)) == VIEWS
    assert story.reason(2) == "merged from runs that decided each on a map of its own"


def make_reason() -> Reason:
    shares = [[0.6, 0.0, 0.1, 0.2], [0.1, 0.0, 0.0, 0.2], [0.0, 0.0, 0.4, 0.2]]
    return Reason(
        totals=np.array([48.0, 24.0, 8.0, 0.0]),
        rows=np.array([3, 5, 6, 9]),
        shares=np.array(shares, np.float32),
        cells=np.zeros((3, 3), np.float32),
    )


def test_a_block_has_the_cause_that_took_most_of_its_voxels():
    # Rows 3 and 6 are one block, 5 and 7 the second, 9 the third, 1 the fourth.
    blocks = Blocks(
        centers=np.zeros((4, 3), np.float32),
        edge=0.1,
        rows=np.array([1, 3, 5, 6, 7, 9]),
        block_of=np.array([3, 0, 1, 0, 1, 2]),
    )
    causes = block_causes(blocks, CAPACITY, make_reason())
    # 0.7 oblique against 0.4 far; nothing lacks; all alike, so the first; not in view.
    assert causes.tolist() == [1, 0, 1, 0]
    lone = dataclasses.replace(make_reason(), shares=make_reason().shares[::-1])
    assert block_causes(blocks, CAPACITY, lone).tolist() == [3, 0, 1, 0]


def test_causes_have_the_colors_of_the_report():
    rgb = [tuple(int(color[i : i + 2], 16) for i in (1, 3, 5)) for color in style.CAUSE_COLORS]
    own = np.tile(np.asarray(UNSEEN, np.uint8).mean().round().astype(np.uint8), (4, 3))
    colors = cause_colors(np.arange(4), own)
    assert colors[1:].tolist() == [list(color) for color in rgb[1:]]
    np.testing.assert_allclose(colors[0], UNSEEN, atol=5)


def test_what_was_not_to_be_seen_is_gray_and_as_light_as_the_map():
    own = np.array([[0, 0, 0], [255, 255, 255], [200, 10, 0]], np.uint8)
    dark, light, red = cause_colors(np.zeros(3, np.intp), own).astype(int)
    assert dark.sum() < red.sum() < light.sum()
    for color in (dark, light, red):
        assert np.ptp(color) <= np.ptp(UNSEEN)
