"""The search of paths against all paths, worked out on the whole map, and ways between places."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.planning.candidates import best_views, candidates_at, poses_along
from r3jax.planning.policies import r3_ahead as real
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.motion import Motion
from r3jax.planning.robot.travel import plan_travel
from r3jax.scoring.batch import cache_positions_near, score_positions
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.panorama import panorama
from tests.planning.known_hall import CAMERA, CONFIG, SCORING, after_view, for_scoring
from tests.planning.rooms import candidates_of, center, grid_of, two_rooms

PLACES = np.array([[1.0, 0.9, 1.2], [1.9, 0.9, 1.2], [1.0, 1.8, 1.2], [1.9, 1.7, 1.2]])
"""Each 0.7 m or more from the others."""

AHEAD = real.AheadConfig(**vars(CONFIG))
WIDE = dataclasses.replace(AHEAD, horizon=3, beam=100, branching=len(PLACES) + 1)


def outlook_of(config: real.AheadConfig, view_seconds: float = 1.0) -> real.BeamProblem:
    """The places, seen from the first one; ways are straight."""
    state, grid = for_scoring()
    panoramas = score_positions(state, grid, CAMERA, PLACES, SCORING)
    views, utility = best_views(candidates_at(PLACES), panoramas)
    gap = np.linalg.norm(PLACES[:, None] - PLACES, axis=2)
    config = dataclasses.replace(config, view_seconds=view_seconds)
    start, places = at_hand(), jnp.asarray(PLACES, jnp.float32)
    _, kept = cache_positions_near(*start, CAMERA, places, SCORING)
    return real.BeamProblem(views, utility, gap[0], gap, kept, start, CAMERA, config)


def at_hand():
    state, grid = for_scoring()
    voxels, cells, _ = gather_in_range(state, grid, jnp.asarray(PLACES, jnp.float32), SCORING)
    return voxels, cells


def all_paths(problem: real.BeamProblem, horizon: int) -> dict[tuple[int, ...], float]:
    """The rate of every path, each view on the whole map as it is after those before it."""
    rates, worlds = {}, {(): (for_scoring(), 0.0, 0.0)}
    for length in range(1, horizon + 1):
        for path in itertools.product(range(len(PLACES)), repeat=length):
            world, gained, seconds = worlds[path[:-1]]
            place = jnp.asarray(PLACES[path[-1]], jnp.float32)
            view = panorama(*world, CAMERA, place, SCORING)
            way = problem.between[path[-2], path[-1]] if length > 1 else problem.lengths[path[-1]]
            gained = gained + float(view.best_score)
            seconds = seconds + way + problem.config.view_seconds
            worlds[path] = (after_view(world, view.T_world_camera), gained, seconds)
            if length == horizon:
                rates[path] = gained / seconds
    return rates


@pytest.mark.full
def test_a_beam_with_room_for_all_finds_the_best_path():
    """With room for all of them, the search finds the best path of three views."""
    problem = outlook_of(WIDE)
    found = real.search(problem)
    rates = all_paths(problem, 3)
    best = max(rates, key=lambda path: rates[path])
    assert found[0].places == best
    for path in found[:20]:
        assert path.rate == pytest.approx(rates[path.places], rel=1e-4)
    assert found[0].rate > 1.02 * rates[0, 0, 0]  # or it did not matter where it went
    assert [p.rate for p in found] == sorted((p.rate for p in found), reverse=True)


@pytest.mark.full
def test_a_narrow_beam_keeps_its_promise():
    """Not the best path, perhaps, but its rate is true, and views never add less than nothing."""
    problem = outlook_of(dataclasses.replace(AHEAD, horizon=3, beam=2, branching=5))
    rates = all_paths(problem, 3)
    found = real.search(problem)
    assert len(found) == 2
    for path in found:
        assert path.rate == pytest.approx(rates[path.places], rel=1e-4)
        assert min(path.gains) >= 0.0
    assert found[0].rate >= 0.9 * max(rates.values())


@pytest.mark.full
def test_a_horizon_of_one_is_the_next_best_view():
    """A horizon of one is the next-best view, by gain over time."""
    problem = outlook_of(dataclasses.replace(WIDE, horizon=1), view_seconds=0.3)
    found = real.search(problem)
    rate = problem.utility / (0.3 + problem.lengths)
    assert found[0].places == (int(np.argmax(rate)),)
    assert found[0].rate == pytest.approx(rate.max())


@pytest.mark.full
def test_a_carrier_takes_its_time():
    """A slow level camera: the seconds of every path by hand, and no view that it cannot take."""
    motion = Motion(elevations=(0.0, 0.0), speed=0.2, turn_rate=45.0)
    start = poses_along(PLACES[:1], np.array([[0.0, 1.0, 0.0]]))[0]
    limits = Limits(motion, start)
    flying = outlook_of(dataclasses.replace(WIDE, horizon=2), view_seconds=0.3)
    problem = dataclasses.replace(
        flying, views=limits.project_to_feasible(flying.views), limits=limits
    )
    found = real.search(problem)
    assert len(found) > 10
    for path in found:
        seconds, here, place = 0.0, start, None
        poses = poses_along(PLACES[list(path.places)], np.stack(path.directions))
        for number, pose in zip(path.places, poses, strict=True):
            way = flying.lengths[number] if place is None else flying.between[place, number]
            turn = Rotation.from_matrix(here[:3, :3].T @ pose[:3, :3]).magnitude()
            seconds += 0.3 + way / 0.2 + np.degrees(turn) / 45.0
            assert abs(pose[2, 2]) < 1e-6
            here, place = pose, number
        assert path.seconds == pytest.approx(seconds, abs=0.01)


def test_choices_lie_apart():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1, 0, 3] = 0.1  # as good as the first
    poses[2, 0, 3] = 0.75
    poses[3, :3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # turned by 90 degrees
    apart = real._apart
    views = candidates_of(poses)
    assert apart([1, 0, 2, 3], views, (), 4) == [1, 3]
    assert apart([0, 1, 2, 3], views, (), 4) == [0, 2, 3]
    assert apart([0, 1, 2, 3], views, (), 2) == [0, 2]
    third = views.position[2], views.direction[2]
    assert apart([0, 1, 2, 3], views, (third,), 4) == [0, 3]


@pytest.mark.full
def test_no_way_no_path():
    problem = dataclasses.replace(outlook_of(WIDE), lengths=np.full(len(PLACES), np.inf))
    assert real.search(problem) == []


@given(st.integers(0, 1000))
@settings(max_examples=10)
def test_ways_between_places_are_ways(seed):
    """Symmetric, no shorter than the shortest, no longer than back past the robot."""
    rng = np.random.default_rng(seed)
    travel = plan_travel(grid_of(*two_rooms()), center(6, 5, 4))
    cells = np.argwhere(travel.goals)
    positions = travel.centers(cells[rng.choice(len(cells), 12, replace=False)])
    between = real.lengths_between(travel, positions)
    own = travel.lengths(positions)
    np.testing.assert_allclose(between, between.T)
    np.testing.assert_array_equal(np.diag(between), 0.0)
    assert (between <= own[:, None] + own[None] + 1e-9).all()
    for i in range(3):
        other = plan_travel(grid_of(*two_rooms()), positions[i])
        straight = np.linalg.norm(positions - positions[i], axis=1)
        assert (between[i] >= straight - 1e-9).all()
        # Ways over cells turn by 45 degrees: up to 13 % longer than a free one.
        assert (between[i] >= other.lengths(positions) / 1.14 - 0.2).all()


def test_ways_between_rooms_lead_through_the_door():
    travel = plan_travel(grid_of(*two_rooms()), center(6, 5, 4))
    ends = np.stack([center(10, 11, 4), center(14, 11, 4)])  # either side of the wall
    between = real.lengths_between(travel, ends)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.8)
    assert between[0, 1] > 1.6
