"""Frames on the way: where they are, what they cost, and what they never do to a run."""

import json
import re
import shutil
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest

from r3jax.exploration import explore
from r3jax.exploration.captures import CaptureSettings, begin_leg, points_along
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.guard import OracleReadError
from r3jax.exploration.state import StopReason
from r3jax.exploration.taken_views import stored_form
from r3jax.geometry.cameras import Camera, angle_between
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import MOTIONS, Motion
from r3jax.planning.turning import direction_of
from r3jax.runs.begin import merge_runs
from r3jax.runs.header import camera_fields, policy_fields
from r3jax.runs.reader import read_run
from r3jax.runs.replay import differences, explain_run, states_of
from r3jax.runs.rows import from_json, paths_to, to_json
from r3jax.runs.writer import RunWriter
from tests.exploration.killed_run import CONFIG, SCORING, small_policy
from tests.exploration.test_guard import Cheat
from tests.exploration.test_resume import assert_same_run
from tests.exploration.toys import BoxRoom, Wander
from tests.planning.rooms import pose_at
from tests.runs.runs import make_header, make_view
from tests.tiers import quick_and_full

EVERY = 0.2
AHEAD = replace(CONFIG, capture_every=EVERY, gaze="ahead")
PANORAMA = replace(CONFIG, capture_every=EVERY)
CAMERA = Camera.from_fov(48, 48, 90.0)
INFO = PlanInfo(DecisionOutcome.MOVED, 5, 5)


def wander(config=AHEAD, budget="views:4", **more):
    return explore(BoxRoom(), Wander(reach=1.2), budget=budget, config=config, **more)


@pytest.fixture(scope="module")
def result():
    return wander()


def decision_to(T, waypoints, **more):
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    return Decision(T, waypoints, length, 1.0, T[None], **more)


def test_a_path_is_cut_into_equal_pieces_by_hand():
    """0.3 m along x, then 0.4 m along y: four pieces of 0.175 m."""
    waypoints = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.3, 0.4, 1.0]])
    points = points_along(waypoints, 4)
    expected = [[0.175, 0, 1], [0.3, 0.05, 1], [0.3, 0.225, 1], [0.3, 0.4, 1]]
    np.testing.assert_allclose(points, expected, atol=1e-12)
    T = pose_at(waypoints[-1])
    config = ExplorationConfig(capture_every=0.2, speed=0.5)
    leg = begin_leg(
        decision_to(T, waypoints), INFO, np.eye(4), CaptureSettings(config, Motion(), CAMERA)
    )
    np.testing.assert_allclose(leg.places, expected, atol=1e-12)
    np.testing.assert_allclose(leg.lengths, 0.175)
    np.testing.assert_allclose(leg.seconds, 0.35)
    by_rate = replace(
        config, capture_every=None, capture_rate=5.0
    )  # 0.1 m at half a meter a second
    leg = begin_leg(
        decision_to(T, waypoints), INFO, np.eye(4), CaptureSettings(by_rate, Motion(), CAMERA)
    )
    assert len(leg.places) == 7
    off = CaptureSettings(ExplorationConfig(), Motion(), CAMERA)
    leg = begin_leg(decision_to(T, waypoints), INFO, np.eye(4), off)
    assert (leg.length, leg.flight, leg.is_last) == (0.7, 0.7, True)


def test_the_flight_takes_as_long_as_the_policy_says():
    """A turn of 90 degrees at 45 a second after a meter: 1 s and 2 s, whatever is captured."""
    waypoints = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    T = pose_at(waypoints[-1])
    motion = Motion(speed=1.0, turn_rate=45.0)
    rules = CaptureSettings(ExplorationConfig(capture_every=0.25), motion, CAMERA)
    leg = begin_leg(decision_to(T, waypoints, seconds=3.0), INFO, np.eye(4), rules)
    np.testing.assert_allclose(leg.seconds, [0.25, 0.25, 0.25, 2.25])
    np.testing.assert_allclose(np.degrees(leg.turning.allowed), 45.0 * leg.seconds)


