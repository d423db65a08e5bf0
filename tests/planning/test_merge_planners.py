"""Robots that have mapped parts of a building join: their map is the merge of their maps."""

import functools
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

import r3jax
from r3jax.errors import InputError
from r3jax.kernels.constants import LOG_ODDS_LIMIT
from r3jax.planning.planner import at_hand
from tests.mapping.test_tiles import assert_same_map, sorted_rows
from tests.planning.test_far import CAMERA, CONFIG, a_policy
from tests.rooms_of_boxes import frame_in_room, pose_at

SIDE, NUM = 16.0, 4
ROOMS = np.array([[0.0, 0.0, 0.0], [SIDE, SIDE, 2.6]])
"""4 x 4 rooms of 4 m."""
KEEPS = replace(CONFIG, remove_moved=False)


def walls() -> list[np.ndarray]:
    """Walls between the rooms, each with a door in its middle."""
    found = []
    for line in (4.0, 8.0, 12.0):
        for room in (0.0, 4.0, 8.0, 12.0):
            for begin, end in ((0.0, 1.5), (2.5, 4.0)):
                low, high = [line - 0.05, room + begin, 0.0], [line + 0.05, room + end, 2.6]
                found.append(np.array([low, high]))
                found.append(found[-1][:, [1, 0, 2]])
    return found


def frames_of(part: int) -> list[r3jax.Frame]:
    """A robot's walk through a row of rooms, and into one of its neighbor's."""
    rng, frames = np.random.default_rng(part), []
    line = [(2.0 + 4.0 * x, 2.0 + 4.0 * part) for x in (range(4) if part % 2 else range(3, -1, -1))]
    for x, y in [*line, (line[-1][0], 2.0 + 4.0 * ((part + 1) % NUM))]:
        for yaw in (0.0, 90.0, 180.0, 270.0):
            place = [x + rng.uniform(-0.5, 0.5), y + rng.uniform(-0.5, 0.5), 1.3]
            pose = pose_at(place, yaw + rng.uniform(-20, 20), rng.uniform(-15, 15))
            seed = int(rng.integers(99))
            frames.append(frame_in_room(CAMERA, pose, walls(), 0.004, seed, ROOMS))
    return frames


def mapped(frames: list[r3jax.Frame], config=KEEPS, **folder) -> r3jax.Planner:
    """Starts at the first frame, and observes all."""
    pose = frames[0].T_world_camera
    planner = r3jax.start(CAMERA, policy=a_policy(), starts=[pose], config=config, **folder)
    for frame in frames:
        planner = r3jax.observe(planner, frame)
    return planner


PROCESS = """
import sys
from tests.planning import test_merge_planners as t
import r3jax
part, folder = int(sys.argv[1]), sys.argv[2]
planner = t.mapped(t.frames_of(part), tile_folder=folder + "/scratch", tile_memory=0)
r3jax.save(planner, f"{folder}/robot{part}")
"""


