"""Candidates that climb: never worse, never colliding, within limits, and near the best there is.

The flat is half known; the utility is worked out again on the whole map.
"""

import dataclasses
import functools
import itertools
from unittest import mock

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning import refine
from r3jax.planning.candidates import Candidates, candidates_along, path_lengths, poses_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import net_utility
from r3jax.planning.policy import Situation
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.motion import MOTIONS, Motion
from r3jax.planning.robot.travel import Travel, plan_travel
from r3jax.scoring.batch import score_views
from r3jax.scoring.config import ScoringConfig
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, known_flat
from tests.planning.walls import SEEN_FROM, VOXEL, box, wall

NUM, REFINED = 12, 3  # one shape: one compile
CAMERA = Camera.from_fov(48, 48, 60.0)
SCORING = ScoringConfig(max_range=4.0, zbuffer_size=48, panorama_size=64)
EYE = center(6, 6, 4)
"""Where the robot is [m]."""

CONFIG = PlannerConfig(
    num_candidates=NUM, num_frontier=0, refine=REFINED, refine_radius=0.3, scoring=SCORING
)
SHAPE = (9, 8, 7)
seeds = st.integers(0, 10_000)
motions = st.sampled_from(list(MOTIONS.values()))


def situation_of(motion: Motion) -> Situation:
    """A robot in the first room that looks along x."""
    state, grid = known_flat()
    start = poses_along(EYE[None], np.array([[1.0, 0.0, 0.0]]))[0]
    heights = motion.heights_from(float(EYE[2]))
    travel = plan_travel(grid, EYE, heights=heights)
    limits = Limits(motion, start, heights)
    masked = mask_unexplorable(grid, travel.reachable)
    return Situation(state, grid, masked, travel, CAMERA, None, limits)


def candidates(where: Situation, seed: int, *, poor: bool = False) -> Candidates:
    """From stops, to anywhere, or poorly to the floor, as far as the robot may turn."""
    rng = np.random.default_rng(seed)
    stops = where.travel.stops(np.argwhere(where.travel.safe & where.travel.reachable))
    places = stops[rng.integers(len(stops), size=NUM)]
    places[:, :2] += rng.uniform(-0.05, 0.05, (NUM, 2))
    directions = rng.normal(size=(NUM, 3))
    directions = 0.1 * directions - np.array([0.0, 0.0, 1.0]) if poor else directions
    return where.limits.project_to_feasible(candidates_along(places, directions))


def utility_of(where: Situation, views: Candidates) -> np.ndarray:
    poses = views.poses_on_device()
    scores = score_views(where.map_state, where.scoring_grid, CAMERA, poses, SCORING)
    return np.asarray(scores.total, np.float64)


def paths_of(where: Situation, views: Candidates) -> np.ndarray:
    return where.limits.path_costs(path_lengths(where.travel, views), views.direction)


def law_never_worse(where: Situation, poses: Candidates, config: PlannerConfig = CONFIG) -> None:
    """What is replaced is better, alone and net of the path, and is one of the best few."""
    before, path = utility_of(where, poses), paths_of(where, poses)
    after, found = refine.refine_best(where, poses, {"utility": before}, config)
    moved = np.any(after.position != poses.position, axis=1)
    is_new = moved | np.any(after.direction != poses.direction, axis=1)
    exact = utility_of(where, after)
    np.testing.assert_allclose(found["utility"], exact, rtol=1e-5)
    np.testing.assert_array_equal(found["utility"][~is_new], before[~is_new])
    assert np.all(exact[is_new] > before[is_new])
    weigh = functools.partial(net_utility, lambda2=config.lambda2, among=(before, path))
    assert np.all(weigh(exact, paths_of(where, after))[is_new] > weigh(before, path)[is_new])
    assert set(np.flatnonzero(is_new)) <= set(np.argsort(-weigh(before, path))[:REFINED])


