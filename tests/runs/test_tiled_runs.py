"""Runs with tiles: recorded, resumed, replayed, merged and explained as runs in one table are."""

import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest

import r3jax
from r3jax.apps.forecast import forecast
from r3jax.apps.report.report import write_report
from r3jax.apps.viewer.story import RecordedStory, Timeline
from r3jax.errors import InputError
from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import StopReason
from r3jax.formats.exports import export_run
from r3jax.runs.begin import merge_runs
from r3jax.runs.header import RunHeader, camera_fields, policy_fields
from r3jax.runs.reader import read_run
from r3jax.runs.replay import differences, explain_run, rebuild, sorted_rows, states_of
from r3jax.runs.writer import RunWriter
from r3jax.scoring.config import ScoringConfig
from tests.exploration.hall import Hall
from tests.exploration.test_resume import assert_same_run

HALL = Hall((40.0, 4.0, 2.6), r3jax.Camera.from_fov(48, 48, 75.0))
CONFIG = ExplorationConfig(
    voxel_size=0.1, cell_size=0.25, max_range=2.0, num_probes=4, clock="model", tiles=True
)
VIEWS = 45


def a_policy(name="r3-pano"):
    return r3jax.make_policy(
        name,
        scoring=ScoringConfig(max_range=2.0, lambda1=300.0),
        num_candidates=12,
        num_frontier=8,
    )


def go(path, views=VIEWS, *, resume=False, hall=HALL, config=CONFIG, policy=None, **how):
    policy = policy or a_policy()
    if resume:
        recorder, run = RunWriter.resume(path)
    else:
        header = RunHeader(
            scene={"name": "hall", "hash": "h"},
            policy=policy_fields(policy),
            budget=f"views:{views}",
            seed=0,
            config=asdict(config),
            camera=camera_fields(hall.camera),
            bounds=hall.bounds.tolist(),
        )
        recorder, run = RunWriter(path, header), None
    with recorder:
        return explore(
            hall, policy, budget=f"views:{views}", config=config, recorder=recorder, resume=run,
            **how,
        )  # fmt: skip