def test_blur_limits_the_turn_of_frames_on_the_way_alone():
    """f = 24 px, 10 ms, half a pixel: 0.5 / 0.24 rad/s, over 0.25 s; the last is taken at rest."""
    waypoints = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    config = ExplorationConfig(capture_every=0.25, exposure=0.01, blur=0.5)
    rules = CaptureSettings(config, Motion(), CAMERA)
    leg = begin_leg(decision_to(pose_at(waypoints[-1]), waypoints), INFO, np.eye(4), rules)
    np.testing.assert_allclose(leg.turning.allowed[:-1], 0.5 / 0.24 * 0.25, rtol=1e-6)
    assert leg.turning.allowed[-1] == np.inf


def test_frames_on_the_way_are_rows_with_a_flag(result):
    assert result.reason is StopReason.BUDGET
    assert sum(not row.captured for row in result.rows) == 4 == result.state.chosen
    assert result.state.captured == sum(row.captured for row in result.rows) > 4
    for before, row in pairwise(result.rows):
        # The decision stands where it was made: in the first row of its path.
        assert (row.choice is not None) == (not before.captured)
        assert row.charged["mapping"] == 0.02
        assert row.charged["planning"] == (0.3 if row.choice else 0.0)
        assert row.charged.get("gaze") == (0.01 if row.captured else None)
        step = np.linalg.norm(row.pose[:3, 3] - before.pose[:3, 3])
        assert step <= EVERY + 1e-6
        assert row.metres - before.metres == pytest.approx(step, abs=1e-5)
        assert row.charged["flight"] == pytest.approx(step, abs=1e-5)
        assert row.seconds == pytest.approx(before.seconds + sum(row.charged.values()))
        assert from_json(to_json(row)).captured == row.captured
    ends = [row.pose for row in result.rows if not row.captured][1:]
    chosen = [row.choice.pose for row in result.rows if row.choice]
    np.testing.assert_array_equal(ends, chosen)


def test_the_camera_looks_ahead(result):
    for row, after in pairwise(result.rows):
        offset = after.pose[:3, 3] - row.pose[:3, 3]
        if row.captured:
            np.testing.assert_allclose(row.pose[:3, 2], offset / np.linalg.norm(offset), atol=1e-4)


def legs_of(rows):
    """The rows of every path, the view before it included."""
    ends = [i for i, row in enumerate(rows) if not row.captured]
    return [rows[a : b + 1] for a, b in pairwise(ends)]


def test_captures_do_not_change_what_is_decided_first():
    """Nor the length of the first flight: the same path, seen on the way."""
    blind, seen = wander(CONFIG, "views:2"), wander(AHEAD, "views:2")
    assert to_json(blind.rows[0]) == to_json(seen.rows[0])
    np.testing.assert_array_equal(blind.rows[-1].pose, seen.rows[-1].pose)
    assert blind.rows[-1].metres == pytest.approx(seen.rows[-1].metres)
    num = len(seen.rows) - 2
    assert seen.rows[-1].seconds == pytest.approx(blind.rows[-1].seconds + 0.03 * num)


def test_a_capture_never_makes_the_map_worse(result):
    """All that the chosen views know of a voxel is known with the frames on the way too."""
    simulator, config = BoxRoom(), AHEAD
    frames = [stored_form(simulator.render(np.float64(row.pose))) for row in result.rows]
    map_state = empty_map(config.capacity, config.voxel_size, config.num_bins)
    blind, seen = map_state, map_state
    for row, frame in zip(result.rows, frames, strict=True):
        seen = integrate(seen, frame)
        if not row.captured:
            blind = integrate(blind, frame)
            known, more = by_voxel(blind), by_voxel(seen)
            assert known.keys() <= more.keys()
            for key, (visited, count, resolution) in known.items():
                assert np.all(more[key][0] & visited == visited)
                assert more[key][1] >= count
                assert more[key][2] >= resolution
    assert len(by_voxel(seen)) > len(by_voxel(blind))


def by_voxel(state):
    """Visited bins, frames and resolution of every voxel, by its key."""
    rows = np.flatnonzero(np.asarray(state.occupied))
    key, visited = np.asarray(state.key)[:, rows].T, np.asarray(state.visited)[:, rows].T
    count, resolution = np.asarray(state.count)[rows], np.asarray(state.resolution)[rows]
    return {
        tuple(k): found for k, *found in zip(key.tolist(), visited, count, resolution, strict=True)
    }


def test_rows_without_captures_are_what_they_were():
    row, _ = make_view(2)
    assert "captured" not in json.loads(to_json(row))
    assert json.loads(to_json(replace(row, captured=True)))["captured"] is True
    assert from_json(to_json(row)).captured is False


