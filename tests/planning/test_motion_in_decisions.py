"""What the planner does for a motion, in one place each."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from r3jax.baselines import active_gamer
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.state import empty_map
from r3jax.planning.candidates import Candidates, candidates_along, poses_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import initial_state, look_round
from r3jax.planning.policies import frontier, r3, random
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.motion import MOTIONS, Motion
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import CELL, center, grid_of, pose_at, two_rooms
from tests.planning.test_motions_of_policies import CAMERA, CONSTRAINED, assert_obeys, turns

NUM = 12
KEY = jax.random.key(2)
LATTICE = fibonacci_lattice(526)
GRID = grid_of(*two_rooms())


def config_of(motion_name: str) -> PlannerConfig:
    return PlannerConfig(num_candidates=NUM, num_frontier=4, motion=MOTIONS[motion_name])


def level_start() -> np.ndarray:
    """Off the middle of its cell, as float32 has it; it looks along x."""
    pose = poses_along(center(5.1, 6.2, 6.1)[None], np.array([[1.0, 0.0, 0.0]]))[0]
    return pose.astype(np.float32).astype(np.float64)


def decide(policy):
    state = policy.init(CAMERA, GRID, key=KEY)
    return policy.decide(state, empty_map(64), GRID, level_start(), key=KEY)[0]


def test_what_is_scored_is_what_is_taken():
    """The scorer sees the candidates as the carrier would take them."""
    for name in CONSTRAINED:
        seen = []

        def score(map_state, grid, camera, poses, config, seen=seen):
            seen.append(poses)
            zeros = np.zeros(len(poses))
            return SimpleNamespace(exploration=zeros, rendering=zeros, total=zeros + 1.0)

        answer = decide(r3.R3(config_of(name), score))
        np.testing.assert_allclose(seen[0], answer.candidates, atol=1e-6)
        assert_obeys(MOTIONS[name], level_start(), level_start(), answer, GRID)


def test_a_policy_that_turns_is_held():
    """A panorama that answers with a direction off the limits is brought back within them."""
    for name in CONSTRAINED:
        allowed_axes = []

        def score(map_state, grid, camera, positions, config, allowed, kept=allowed_axes):
            kept.append(allowed)
            axes = LATTICE[allowed.argmax(axis=1)]  # the highest that is allowed
            return SimpleNamespace(best_direction=axes, best_score=np.ones(NUM))

        answer = decide(r3.R3Pano(config_of(name), score))
        assert_obeys(MOTIONS[name], level_start(), level_start(), answer, GRID)
        limits = Limits(MOTIONS[name], level_start())
        expected = limits.allowed_axes(answer.candidates[:, :3, 3], len(LATTICE))
        np.testing.assert_array_equal(allowed_axes[0], expected)
        assert not expected.all()


def test_turns_cost():
    """Path and seconds of every candidate by hand: the way is a straight line here."""
    config = config_of("gimbal")
    answer = decide(random.Random(config))
    poses, motion = answer.candidates, config.motion
    straight = np.linalg.norm(poses[:, :3, 3] - level_start()[:3, 3], axis=1)
    meters = motion.speed * turns(level_start(), poses) / motion.turn_rate
    np.testing.assert_allclose(answer.utilities["path"], straight + meters, atol=0.002)
    chosen = int(np.argmax(answer.utilities["total"]))
    assert answer.seconds == pytest.approx((straight + meters)[chosen] / motion.speed, abs=0.002)
    assert np.ptp(meters) > 0.5
    free = decide(random.Random(PlannerConfig(num_candidates=NUM, num_frontier=4)))
    assert free.seconds is None


def test_heights_count_from_the_first_view():
    """Not from the latest one: a hand that has come up does not come up from there again."""
    config, first = config_of("handheld"), level_start()
    state = initial_state(CAMERA, GRID, motion=config.motion)
    higher = first.copy()
    higher[2, 3] += 0.1
    for pose in (first, higher):
        state, where = look_round(state, empty_map(64), GRID, pose, config)
        low, high = first[2, 3] - 0.6, first[2, 3] + 0.4
        np.testing.assert_allclose(where.travel.heights, (low, high), atol=1e-6)
    assert initial_state(CAMERA, GRID).start_height is None
    walker = random.Random(config).init(CAMERA, GRID, key=KEY)
    assert walker.start_height is not None


def test_frontier_shows_its_target():
    """A level camera never walks to a target that it would look over."""
    free, _ = two_rooms()
    start = level_start()
    height = (float(start[2, 3]), float(start[2, 3]))
    travel = plan_travel(GRID, start[:3, 3], heights=height)
    targets = np.zeros_like(free)
    targets[8, 3:10, 1:9] = True
    limits = Limits(Motion(heights=(0.0, 0.0), elevations=(0.0, 0.0)), start, height)
    places, aims = frontier.nearest_views(travel, targets, 200, limits, key=KEY)
    assert len(places) > 10
    shown = (aims - places) / np.linalg.norm(aims - places, axis=1, keepdims=True)
    assert np.hypot(shown[:, 0], shown[:, 1]).min() >= 0.9
    assert np.all(places[:, 2] == start[2, 3])
    anything, _ = frontier.nearest_views(travel, targets, 200, key=KEY)
    assert len(anything) > len(places)


def test_pool_waits_for_turns():
    """A hand takes of the pool what it can turn to on the way: its azimuth is never changed."""
    start, shape = level_start(), (25, 14, 10)
    travel = plan_travel(GRID, start[:3, 3])
    limits = Limits(MOTIONS["handheld"], start, travel.heights)
    pools = active_gamer.empty_pools(shape, CELL)
    # Stage 1 needs stage 0 to be over.
    _, every = active_gamer.draw_candidates(pools, travel, 500)
    _, some = active_gamer.draw_candidates(pools, travel, 500, limits)
    assert 0 < some.candidates.num_valid < every.candidates.num_valid
    assert not _is_cut_short(limits, some.candidates).any()
    left_out = np.array(sorted(_views(every.candidates) - _views(some.candidates)))
    assert len(left_out) == every.candidates.num_valid - some.candidates.num_valid
    assert _is_cut_short(limits, candidates_along(left_out[:, :3], left_out[:, 3:])).all()


def _views(candidates: Candidates) -> set[tuple[float, ...]]:
    rows = np.concatenate([candidates.position, candidates.direction], axis=1)
    return {tuple(row) for row in np.round(rows, 5)}


def _is_cut_short(limits: Limits, candidates: Candidates) -> np.ndarray:
    """Which views the carrier cannot turn to, once their elevations are allowed."""
    tilted = Limits(Motion(elevations=limits.motion.elevations)).project_to_feasible(candidates)
    gap = np.abs(limits.project_to_feasible(candidates).direction - tilted.direction)
    return gap.max(axis=1) > 1e-4


def test_low_robots_have_candidates():
    """A robot below the levels of the lattice has its candidates at its own height."""
    start = pose_at(center(5, 6, 2))
    height = (float(start[2, 3]), float(start[2, 3]))
    travel = plan_travel(GRID, start[:3, 3], heights=height)
    _, found = active_gamer.draw_candidates(
        active_gamer.empty_pools((25, 14, 10), CELL), travel, 500
    )
    assert found is not None
    assert np.all(found.candidates.position[:, 2] == start[2, 3])
