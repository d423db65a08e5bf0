"""Where the camera looks on its way: turns by hand, laws of what is feasible."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.geometry.cameras import pose_along
from r3jax.planning.turning import (
    Turning,
    along,
    axes_within,
    direction_of,
    pose_towards,
    turn,
    worthwhile_grid,
)
from tests.planning.rooms import center, grid_of, two_rooms

ANYWHERE = (-0.5 * np.pi, 0.5 * np.pi)


@given(st.integers(0, 10**6))
@settings(max_examples=30)
def test_a_pose_has_the_direction_that_it_was_made_of(seed):
    rng = np.random.default_rng(seed)
    direction = np.array([rng.uniform(-np.pi, np.pi), rng.uniform(*ANYWHERE)])
    pose = pose_towards(rng.normal(size=3), direction)
    np.testing.assert_allclose(direction_of(pose), direction, atol=1e-9)
    like = pose_along(jnp.asarray(pose[:3, 3]), jnp.asarray(pose[:3, 2]))
    np.testing.assert_allclose(pose, like, atol=1e-4)
    other = pose_towards(np.zeros(3), np.array([rng.uniform(-9, 9), rng.uniform(*ANYWHERE)]))
    rotation = Rotation.from_matrix(pose[:3, :3].T @ other[:3, :3]).magnitude()
    assert turn(direction, direction_of(other)) >= rotation - 1e-9


def test_a_turn_goes_round_the_shorter_side():
    """From 170 to -170 degrees it is 20, by hand; and 20 up makes it the hypotenuse."""
    first, second = np.radians([170.0, 0.0]), np.radians([-170.0, 20.0])
    assert np.degrees(turn(first, second)) == pytest.approx(np.hypot(20.0, 20.0))


def test_no_look_is_feasible_that_would_make_the_camera_late():
    """Pieces of 30, 30 and 60 degrees; the end is 90 to the left: 30 to the right is too far."""
    allowed = np.radians([30.0, 30.0, 60.0])
    turning = Turning(np.zeros(2), np.radians([90.0, 0.0]), allowed, ANYWHERE)
    directions = np.radians([[0.0, 0.0], [30.0, 0.0], [31.0, 0.0], [-1.0, 0.0], [10.0, 20.0]])
    np.testing.assert_array_equal(turning.feasible(0, np.zeros(2), directions), [1, 1, 0, 0, 1])
    # Once it has turned by 30 it must be at 30 or beyond after the next piece.
    now = np.radians([30.0, 0.0])
    directions = np.radians([[29.0, 0.0], [30.0, 0.0], [60.0, 0.0], [61.0, 0.0]])
    np.testing.assert_array_equal(turning.feasible(1, now, directions), [0, 1, 1, 0])
    assert turning.is_possible
    assert not Turning(np.zeros(2), np.radians([121.0, 0.0]), allowed, ANYWHERE).is_possible


@given(st.integers(0, 10**6), st.sampled_from(["wanted", "score"]))
@settings(max_examples=60)
def test_every_chain_of_looks_keeps_to_the_turning_rate_and_arrives(seed, how):
    rng = np.random.default_rng(seed)
    elevations = tuple(np.radians([(-90.0, 90.0), (-60.0, 30.0), (0.0, 0.0)][seed % 3]))
    start, end = (
        np.array([rng.uniform(-np.pi, np.pi), rng.uniform(*elevations)]) for _ in range(2)
    )
    allowed = rng.uniform(0.1, 0.6, 5)
    allowed[-1] += float(turn(start, end))
    turning = Turning(start, end, allowed, elevations)
    assert turning.is_possible
    chain = [start]
    for piece in range(4):
        if how == "wanted":
            wanted = np.array([rng.uniform(-np.pi, np.pi), rng.uniform(*ANYWHERE)])
            chain.append(turning.nearest(piece, chain[-1], wanted))
        else:
            _, directions = axes_within(elevations)
            chain.append(turning.best(piece, chain[-1], directions, rng.random(len(directions))))
    for piece, (before, after) in enumerate(itertools.pairwise([*chain, end])):
        assert turn(before, after) <= allowed[piece] + 2e-6
        assert elevations[0] - 1e-9 <= after[1] <= elevations[1] + 1e-9


def test_the_nearest_look_is_the_wanted_one_if_there_is_time():
    turning = Turning(np.zeros(2), np.zeros(2), np.full(3, np.inf), ANYWHERE)
    wanted = np.array([2.0, -0.4])
    np.testing.assert_allclose(turning.nearest(0, np.zeros(2), wanted), wanted)
    slow = Turning(np.zeros(2), wanted, np.array([0.2, 9.0]), ANYWHERE)
    reached = slow.nearest(0, np.zeros(2), wanted)
    np.testing.assert_allclose(reached, 0.2 * wanted / np.linalg.norm(wanted), atol=1e-6)


def test_axes_of_a_level_camera_are_level():
    numbers, directions = axes_within((0.0, 0.0))
    assert 20 < len(numbers) < 80
    assert not directions[:, 1].any()
    assert len(axes_within(ANYWHERE)[0]) == 526


def test_a_vertical_path_leaves_the_azimuth():
    now = np.array([0.7, 0.1])
    np.testing.assert_allclose(along(np.array([0.0, 0.0, 2.0]), now), [0.7, 0.5 * np.pi])
    np.testing.assert_allclose(along(np.array([0.0, 1.0, 1.0]), now), np.radians([90.0, 45.0]))


def test_cells_that_nobody_can_look_at_or_did_in_vain_do_not_count():
    free, _ = two_rooms()
    free[2:4, 2:4, 2:4] = False  # unexplored, in the middle of the room
    walls = np.zeros_like(free)
    walls[12], walls[12, 4:9, 1:8] = True, False
    grid = grid_of(free, walls)
    exhausted = np.zeros_like(free)
    exhausted[2:4, 2:4, 2] = True
    left = np.asarray(worthwhile_grid(grid, center(6, 6, 4)[None], exhausted).unexplored)
    assert left[2:4, 2:4, 3].all()
    assert not left[2:4, 2:4, 2].any()
    nowhere = worthwhile_grid(grid, center(12, 1, 1)[None], None)  # in a wall
    assert not np.asarray(nowhere.unexplored).any()
