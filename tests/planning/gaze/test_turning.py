"""Where the camera looks on its way: turns by hand, laws of what is feasible, plans against all."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.geometry.cameras import pose_along
from r3jax.planning.gaze.gaze_plan import _nodes, plan_gaze
from r3jax.planning.gaze.turning import (
    Turning,
    along,
    axes_within,
    direction_of,
    panorama_scores,
    pose_towards,
    turn,
    worthwhile_grid,
)
from r3jax.scoring.panorama import panorama
from tests.planning.known_hall import CAMERA, SCORING, after_view, for_scoring
from tests.planning.rooms import center, grid_of, two_rooms

ANYWHERE = (-0.5 * np.pi, 0.5 * np.pi)
PLACES = np.array([[1.0, 0.9, 1.2], [1.3, 0.95, 1.2], [1.6, 1.0, 1.2]])


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
    half = Turning(first, second, np.ones(2), ANYWHERE).at_share(0.5)
    np.testing.assert_allclose(np.degrees(half), [180.0, 10.0])


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


@given(st.integers(0, 10**6), st.sampled_from(["wanted", "score", "evenly"]))
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
        elif how == "score":
            _, directions = axes_within(elevations)
            chain.append(turning.best(piece, chain[-1], directions, rng.random(len(directions))))
        else:
            chain.append(turning.evenly()[piece])
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


def chain_gain(places, chain, numbers):
    """What a chain adds, on the whole map: each view after those before it."""
    world, total = for_scoring(), 0.0
    for place, direction, number in zip(places, chain, numbers, strict=True):
        at = jnp.asarray(place, jnp.float32)
        total += float(panorama(*world, CAMERA, at, SCORING).direction_scores[number])
        T = jnp.asarray(pose_towards(place, direction), jnp.float32)
        world = after_view(world, T)
    return total


def best_of_all(turning, places, width):
    """Exhaustive search over the same directions."""
    state, grid = for_scoring()
    nodes = [
        _nodes(turning, panorama_scores(state, grid, CAMERA, place, SCORING), evenly, width)
        for place, evenly in zip(places, turning.evenly(), strict=False)
    ]
    best, found = -np.inf, None
    for chain in itertools.product(range(width), repeat=len(places)):
        directions = [node.directions[i] for node, i in zip(nodes, chain, strict=True)]
        ways = itertools.pairwise([turning.start, *directions, turning.end])
        if any(
            turn(a, b) > most + 1e-6 for (a, b), most in zip(ways, turning.allowed, strict=True)
        ):
            continue
        axes = [node.axes[i] for node, i in zip(nodes, chain, strict=True)]
        gain = chain_gain(places, directions, axes)
        if gain > best:
            best, found = gain, np.stack(directions)
    return best, found


@pytest.mark.full
@pytest.mark.parametrize(
    ("num", "width", "allowed"),
    [
        pytest.param(2, 5, np.inf, marks=pytest.mark.slow),
        pytest.param(2, 5, 1.0, marks=pytest.mark.slow),
        pytest.param(3, 4, np.inf, marks=pytest.mark.slow),
        (3, 4, 1.0),
    ],
)
def test_a_plan_is_the_best_of_all_chains(num, width, allowed):
    """Exact for two frames; for three the best chain to each direction is kept: hardly less."""
    turning = Turning(np.zeros(2), np.array([1.2, 0.0]), np.full(num + 1, allowed), ANYWHERE)
    places = PLACES[:num]
    state, grid = for_scoring()
    plan = plan_gaze(state, grid, CAMERA, places, turning, SCORING, width)
    best, found = best_of_all(turning, places, width)
    assert plan.gain <= best * (1.0 + 1e-4)
    assert plan.gain >= best * (1.0 - (1e-4 if num == 2 else 0.03))
    if num == 2:
        np.testing.assert_allclose(plan.directions, found, atol=1e-6)
    ways = itertools.pairwise([turning.start, *plan.directions, turning.end])
    assert all(turn(a, b) <= allowed + 1e-6 for a, b in ways)


@pytest.mark.full
def test_a_plan_looks_at_what_the_frame_before_has_left():
    """Two frames from one place: greedy by their own worth would look twice at the same."""
    turning = Turning(np.zeros(2), np.zeros(2), np.full(3, np.inf), ANYWHERE)
    state, grid = for_scoring()
    plan = plan_gaze(state, grid, CAMERA, PLACES[[0, 0]], turning, SCORING, 8)
    assert turn(*plan.directions) > np.radians(20.0)