def law_safe(where: Situation, poses: Candidates) -> None:
    """Every view stands in a stop, within reach of its start, and is allowed."""
    after, _ = refine.refine_best(where, poses, {"utility": utility_of(where, poses)}, CONFIG)
    stops = where.travel.safe & where.travel.reachable
    for start, pose in zip(poses.position, after.T_world_camera, strict=True):
        assert stops[where.travel.cell_of(pose[:3, 3])]
        assert np.abs(pose[:3, 3] - start).max() <= CONFIG.refine_radius + 1e-9
        assert rigid_error(pose) is None
        assert abs(pose[2, 0]) < 1e-6  # no roll
    assert np.all(np.isfinite(paths_of(where, after)))
    again = where.limits.project_to_feasible(after)
    np.testing.assert_allclose(again.direction, after.direction, atol=1e-6)
    np.testing.assert_array_equal(again.position, after.position)


@pytest.mark.full
@given(seeds, motions)
@settings(max_examples=12)
def test_no_view_gets_worse_or_collides(seed, motion):
    where = situation_of(motion)
    law_never_worse(where, candidates(where, seed))
    law_safe(where, candidates(where, seed))


@pytest.mark.full
@given(seeds, motions)
@settings(max_examples=12)
def test_where_a_climb_ends_is_checked(seed, motion):
    """The same where a climb ends anywhere, and the path counts for more than the view."""
    where = situation_of(motion)
    rng = np.random.default_rng(seed)

    def stray(*args: np.ndarray) -> np.ndarray:
        positions = np.asarray(args[-3])[:, :3] + rng.uniform(-0.5, 0.5, (REFINED, 3))
        angles = rng.uniform((-np.pi, -1.5), (np.pi, 1.5), (REFINED, 2))
        return np.concatenate([positions, angles], axis=1)

    with mock.patch.object(refine, "_climb", stray):
        for lambda2 in (0.5, 5.0):
            config = dataclasses.replace(CONFIG, lambda2=lambda2)
            law_never_worse(where, candidates(where, seed, poor=True), config)
        law_safe(where, candidates(where, seed, poor=True))


def badly_seen() -> tuple[r3jax.MapState, OccupancyGrid]:
    """A wall seen well from in front; a patch of it only along the wall. Nothing is unexplored."""
    state = wall()
    keys = np.stack([[20, y, z] for y in range(6, 11) for z in range(14, 19)])
    points = np.resize((keys + 0.5) * VOXEL, (625, 3)).astype(np.float32)
    eye = np.array([1.9, -3.0, 1.6], np.float32)
    for _ in range(2):
        state = r3jax.integrate_points(state, points, np.full_like(points, 0.2), eye)
    return state, box(9.0)


@pytest.mark.full
def test_a_climb_comes_near_the_best_of_a_dense_grid():
    """Positions and directions all over the box and round the start, one by one."""
    scoring = ScoringConfig(max_range=4.0, zbuffer_size=32)
    state, grid = badly_seen()
    where = Situation(state, grid, grid, plan_travel(grid, SEEN_FROM), CAMERA, None)
    start = candidates_along(SEEN_FROM[None], np.array([[1.0, 0.0, 0.0]]))
    # Paths cost nothing: the start has none, and every other view would lose by its own.
    config = dataclasses.replace(CONFIG, refine=1, refine_radius=0.4, lambda2=0.0, scoring=scoring)
    score = lambda poses: np.asarray(score_views(state, grid, CAMERA, poses, scoring).total)
    utility = score(start.poses_on_device()).astype(np.float64)
    _, found = refine.refine_best(where, start, {"utility": utility}, config)
    offsets = itertools.product((-0.4, 0.0, 0.4), repeat=3)
    angles = itertools.product(np.radians(np.arange(-30, 31, 6)), np.radians(np.arange(-24, 25, 6)))
    rows = np.array([(*SEEN_FROM + o, *a) for o, a in itertools.product(offsets, angles)])
    level = np.cos(rows[:, 4])
    axes = [level * np.cos(rows[:, 3]), level * np.sin(rows[:, 3]), np.sin(rows[:, 4])]
    best = float(score(poses_along(rows[:, :3], np.stack(axes, axis=1))).max())
    assert best > 1.2 * utility[0]
    assert found["utility"][0] > 0.95 * best


