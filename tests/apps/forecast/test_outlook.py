"""A forecast along a run: how many more views a decibel takes, and a run that ends by it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.forecast.forecast import Outlook, forecast_map, more_views, stopping_rule
from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import StopReason
from r3jax.runs.header import camera_fields
from r3jax.runs.reader import read_run
from r3jax.runs.replay import states_of
from r3jax.runs.writer import RunWriter
from tests.exploration.killed_run import CONFIG, small_policy
from tests.exploration.toys import BoxRoom
from tests.runs.runs import make_header


@given(st.floats(0.2, 20.0), st.integers(2, 40))
def test_more_views_follow_the_doubling(slope, eighth):
    """Where every doubling adds `slope` dB, so does the next: by the formula, and walked there."""
    taken = np.arange(1, 9) * eighth
    curve = lambda n: 12.0 + slope * np.log2(n)
    more = more_views(taken, curve(taken), 1.0)
    assert curve(taken[-1] + more) >= curve(taken[-1]) + 1.0 - 1e-6
    assert curve(taken[-1] + more - 1) < curve(taken[-1]) + 1.0 + 1e-6
    # What came before the second half does not matter.
    early = np.where(2 * taken < taken[-1], 0.0, curve(taken))
    assert more_views(taken, early, 1.0) == more


def test_no_gain_is_no_number():
    views = np.array([10, 20, 30, 40])
    for late in ([25.0, 25.0, 25.0], [25.0, 25.03, 25.05], [26.0, 25.5, 25.0], [-np.inf] * 3):
        assert more_views(views, np.array([20.0, *late])) is None
    assert more_views(views[:0], np.zeros(0)) is None
    rising = np.array([0.0, 24.0, 25.0, 26.0])
    assert more_views(views, rising, 0.5) < more_views(views, rising, 1.0)


def go(path, views: int, config: ExplorationConfig, resume: bool = False):
    """Explores the box room and records, or goes on."""
    room, run = BoxRoom(), None
    if resume:
        recorder, run = RunWriter.resume(path)
    else:
        header = make_header(
            camera=camera_fields(room.camera),
            bounds=room.bounds.tolist(),
            config=dataclasses.asdict(config),
        )
        recorder = RunWriter(path, header)
    with recorder:
        return explore(
            room, small_policy("r3-pano"), budget=f"views:{views}", config=config,
            recorder=recorder, resume=run, is_enough=stopping_rule(config, room.camera),
        )  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Nine views, and nothing that ends them early."""
    path = tmp_path_factory.mktemp("outlook") / "whole"
    return go(path, 9, CONFIG), path


@pytest.fixture(scope="module")
def reached(whole):
    """The forecasts of the mean after each view, by brute force: a replay and a forecast each."""
    run = read_run(whole[1])
    return [forecast_map(planner.map_state, planner.grid, run.camera).value("mean")
            for planner in states_of(run)]  # fmt: skip


def test_a_run_ends_when_its_forecast_says_so(whole, reached, tmp_path):
    """It is asked every third view; the views before are those of the run without a goal."""
    goal = reached[5] - 0.01
    assert reached[2] < goal  # the goal is in between, or the test says nothing
    config = dataclasses.replace(CONFIG, until=f"psnr:{goal}", until_every=3)
    result = go(tmp_path / "run", 9, config)
    assert result.reason is StopReason.FORECAST
    assert len(result.rows) == 6
    assert [row.sha256 for row in result.rows] == [row.sha256 for row in whole[0].rows[:6]]
    assert result.rows[-1].seconds == whole[0].rows[5].seconds  # beside the mission clock
    assert (
        f"6 views: the forecast of the PSNR of free-space views (mean) is {reached[5]:.1f} dB"
        in (result.message)
    )
    assert read_run(tmp_path / "run").end.outcome == "forecast"


def test_a_run_that_was_cut_off_ends_at_the_same_view(whole, reached, tmp_path):
    config = dataclasses.replace(CONFIG, until=f"psnr:{reached[5] - 0.01}", until_every=3)
    go(tmp_path / "run", 4, config)
    result = go(tmp_path / "run", 9, config, resume=True)
    assert result.reason is StopReason.FORECAST
    assert [row.sha256 for row in result.rows] == [row.sha256 for row in whole[0].rows[:6]]


def test_a_goal_too_high_leaves_the_budget_in_charge(whole, tmp_path):
    result = go(tmp_path / "run", 4, dataclasses.replace(CONFIG, until="psnr:99", until_every=1))
    assert result.reason is StopReason.BUDGET
    assert [row.sha256 for row in result.rows] == [row.sha256 for row in whole[0].rows[:4]]


def test_an_outlook_watches_a_replay(whole, reached):
    """Three forecasts of nine views; every state is passed on."""
    run = read_run(whole[1])
    outlook = Outlook(run, num=3)
    assert len(list(outlook.watch(states_of(run)))) == 9
    assert outlook.views == [3, 6, 9]
    values = [forecast.value("mean") for forecast in outlook.forecasts]
    np.testing.assert_array_equal(values, [reached[2], reached[5], reached[8]])
    outlook.add(9, whole[0].state.planner)  # known already
    assert outlook.views == [3, 6, 9]


def test_frames_on_the_way_are_no_views(whole):
    """Of nine frames four were captured, the last one too: the first, 4th, 5th, 7th, 8th chose."""
    run = read_run(whole[1])
    captured = (1, 2, 5, 8)
    rows = tuple(dataclasses.replace(row, captured=row.step in captured) for row in run.rows)
    outlook = Outlook(dataclasses.replace(run, rows=rows))
    for _ in outlook.watch(states_of(run)):
        pass
    assert outlook.frames == [1, 4, 5, 7, 9]
    assert outlook.views == [1, 2, 3, 4, 5]


def test_a_goal_that_nobody_checks_is_refused():
    config = dataclasses.replace(CONFIG, until="psnr:20")
    with pytest.raises(ValueError, match="is_enough"):
        explore(BoxRoom(), small_policy("random"), budget="views:1", config=config)


def test_a_goal_that_is_none_is_refused():
    with pytest.raises(ValueError, match="'ssim:1'"):
        stopping_rule(dataclasses.replace(CONFIG, until="ssim:1"), BoxRoom().camera)
    with pytest.raises(ValueError, match="until_every"):
        dataclasses.replace(CONFIG, until_every=0)