def record(path, policy, config, budget, **more):
    """Begins a run, or goes on with it."""
    simulator = BoxRoom()
    if (path / "run.json").exists():
        recorder, run = RunWriter.resume(path)
    else:
        header = make_header(
            camera=camera_fields(simulator.camera),
            bounds=simulator.bounds.tolist(),
            policy=policy_fields(policy),
            config=asdict(config),
        )
        recorder, run = RunWriter(path, header), None
    with recorder:
        result = explore(
            simulator, policy, budget=budget, config=config, recorder=recorder, resume=run, **more
        )
    return result, simulator


def cut_off(path, num):
    """A kill when `num` rows were written: what is later is gone, checkpoints of it stay behind."""
    lines = (path / "trace.jsonl").read_text().splitlines(keepends=True)
    (path / "trace.jsonl").write_text("".join(lines[:num]))


RUNS = {
    "wander": (Wander(reach=1.2), AHEAD, "frames:12"),
    "r3-pano": (small_policy("r3-pano"), PANORAMA, "frames:14"),
    "r3con": (small_policy("r3con"), PANORAMA, "frames:14"),
}


@pytest.mark.parametrize("name", quick_and_full(RUNS, ["wander", "r3-pano"], slow=["r3con"]))
def test_a_run_that_is_cut_off_on_the_way_goes_on_as_if_it_had_not_been(tmp_path, name):
    policy, config, budget = RUNS[name]
    whole, _ = record(tmp_path / "whole", policy, config, budget)
    assert len(whole.rows) == int(budget.split(":")[1])
    cuts = [row.step for row in whole.rows if row.captured]
    for how, cut in (("stopped", cuts[1]), ("killed", cuts[-2]), ("no checkpoint", cuts[2])):
        path = tmp_path / how.replace(" ", "-")
        record(path, policy, config, f"frames:{cut + 1}")
        if how == "killed":
            cut_off(path, cut)
        if how == "no checkpoint":
            shutil.rmtree(path / "checkpoints")
        _, simulator = record(path, policy, config, budget)
        assert_same_run(path, tmp_path / "whole")
        assert (
            len(simulator.rendered) <= len(whole.rows) - cut
        )  # what is recorded is not taken again


def test_a_replayed_run_is_the_recorded_one_and_can_be_explained(tmp_path):
    policy = small_policy("r3")
    result, _ = record(tmp_path / "run", policy, PANORAMA, "frames:9")
    run = read_run(tmp_path / "run")
    assert differences(run) == (9, [])
    reasons = list(explain_run(run))
    decided = [row.choice is not None for row in result.rows]
    assert [reason is not None for reason in reasons] == decided
    # What was looked for in vain is counted as in the run, or utilities would differ.
    for row, reason in zip(result.rows, reasons, strict=True):
        if reason is not None:
            assert reason.utility == pytest.approx(row.choice.top["utility"][0], rel=1e-4)


def test_another_policy_takes_over_on_the_way(tmp_path):
    record(tmp_path / "run", Wander(reach=1.2), AHEAD, "frames:8")
    run = read_run(tmp_path / "run")
    at = next(row.step for row in run.rows if row.captured and row.choice is None)
    run = replace(run, rows=run.rows[:at])
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    policy = Wander(name="other", reach=0.5)
    result = explore(
        BoxRoom(), policy, budget="frames:10", config=AHEAD, resume=run, decided_from=at
    )
    assert result.rows[at].choice is not None  # decided anew, where the camera was
    np.testing.assert_allclose(
        result.rows[at].choice.waypoints[0], run.rows[-1].pose[:3, 3], atol=1e-6
    )


class Corners(Wander):
    """Flies along one axis after the other."""

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        decision, *more = super().decide(state, map_state, grid, T_world_camera, key=key)
        (a, _, _), (_, y, z) = decision.waypoints[::-1]
        way = np.array([decision.waypoints[0], [a, y, z], decision.waypoints[1]])
        return decision_to(decision.T_world_camera, way), *more


