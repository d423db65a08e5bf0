"""Candidates lie where they may, look where they should, and depend on their key alone."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.planning.candidates import (
    candidates_along,
    in_plain_view,
    local_random,
    path_lengths,
    poses_along,
    random_directions,
    region_of_interest,
    spread,
)
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, two_rooms

KEY = jax.random.key(7)


@pytest.fixture(scope="module")
def travel():
    return plan_travel(grid_of(*two_rooms()), center(6, 5, 4) + 0.03)


def cells_of(positions: np.ndarray) -> np.ndarray:
    return np.floor((positions - ORIGIN) / CELL).astype(int)


def test_local_positions_are_near_safe_reachable_and_distinct(travel):
    positions = local_random(travel, 400, 0.5, key=KEY)
    assert positions.shape == (400, 3)
    assert np.linalg.norm(positions - travel.start, axis=1).max() <= 0.5
    assert travel.goals[tuple(cells_of(positions).T)].all()
    assert np.all(np.isfinite(travel.lengths(positions)))
    assert len(np.unique(positions, axis=0)) > 300


def test_local_positions_are_uniform_over_the_cells(travel):
    positions = local_random(travel, 20000, 0.5, key=KEY)
    cells = np.argwhere(travel.goals)
    near = np.linalg.norm(travel.centers(cells) - travel.start, axis=1) <= 0.5
    drawn, counts = np.unique(cells_of(positions), axis=0, return_counts=True)
    assert len(drawn) == near.sum()
    expected = 20000 / near.sum()
    assert np.all(np.abs(counts - expected) < 6 * np.sqrt(expected))


def test_a_robot_that_cannot_move_stays_exactly_where_it_is():
    free = np.zeros((9, 9, 9), bool)
    free[3:6, 3:6, 4] = True  # free, but too tight for the margin
    start = center(4, 4, 4) + 0.07
    tight = plan_travel(grid_of(free), start)
    np.testing.assert_array_equal(local_random(tight, 5, 0.5, key=KEY), np.tile(start, (5, 1)))
    nowhere = plan_travel(grid_of(np.zeros((9, 9, 9), bool)), start)
    assert local_random(nowhere, 5, 0.5, key=KEY).shape == (0, 3)


def test_regions_of_interest_are_in_plain_view(travel):
    targets = np.zeros(travel.free.shape, bool)
    targets[22:24, 1:13, 1:9] = True  # the far end of the other room
    targets &= travel.free
    positions, aims = region_of_interest(travel, targets, 30, key=KEY)
    assert 20 <= len(positions) <= 30
    assert targets[tuple(cells_of(aims).T)].all()
    assert travel.goals[tuple(cells_of(positions).T)].all()
    distance = np.linalg.norm(positions - aims, axis=1)
    assert np.all((distance > 0.2) & (distance < 2.1))
    assert all(in_plain_view(travel, a, b) for a, b in zip(positions, aims, strict=True))


def test_a_target_is_looked_at_from_the_nearest_cells_alike(travel):
    """Against the definition over all cells: of the 256 nearest, those 0.3 m away or more."""
    target = np.array([6, 12, 4])  # by the wall: its nearest 256 reach beyond 0.8 m
    targets = np.zeros(travel.free.shape, bool)
    targets[tuple(target)] = True
    stops = np.argwhere(travel.goals)
    distance = np.linalg.norm(stops - target, axis=1) * CELL
    limit = np.sort(distance)[255]
    assert limit < 2.0
    positions, _ = region_of_interest(travel, targets, 4000, key=KEY)
    drawn, counts = np.unique(cells_of(positions), axis=0, return_counts=True)
    far = np.linalg.norm(drawn - target, axis=1) * CELL
    assert far.min() >= 0.3
    assert far.max() <= limit + 1e-9
    is_sure = (distance >= 0.3) & (distance < limit - 1e-9)
    in_view = [in_plain_view(travel, center(*c), center(*target)) for c in stops[is_sure]]
    missed = set(map(tuple, stops[is_sure][in_view])) - set(map(tuple, drawn))
    assert not missed
    assert counts.max() < 6 * counts.mean()


def test_no_region_of_interest_gives_no_position(travel):
    nothing = np.zeros(travel.free.shape, bool)
    for num in (0, 10):
        positions, aims = region_of_interest(travel, nothing, num, key=KEY)
        assert positions.shape == aims.shape == (0, 3)
    behind = nothing.copy()
    behind[0, 0, 0] = True  # inside a wall: near enough, but never in plain view
    assert len(region_of_interest(travel, behind, 10, key=KEY)[0]) == 0


def test_directions_cover_the_sphere_evenly():
    directions = random_directions(4000, key=KEY)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(directions.mean(0), 0.0, atol=0.05)
    np.testing.assert_allclose(directions.T @ directions / 4000, np.eye(3) / 3, atol=0.02)


def test_poses_look_along_their_direction_without_roll():
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(6, 3))
    directions = np.concatenate([rng.normal(size=(4, 3)), [[0, 0, 2.0], [0, 0, -1.0]]])
    poses = poses_along(positions, directions)
    np.testing.assert_array_equal(poses[:, :3, 3], positions)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(poses[:, :3, 2], unit, atol=1e-6)
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-6)  # the image's x axis is level
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-5)


def test_padding_repeats_views_and_has_no_path(travel):
    positions = np.stack([center(6, 5, 4), center(8, 5, 4)])
    drawn = candidates_along(positions, np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    padded = drawn.padded(5)
    assert padded.valid.tolist() == [True, True, False, False, False]
    assert padded.num_valid == 2
    np.testing.assert_array_equal(padded.position, positions[[0, 1, 0, 1, 0]])
    np.testing.assert_allclose(padded.axis, [[1, 0, 0], [0, 0, 1]] * 2 + [[1, 0, 0]])
    np.testing.assert_array_equal(padded.padded(3).valid, padded.valid[:3])
    lengths = path_lengths(travel, padded)
    np.testing.assert_allclose(lengths[:2], travel.lengths(positions))
    assert np.isinf(lengths[2:]).all()


def test_matrices_are_those_of_the_lines_of_sight():
    rng = np.random.default_rng(1)
    drawn = candidates_along(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
    poses = drawn.T_world_camera
    np.testing.assert_array_equal(poses[:, :3, 3], drawn.position)
    np.testing.assert_allclose(poses[:, :3, 2], drawn.axis, atol=1e-6)
    np.testing.assert_array_equal(drawn.poses_on_device(), poses.astype(np.float32))


def test_the_same_key_draws_the_same_candidates(travel):
    first, again = (local_random(travel, 20, key=KEY) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = local_random(travel, 20, key=jax.random.fold_in(KEY, 1))
    assert not np.array_equal(first, other)
    raw = local_random(travel, 20, key=jax.random.key_data(KEY))
    np.testing.assert_array_equal(first, raw)


@given(st.integers(0, 500), st.integers(1, 12))
def test_spread_takes_distinct_places_and_each_the_farthest(seed, num):
    rng = np.random.default_rng(seed)
    places = rng.integers(0, 5, (int(rng.integers(1, 20)), 3)).astype(float)
    chosen = spread(places, num)
    assert len(set(chosen.tolist())) == len(chosen) <= num
    assert len(chosen) == min(num, len(np.unique(places, axis=0)))
    for k in range(1, len(chosen)):
        gap = np.linalg.norm(places[:, None] - places[chosen[:k]][None], axis=-1).min(axis=1)
        assert gap[chosen[k]] == gap.max()