def assert_same_map(a, b):
    """Row by row, bit for bit."""
    a, b = sorted_rows(a), sorted_rows(b)
    for name in ("key", "visited", "count", "mean", "m2", "resolution"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def in_one_table(run):
    """The same frames, mapped without tiles."""
    header = replace(run.header, config=run.header.config | {"tiles": False})
    return rebuild([replace(run, header=header)])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("tiled") / "run"
    return go(path), read_run(path)


def test_the_run_leaves_the_first_block(whole):
    """Or nothing below says anything of tiles."""
    result, run = whole
    assert result.reason is StopReason.BUDGET
    assert result.state.planner.far.tiles.num_voxels > 100
    places = np.array([row.pose[0, 3] for row in run.rows])
    assert np.ptp(places) > 8.0


def test_it_ends_in_the_map_of_one_table(whole):
    result, run = whole
    planner, table = result.state.planner, in_one_table(run)
    assert_same_map(planner.whole_map, table.map_state)
    grid = planner.whole_grid
    np.testing.assert_allclose(grid.origin, table.grid.origin, atol=1e-5)
    assert grid.log_odds.shape == table.grid.log_odds.shape
    # A point on the face of a cell may count for its neighbor: origins of blocks round otherwise.
    assert np.mean(np.abs(grid.log_odds - table.grid.log_odds) > 1e-4) < 1e-3
    last = run.rows[-1].coverage
    assert last.voxels == int(table.map_state.num_present)
    assert last.known_cells == int((np.asarray(grid.free) | np.asarray(grid.occupied)).sum())
    assert last.known_share == last.known_cells / grid.log_odds.size
    assert 0.0 < last.mean_renderability < 1.0


def test_stored_and_rebuilt_maps_are_equal(whole):
    _, run = whole
    assert differences(run) == (VIEWS, [])
    step, stored, grid = run.checkpoint()
    assert step == VIEWS - 1
    table = in_one_table(run)
    assert_same_map(stored, table.map_state)
    assert grid.log_odds.shape == table.grid.log_odds.shape


def test_a_difference_is_found(whole, tmp_path):
    _, run = whole
    shutil.copytree(run.path, tmp_path / "run")
    frames = tmp_path / "run" / "frames"
    rows = (run.path / "trace.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "run" / "trace.jsonl").write_text("".join(rows[: VIEWS - 3]))
    cut = read_run(tmp_path / "run")
    assert frames.exists()
    assert differences(cut)[1]


@pytest.mark.parametrize("stored", [True, False])
def test_a_run_in_two_parts_is_the_run_in_one(tmp_path, whole, stored):
    go(tmp_path / "run", VIEWS - 4)
    if not stored:
        shutil.rmtree(tmp_path / "run" / "checkpoints")
    go(tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", whole[1].path)


def test_a_fork_takes_views_over(tmp_path, whole):
    """Another policy from view 10 on; the map is that of all its frames."""
    part = replace(whole[1], rows=whole[1].rows[:10])
    result = explore(
        HALL, a_policy("r3"), budget="views:12", config=CONFIG, resume=part, decided_from=10
    )
    assert len(result.rows) == 12
    before = rebuild([part])
    assert int(result.state.planner.whole_map.num_present) > int(before.whole_map.num_present)


def test_runs_with_tiles_merge(tmp_path, whole):
    """The second one begins at the other end, whose block is not at hand at first."""
    start = HALL.start_pose
    start[0, 3] = 38.0

    class Elsewhere(Hall):
        start_pose = start

    hall = Elsewhere(HALL.size, HALL.camera)
    go(tmp_path / "other", 4, hall=hall)
    runs = [whole[1], read_run(tmp_path / "other")]
    merged = merge_runs(runs, tmp_path / "merged")
    header = lambda run: replace(run.header, config=run.header.config | {"tiles": False})
    table = rebuild([replace(run, header=header(run)) for run in runs])
    assert_same_map(merged, table.map_state)
    assert differences(read_run(tmp_path / "merged"))[1] == []
    near = np.floor((start[:3, 3] - np.asarray(table.grid.origin)) / 0.25).astype(int)
    grid = read_run(tmp_path / "merged").checkpoint()[2]
    assert bool(grid.free[tuple(near)])


def test_views_are_explained_as_in_one_table(whole):
    _, run = whole
    header = replace(run.header, config=run.header.config | {"tiles": False})
    pairs = list(zip(explain_run(run), explain_run(replace(run, header=header)), strict=True))
    explained = [(a.totals.sum(), b.totals.sum()) for a, b in pairs if a is not None]
    assert len(explained) > VIEWS // 2
    # Cells that only a way round outside of the block leads to count in one table alone.
    assert np.mean([a == pytest.approx(b, rel=0.01) for a, b in explained]) > 0.9


def test_a_forecast_by_blocks_is_that_of_the_joined_table(whole, monkeypatch):
    planner = whole[0].state.planner
    joined = forecast.forecast_planner(planner, HALL.camera, max_range=2.0)
    monkeypatch.setattr(forecast, "_MOST_JOINED", 0)
    apart = forecast.forecast_planner(planner, HALL.camera, max_range=2.0)
    assert joined.mixture.size > 0
    np.testing.assert_allclose(apart.mixture, joined.mixture, rtol=1e-4)


def test_its_report_and_its_timeline_show_the_whole_place(whole, tmp_path):
    result, run = whole
    page = write_report(run, result.state.planner)
    assert "Not known" not in page.read_text()
    timeline = Timeline(run)
    assert_same_map(timeline.at(VIEWS - 1).map_state, in_one_table(run).map_state)
    early = list(states_of(run))[3]
    assert_same_map(timeline.at(3).map_state, early.whole_map)
    story = RecordedStory(run)
    while story.advance():
        pass
    assert "report" in story.reason(3)
    num = export_run(run, tmp_path / "out", "colmap")
    assert num == int(sorted_rows(result.state.planner.whole_map).num_present)


def test_policies_that_need_the_whole_place_are_refused(tmp_path):
    with pytest.raises(InputError, match="random"):
        go(tmp_path / "run", policy=a_policy("random"))