@pytest.mark.full
def test_four_processes_map_one_building_and_join(tmp_path):
    """They share a tile folder while they map; whoever joins them holds no tile in memory."""
    words = [sys.executable, "-c", PROCESS]
    running = [subprocess.Popen([*words, str(part), str(tmp_path)]) for part in range(NUM)]
    assert [process.wait() for process in running] == [0] * NUM
    assert not list((tmp_path / "scratch").rglob("*.tile"))
    robots = [
        r3jax.load(tmp_path / f"robot{part}", tile_folder=tmp_path / "scratch", tile_memory=0)
        for part in range(NUM)
    ]
    joined = r3jax.merge_planners(robots)
    assert not joined.far.tiles.voxels.memory
    larger = r3jax.grow(robots[0].whole_map, joined.whole_map.capacity)
    num = [int(robot.whole_map.num_present) for robot in robots]
    total = int(joined.whole_map.num_present)
    assert max(num) < total < 0.95 * sum(num)  # they overlap
    merged = functools.reduce(r3jax.merge, [larger, *(robot.whole_map for robot in robots[1:])])
    assert_same_map(joined.whole_map, merged)

    # Against one robot that has seen all: what pixels have measured, up to rounding. Marks of views
    # on voxels that only another robot knew then are missing.
    one = sorted_rows(mapped([frame for part in range(NUM) for frame in frames_of(part)]).whole_map)
    rows = sorted_rows(joined.whole_map)
    for name in ("key", "count"):
        np.testing.assert_array_equal(rows[name], one[name], err_msg=name)
    np.testing.assert_allclose(rows["mean"], one["mean"], atol=1e-5)
    np.testing.assert_allclose(rows["m2"], one["m2"], atol=1e-4)
    assert not np.any(rows["visited"] & ~one["visited"])
    assert np.all(rows["resolution"] <= one["resolution"])
    assert np.mean(rows["visited"] == one["visited"]) > 0.9

    # The joined planner goes on, and is saved with tiles that others wrote.
    pose = np.asarray(frames_of(0)[-1].T_world_camera, np.float64)
    decision, _, info = r3jax.decide(joined, pose, jax.random.key(0))
    assert decision is not None, info.reason
    r3jax.save(joined, tmp_path / "building")
    again = r3jax.load(tmp_path / "building")
    assert_same_map(again.whole_map, joined.whole_map)
    same = r3jax.decide(again, pose, jax.random.key(0))[0]
    np.testing.assert_array_equal(same.T_world_camera, decision.T_world_camera)


@pytest.mark.full
def test_cells_add_up_and_the_given_planners_stay():
    """Against the cells of each planner, moved to one block."""
    robots = [mapped(frames_of(part)[:10], CONFIG) for part in (0, 1)]
    before = [sorted_rows(robot.whole_map) for robot in robots]
    joined = r3jax.merge_planners(robots)
    for position in ([2.0, 2.0, 1.3], [14.0, 6.0, 1.3]):
        grids = [np.asarray(at_hand(p, np.array(position)).grid.log_odds) for p in robots]
        found = np.asarray(at_hand(joined, np.array(position)).grid.log_odds)
        total = np.clip(sum(grids), -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)
        np.testing.assert_array_equal(found, total)
        assert found.any()
    for robot, rows in zip(robots, before, strict=True):
        for name, x in sorted_rows(robot.whole_map).items():
            np.testing.assert_array_equal(x, rows[name])


def test_what_a_policy_remembers_of_cells_is_that_of_all():
    planners = []
    for part in (0, 1):
        start = pose_at([2.0, 2.0, 1.3], 0.0, 0.0)
        planner = r3jax.start(CAMERA, policy=a_policy("frontier"), starts=[start], config=KEEPS)
        marks = np.zeros_like(planner.policy_state.memory)
        marks[part, :2] = True
        state = replace(planner.policy_state, memory=marks)
        planners.append(replace(planner, policy_state=state))
    both = r3jax.merge_planners(planners).policy_state.memory
    assert both.dtype == bool
    assert np.argwhere(both.any(axis=2)).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]


def test_planners_that_do_not_fit_are_refused():
    first = r3jax.start(CAMERA, policy=a_policy(), config=CONFIG)
    with pytest.raises(InputError, match="at least one"):
        r3jax.merge_planners([])
    with pytest.raises(TypeError, match="Planner"):
        r3jax.merge_planners([first.map_state])
    whole = r3jax.start(CAMERA, ROOMS, a_policy(), config=CONFIG)
    with pytest.raises(InputError, match=r"r3jax\.merge"):
        r3jax.merge_planners([first, whole])
    other = r3jax.start(CAMERA, policy=a_policy(), config=replace(CONFIG, voxel_size=0.05))
    half = np.array([[-99.0] * 3, [np.inf] * 3])
    wide = r3jax.Camera.from_fov(48, 36, 85.0)
    for second, match in (
        (other, "MappingConfig"),
        (r3jax.start(wide, policy=a_policy(), config=CONFIG), "camera"),
        (r3jax.start(CAMERA, half, a_policy(), config=CONFIG), "bounds"),
    ):
        with pytest.raises(InputError, match=f"planners 0 and 1.*{match}"):
            r3jax.merge_planners([first, second])