def test_the_paths_of_a_merged_run_are_as_long_as_flown(tmp_path):
    """The first run ends on the way; nothing is flown from there to where the second begins."""
    for name, seed in (("a", 0), ("b", 1)):
        record(tmp_path / name, Corners(reach=1.2), AHEAD, "frames:9", seed=seed)
    parts = [read_run(tmp_path / name) for name in "ab"]
    assert parts[0].rows[-1].captured
    merge_runs(parts, tmp_path / "merged")
    rows = read_run(tmp_path / "merged").rows
    paths = list(paths_to(rows))
    assert [i for i, path in enumerate(paths) if path is None] == [0, 9]
    assert any(len(path) > 2 for path in paths if path is not None)
    lengths = [
        0.0 if path is None else np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        for path in paths
    ]
    np.testing.assert_allclose(np.cumsum(lengths), [row.metres for row in rows], atol=1e-4)


@pytest.mark.parametrize("name", quick_and_full(MOTIONS, ["gimbal"]))
def test_no_frame_on_the_way_leaves_free_space_or_what_its_motion_allows(tmp_path, name):
    motion = replace(MOTIONS[name], body=0.0)
    policy = make_policy(
        "random", num_candidates=8, num_frontier=0, radius=1.5, motion=motion, scoring=SCORING
    )
    config = replace(PANORAMA, capture_every=0.15)
    record(tmp_path / "run", policy, config, "views:5")
    run = read_run(tmp_path / "run")
    grids = [planner.grid for planner in states_of(run)]
    assert sum(row.captured for row in run.rows) >= 3
    start = run.rows[0].pose[2, 3]
    low, high = motion.heights_from(float(start))
    for leg in legs_of(run.rows):
        free, origin = np.asarray(grids[leg[0].step].free), np.asarray(grids[0].origin)
        for before, row in pairwise(leg):
            cell = tuple(
                np.floor((row.pose[:3, 3] - origin) / float(grids[0].cell_size)).astype(int)
            )
            assert free[cell]  # on what was known when the path was chosen
            assert low - 1e-5 <= row.pose[2, 3] <= high + 1e-5
            elevation = np.degrees(direction_of(row.pose)[1])
            assert motion.elevations[0] - 1e-3 <= elevation <= motion.elevations[1] + 1e-3
            turned = np.degrees(angle_between(np.float64(before.pose), np.float64(row.pose)))
            if motion.turn_rate is not None:
                assert turned <= motion.turn_rate * row.charged["flight"] + 0.1
            if motion.turn_per_meter is not None:
                straight = np.linalg.norm(row.pose[:3, 3] - before.pose[:3, 3])
                assert turned <= motion.turn_per_meter * straight + 0.1


def test_views_are_those_that_were_chosen_and_frames_are_all(result):
    assert len(wander(budget="frames:7").rows) == 7
    by_time = wander(budget="seconds:3")
    late = by_time.rows[-1]
    assert late.seconds - late.charged["mapping"] <= 3.0
    # A mission that may last longer begins the same way: it flies until the time is over.
    for row, more in zip(by_time.rows, result.rows, strict=False):
        assert to_json(row) == to_json(more)


@pytest.mark.parametrize(
    ("config", "says"),
    [(CONFIG, "after 6 views"), (AHEAD, r"after \d views and \d frames captured while moving")],
)
def test_an_interrupted_run_counts_views_and_frames_apart(config, says):
    simulator = BoxRoom()
    render = simulator.render

    def interrupted(pose):
        if len(simulator.rendered) == 6:
            raise KeyboardInterrupt
        return render(pose)

    simulator.render = interrupted
    result = explore(simulator, Wander(reach=1.2), budget="frames:9", config=config)
    assert re.fullmatch(f"interrupted by the user {says}", result.message)
    if config.captures:
        assert sum(map(int, re.findall(r"\d", result.message))) == 6


@pytest.mark.parametrize("look", ["elsewhere", "behind the loop's back"])
def test_no_policy_sees_more_because_frames_are_captured(look):
    with pytest.raises(OracleReadError):
        explore(BoxRoom(), Cheat(look=look, reach=1.2), budget="views:3", config=AHEAD)


def test_each_frame_is_taken_once_where_the_loop_says():
    simulator = BoxRoom()
    rows = explore(simulator, Wander(reach=1.2), budget="frames:6", config=AHEAD).rows
    assert len(simulator.rendered) == 6
    for T, row in zip(simulator.rendered, rows, strict=True):
        np.testing.assert_array_equal(np.float32(T), row.pose)
