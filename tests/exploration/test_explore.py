"""The loop, in a box of a room: what is recorded is what happened, however the run ends."""

import errno
import itertools
import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.exploration import explore, state
from r3jax.exploration.config import ExplorationConfig, parse_budget
from r3jax.exploration.state import StopReason
from r3jax.mapping.occupancy import empty_grid, integrate_depth, mark_free_ball
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.runs import stored_states
from r3jax.runs.reader import read_run
from r3jax.runs.writer import RunWriter
from tests.exploration.toys import UPPER, BoxRoom, Wander
from tests.runs.runs import make_header

CONFIG = ExplorationConfig(
    voxel_size=0.1, capacity=1 << 14, clock="model", num_probes=4, checkpoint_every=3
)


def run_in(path, policy=None, simulator=None, budget="views:5", config=CONFIG, **kwargs):
    simulator = simulator or BoxRoom()
    camera = simulator.camera
    numbers = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    header = make_header(camera={"width": camera.width, "height": camera.height, **numbers})
    with RunWriter(path, header) as recorder:
        return explore(
            simulator,
            policy or Wander(),
            budget=budget,
            config=config,
            recorder=recorder,
            **kwargs,
        )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """One recorded run: the folder, the result, the simulator that saw it."""
    simulator = BoxRoom()
    path = tmp_path_factory.mktemp("runs") / "box"
    return path, run_in(path, simulator=simulator), simulator


def assert_trees_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_budget_of_views_gives_as_many_views(recorded):
    path, result, simulator = recorded
    assert result.reason is StopReason.BUDGET
    assert len(result.rows) == len(read_run(path).rows) == len(simulator.rendered) == 5
    assert result.state.policy_state == {"decisions": 4, "frames": 5}


def test_the_simulator_is_asked_for_nothing_but_the_recorded_views(recorded):
    path, _, simulator = recorded
    poses = [row.pose for row in read_run(path).rows]
    np.testing.assert_array_equal(np.asarray(simulator.rendered, np.float32), np.asarray(poses))
    np.testing.assert_array_equal(poses[0], simulator.start_pose.astype(np.float32))


def test_replaying_the_files_rebuilds_map_and_grid_bit_for_bit(recorded):
    path, result, simulator = recorded
    run = read_run(path)
    map_state = empty_map(CONFIG.capacity, CONFIG.voxel_size, CONFIG.num_bins)
    grid = empty_grid(simulator.bounds, CONFIG.cell_size)
    ball = jax.jit(mark_free_ball)
    add_to_grid = jax.jit(integrate_depth)
    start = jnp.asarray(simulator.start_pose[:3, 3], jnp.float32)
    grid = ball(grid, start, CONFIG.start_radius)
    for frame in run.frames():
        map_state = integrate_growing(map_state, frame, CONFIG.max_range)
        grid = ball(add_to_grid(grid, frame, CONFIG.max_range), frame.position, CONFIG.body_radius)
    assert_trees_equal(map_state, result.state.map_state)
    assert_trees_equal(grid, result.state.grid)
    step, stored_map, stored_grid = run.checkpoint()
    assert step == 4
    assert_trees_equal(stored_map, map_state)
    assert_trees_equal(stored_grid, grid)


def test_totals_are_the_sums_of_their_parts(recorded):
    rows = recorded[1].rows
    assert rows[0].choice is None
    assert rows[0].metres == rows[0].radians == 0.0
    for before, row in itertools.pairwise(rows):
        steps = np.diff(row.choice.waypoints, axis=0)
        length = np.linalg.norm(steps, axis=1).sum()
        assert row.metres - before.metres == pytest.approx(length, abs=1e-5)
        assert row.charged["flight"] == pytest.approx(length / CONFIG.speed, abs=1e-5)
        assert row.seconds - before.seconds == pytest.approx(sum(row.charged.values()))
        cosine = before.pose[:3, 2] @ row.pose[:3, 2]
        assert row.radians - before.radians >= np.arccos(np.clip(cosine, -1, 1)) - 1e-3
        assert row.coverage.voxels >= before.coverage.voxels
        assert row.choice.top["total"] == sorted(row.choice.top["total"], reverse=True)
    assert rows[-1].coverage.known_share > rows[0].coverage.known_share > 0.0
    assert 0.0 < rows[-1].coverage.mean_renderability <= 1.0
    assert rows[0].coverage.arrival_renderability == 0.0  # nothing was known yet


def test_the_same_run_twice_writes_the_same_bytes(recorded, tmp_path):
    path, result, _ = recorded
    again = run_in(tmp_path / "again")
    assert_trees_equal(again.state.map_state, result.state.map_state)
    names = ["trace.jsonl", *(f"frames/{i:06d}{end}" for i in range(5) for end in IMAGES)]
    for name in names:
        assert (tmp_path / "again" / name).read_bytes() == (path / name).read_bytes(), name
    other = run_in(tmp_path / "other", seed=1)
    assert other.rows[1].sha256 != result.rows[1].sha256


IMAGES = (".png", ".depth.png")

NO_TIMES = (-0.1, float("nan"), float("inf"))


@pytest.mark.parametrize("budget", ["seconds:2.5", "meters:1.0"])
def test_the_last_view_arrives_within_the_budget(budget):
    result = explore(BoxRoom(), Wander(), budget=budget, config=CONFIG)
    limit = parse_budget(budget)
    assert result.reason is StopReason.BUDGET
    assert len(result.rows) > 1
    mapping = CONFIG.mapping_seconds  # the last picture is taken in time, mapped after
    assert getattr(result.state, limit.unit) <= limit.amount + mapping
    assert limit.words in result.message
    assert "metres" not in result.message


