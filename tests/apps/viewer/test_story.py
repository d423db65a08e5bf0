"""A state on the timeline is the one that the frames rebuild, whichever way one came there."""

import shutil

import numpy as np
import pytest

from r3jax.apps.viewer.story import Timeline
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from r3jax.runs.replay import rebuild
from tests.apps.viewer.conftest import VIEWS


def content(map_state) -> dict:
    """Voxels by key: rows may stand in another order."""
    used = np.asarray(map_state.occupied)
    keys = map(tuple, np.asarray(map_state.key)[:, used].T.tolist())
    rows = zip(
        np.asarray(map_state.count)[used],
        np.asarray(map_state.visited)[:, used].T.tolist(),
        np.asarray(map_state.resolution)[used],
        strict=True,
    )
    return dict(zip(keys, [(float(c), tuple(v), float(r)) for c, v, r in rows], strict=True))


@pytest.fixture(scope="module")
def expected(run):
    return [rebuild([run], step + 1) for step in range(VIEWS)]


def assert_is(moment, step, expected):
    map_state, grid = expected[step].map_state, expected[step].grid
    assert moment.step == step
    assert content(moment.map_state) == content(map_state)
    np.testing.assert_array_equal(moment.grid.log_odds, grid.log_odds)


@pytest.mark.parametrize("memory", [1 << 30, 1])
@pytest.mark.parametrize("order", [(4, 0, 2, 4, 1), (0, 1, 2, 3, 4), (3, 3, 0, 1)])
def test_any_way_through_the_views_gives_the_rebuilt_states(run, expected, memory, order):
    timeline = Timeline(run, memory)
    for step in order:
        assert_is(timeline.at(step), step, expected)


def test_with_little_memory_few_states_are_kept(run):
    timeline = Timeline(run, 1)
    assert timeline.stride == 3  # two of five views
    for _ in timeline.follow():
        pass
    assert len(timeline._kept) == 2


def test_following_gives_every_state_in_order_whatever_else_is_asked(run, expected):
    timeline = Timeline(run)
    for step, moment in enumerate(timeline.follow()):
        assert_is(moment, step, expected)
        assert_is(timeline.at((3 * step) % VIEWS), (3 * step) % VIEWS, expected)
    assert step == VIEWS - 1


def test_the_last_state_comes_from_the_checkpoint_without_reading_a_frame(run, expected, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    shutil.rmtree(copy / "frames")
    timeline = Timeline(read_run(copy))
    assert_is(timeline.at(VIEWS - 1), VIEWS - 1, expected)
    with pytest.raises(RunError, match="missing"):
        timeline.at(0)


def test_a_replay_tells_how_many_frames_are_done(run, expected):
    timeline = Timeline(run)
    assert list(timeline.replay(2)) == [(0, 3), (1, 3), (2, 3)]
    assert list(timeline.replay(3)) == [(0, 1)]
    assert list(timeline.replay(VIEWS - 1)) == []  # stored
    assert_is(timeline.at(3), 3, expected)


def test_a_replay_that_is_left_undone_is_gone_on_with(run, expected):
    timeline = Timeline(run, 1)
    for done, _ in timeline.replay(3):
        if done == 2:
            break
    assert list(timeline.replay(3)) == [(0, 2), (1, 2)]
    assert_is(timeline.at(3), 3, expected)


def test_without_checkpoints_frames_will_do(run, expected, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    shutil.rmtree(copy / "checkpoints")
    assert_is(Timeline(read_run(copy)).at(VIEWS - 1), VIEWS - 1, expected)


def test_a_frame_that_was_changed_is_named(run, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    shutil.copy(copy / "frames" / "000001.png", copy / "frames" / "000002.png")
    timeline = Timeline(read_run(copy))
    timeline.at(1)
    with pytest.raises(RunError):
        timeline.at(2)