@pytest.mark.full
@pytest.mark.parametrize("name", ["r3", "r3-pano"])
def test_decisions_with_refinement(name):
    """The choice is one of the candidates, and what it was worth before is no more than after."""
    state, grid = known_flat()
    pose = poses_along(EYE[None], np.array([[1.0, 0.0, 0.0]]))[0]
    chosen = {}
    for num in (0, REFINED):
        policy = make_policy(name, refine=num, num_candidates=NUM, num_frontier=0, scoring=SCORING)
        memory = policy.init(CAMERA, grid, key=jax.random.key(0))
        decision, _, _ = policy.decide(memory, state, grid, pose, key=jax.random.key(4))
        gaps = np.abs(decision.candidates - decision.T_world_camera).max(axis=(1, 2))
        assert gaps.min() == 0.0
        chosen[num] = decision
    plain, better = chosen[0], chosen[REFINED]
    is_new = np.any(plain.candidates != better.candidates, axis=(1, 2))
    assert 0 < is_new.sum() <= REFINED
    assert np.all((better.utilities["utility"] > plain.utilities["utility"]) == is_new)
    if name == "r3":
        parts = better.utilities["exploration"] * float(SCORING.lambda1)
        np.testing.assert_allclose(
            parts + better.utilities["rendering"], better.utilities["utility"], rtol=1e-5
        )


def test_where_nothing_can_be_reached_nothing_climbs():
    where = situation_of(MOTIONS["free"])
    poses = candidates_along(np.full((NUM, 3), 99.0), np.ones((NUM, 3)))
    known = {"utility": np.ones(NUM)}
    after, found = refine.refine_best(where, poses, known, CONFIG)
    assert after is poses
    assert found is known


def test_a_search_of_paths_has_no_refinement():
    with pytest.raises(ValueError, match="refine"):
        make_policy("r3-ahead", refine=1)


def cluttered(seed: int) -> tuple[Travel, np.ndarray]:
    """Free space with holes, and a place somewhere in it."""
    rng = np.random.default_rng(seed)
    free = rng.random(SHAPE) < rng.uniform(0.92, 1.0)
    start = tuple(rng.integers(0, SHAPE))
    free[start] = True
    travel = plan_travel(grid_of(free), center(*start), safety_margin=0.15)
    cells = np.argwhere(travel.reachable)
    return travel, center(*(cells[rng.integers(len(cells))] + rng.uniform(-0.45, 0.45, 3)))


@given(seeds, st.floats(0.05, 0.7))
def test_a_box_is_free_and_as_large_as_it_may_be(seed, radius):
    """Every cell that it reaches into is a stop; no layer beside it is free and within reach."""
    travel, place = cluttered(seed)
    low, high = refine.free_box(travel, place, radius)
    assert np.all(low <= place)
    assert np.all(place <= high)
    assert np.all(np.maximum(place - low, high - place) <= radius + 1e-9)
    if not travel.safe[travel.cell_of(place)]:
        np.testing.assert_array_equal(np.stack([low, high]), np.stack([place, place]))
        return
    stops = travel.safe & travel.reachable
    first, last = (np.floor((corner - ORIGIN) / CELL).astype(int) for corner in (low, high))
    assert stops[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))].all()
    # As candidates do, it keeps a quarter of a cell from where another cell begins.
    assert np.all(((low - ORIGIN) / CELL % 1.0 > 0.25 - 1e-6) | (low == place))
    assert np.all(((high - ORIGIN) / CELL % 1.0 < 0.75 + 1e-6) | (high == place))
    for axis, (end, step) in itertools.product(range(3), ((first, -1), (last, 1))):
        beyond = end[axis] + step
        layer = [slice(a, b + 1) for a, b in zip(first, last, strict=True)]
        layer[axis] = slice(beyond, beyond + 1)
        nearest = ORIGIN[axis] + (beyond + (0.75 if step < 0 else 0.25)) * CELL
        if 0 <= beyond < SHAPE[axis] and abs(nearest - place[axis]) < radius - 1e-6:
            assert not stops[tuple(layer)].all()


def test_a_box_keeps_the_robots_heights_and_ends_at_the_radius():
    place = center(7, 7, 7)
    heights = (float(place[2] - 0.02), float(place[2] + 0.03))
    travel = plan_travel(grid_of(np.ones((15, 15, 15), bool)), place, heights=heights)
    low, high = refine.free_box(travel, place, 0.33)
    assert heights[0] <= low[2] <= high[2] <= heights[1]
    np.testing.assert_allclose((high - low)[:2], 0.66)