def test_only_planning_mapping_and_flight_are_on_the_wall_clock(monkeypatch):
    ticks = itertools.count()
    monkeypatch.setattr(state.time, "perf_counter", lambda: float(next(ticks)))
    config = replace(CONFIG, clock="wall")
    result = explore(BoxRoom(), Wander(), budget="views:4", config=config)
    # Every timed call lasts one tick: one for planning, one for mapping.
    expected = 4 * 1.0 + 3 * 1.0 + result.state.metres / config.speed
    assert result.state.seconds == pytest.approx(expected)


def test_no_reachable_candidate_ends_the_run_with_the_reason(tmp_path):
    result = run_in(tmp_path / "run", policy=Wander(last_step=1), budget="views:50")
    assert result.reason is StopReason.NO_REACHABLE_CANDIDATE
    run = read_run(tmp_path / "run")
    assert run.end is not None
    assert (run.end.outcome, run.end.views) == ("no-reachable-candidate", 2)
    assert "9 candidates" in run.end.message
    assert run.checkpoint()[0] == 1


def test_a_policy_that_never_moves_ends_the_run():
    config = replace(CONFIG, max_still_views=3)
    result = explore(BoxRoom(), Wander(reach=0.0), budget="meters:5", config=config)
    assert result.reason is StopReason.STUCK
    assert len(result.rows) == 3


class Interrupted(BoxRoom):
    """Raises at the third picture."""

    error: BaseException = KeyboardInterrupt()

    def render(self, T_world_camera):
        if len(self.rendered) == 2:
            raise self.error
        return super().render(T_world_camera)


def test_an_interrupt_leaves_a_run_that_can_be_read(tmp_path):
    result = run_in(tmp_path / "run", simulator=Interrupted())
    assert result.reason is StopReason.INTERRUPTED
    run = read_run(tmp_path / "run")
    assert run.end is not None
    assert (run.end.outcome, run.end.views, len(run.rows)) == ("interrupted", 2, 2)
    assert_trees_equal(run.checkpoint()[1], result.state.map_state)


def test_an_error_is_recorded_and_raised(tmp_path):
    simulator = Interrupted()
    simulator.error = ValueError("the mesh broke")
    with pytest.raises(ValueError, match="broke"):
        run_in(tmp_path / "run", simulator=simulator)
    run = read_run(tmp_path / "run")
    assert run.end is not None
    assert run.end.outcome == "failed"
    assert "the mesh broke" in run.end.message


@pytest.mark.parametrize("failing_call", [4, 9, 16])
def test_a_full_disk_ends_the_run_and_keeps_what_was_recorded(tmp_path, monkeypatch, failing_call):
    real, calls = os.fsync, itertools.count()

    def full(descriptor):
        if next(calls) >= failing_call:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    result = run_in(tmp_path / "run")
    monkeypatch.undo()
    assert result.reason is StopReason.RECORDING_STOPPED
    assert "No space left on device" in result.message
    run = read_run(tmp_path / "run")
    assert len(run.rows) == len(result.rows) < 5
    assert len(list(run.frames())) == len(run.rows)


def test_a_checkpoint_that_the_disk_refuses_is_told_in_the_last_row(tmp_path, monkeypatch, capfd):
    def full(path, tables):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(stored_states, "write_checkpoint", full)
    result = run_in(tmp_path / "run")
    run = read_run(tmp_path / "run")
    assert run.outcome == f"{result.reason.value}: {result.message}"
    assert result.message.count("No space left on device") == 1
    assert capfd.readouterr() == ("", "")


@pytest.mark.full
def test_the_table_grows_before_it_is_full_and_loses_nothing():
    small = replace(CONFIG, capacity=1 << 12)
    result = explore(BoxRoom(), Wander(), budget="views:4", config=small)
    grown = result.state.map_state
    assert grown.capacity == 1 << 13
    assert int(grown.num_occupied) <= 0.7 * grown.capacity
    assert result.rows[-1].coverage.dropped == 0
    reference = explore(BoxRoom(), Wander(), budget="views:4", config=CONFIG).state.map_state
    assert int(reference.num_occupied) == int(grown.num_occupied)
    assert float(jnp.sum(reference.count)) == float(jnp.sum(grown.count))


@pytest.mark.full
def test_a_table_that_may_not_grow_counts_what_it_loses(tmp_path):
    fixed = replace(CONFIG, capacity=1 << 9, allow_growth=False)
    result = run_in(tmp_path / "run", budget="views:2", config=fixed)
    assert result.state.map_state.capacity == 1 << 9
    dropped = read_run(tmp_path / "run").rows[-1].coverage.dropped
    assert dropped == int(result.state.map_state.dropped) > 0


def test_a_start_outside_the_box_is_refused():
    simulator = BoxRoom()
    simulator.start_pose[:3, 3] = UPPER + 1.0
    with pytest.raises(ValueError, match="box"):
        explore(simulator, Wander(), budget="views:2", config=CONFIG)


@pytest.mark.parametrize(
    "wrong",
    [
        {"voxel_size": 0.0},
        {"max_range": float("nan")},
        {"cell_size": float("inf")},
        {"speed": -1.0},
        {"speed": 1e-310},
        {"num_probes": 0},
        {"checkpoint_every": 0},
        {"capacity": 1000},
        {"capture_every": 0.01},
        {"capture_every": 0.3, "capture_rate": 5.0},
        {"capture_rate": 0.0},
        {"exposure": -1.0},
        {"blur": 0.0},
        {"gaze": "blend"},
        {"gaze": "planned"},
        *({name: value} for name in ("planning_seconds", "mapping_seconds") for value in NO_TIMES),
    ],
)
def test_settings_that_cannot_work_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ExplorationConfig(**wrong)
