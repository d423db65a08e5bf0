"""The four policies in a known two-room flat, with stand-ins for the scorer.

Mutants tried by hand, each caught here: path length not weighed; sums taken over unreachable
candidates; utilities left undivided; the worst candidate taken; hopeless cells left in the
scorer's grid; the trail forgotten; `frontier` looking at the same cell again.
"""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.mapping.state import empty_map
from r3jax.planning.candidates import poses_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import MAX_FAILED_LOOKS, initial_state, look_round, net_utility
from r3jax.planning.policies.frontier import Frontier
from r3jax.planning.policies.r3 import R3, R3Pano
from r3jax.planning.policies.random import Random
from r3jax.planning.policy import DecisionOutcome, Policy
from r3jax.planning.registry import describe, make_policy, policy_names, source_of
from r3jax.planning.robot.travel import plan_travel
from tests.planning.rooms import center, grid_of, pose_at, two_rooms
from tests.planning.test_travel import assert_inside

KEY = jax.random.key(3)
CAMERA = Camera.from_fov(64, 64)
NUM = 40
CONFIG = PlannerConfig(num_candidates=NUM, num_frontier=12)


def flat():
    """Two rooms, all known but the far half of the second one."""
    free, occupied = two_rooms()
    known = (np.arange(25) < 18)[:, None, None]
    return grid_of(free & known, occupied & known)


def prefer_high_x(map_state, grid, camera, poses, config):
    """A stand-in for `score_views`: what lies at greater x is worth more."""
    assert poses.shape == (NUM, 4, 4)
    assert poses.dtype == np.float32
    x = np.asarray(poses, np.float64)[:, 0, 3]
    return SimpleNamespace(exploration=x * 0 + 1, rendering=(x + 2) ** 2, total=(x + 2) ** 2 + 1)


def look_down(map_state, grid, camera, positions, config, allowed):
    """A stand-in for `score_positions`: straight down is best, high positions above all."""
    assert positions.shape == (NUM, 3)
    assert allowed.shape == (NUM, 526)
    down = np.tile([0.0, 0.0, -1.0], (NUM, 1))
    return SimpleNamespace(
        best_direction=down,
        best_score=np.asarray(positions)[:, 2] ** 2,
    )


def policies() -> list:
    return [
        R3(CONFIG, prefer_high_x),
        R3Pano(CONFIG, look_down),
        Frontier(CONFIG),
        Random(CONFIG),
    ]


@pytest.fixture(scope="module")
def world():
    return empty_map(64), flat()


def decide(policy, world, position, state=None, key=KEY):
    map_state, grid = world
    state = policy.init(CAMERA, grid, key=KEY) if state is None else state
    return policy.decide(state, map_state, grid, pose_at(position), key=key)


@pytest.mark.parametrize("policy", policies(), ids=lambda p: p.name)
def test_every_decision_is_safe_complete_and_repeatable(policy, world):
    assert isinstance(policy, Policy)
    start = center(6, 6, 4)
    decision, state, info = decide(policy, world, start)
    again, _, _ = decide(policy, world, start)
    np.testing.assert_array_equal(decision.T_world_camera, again.T_world_camera)
    assert info.outcome is DecisionOutcome.MOVED
    assert rigid_error(decision.T_world_camera) is None
    assert decision.T_world_camera.dtype == np.float64
    np.testing.assert_array_equal(decision.waypoints[0], start)
    np.testing.assert_array_equal(decision.waypoints[-1], decision.T_world_camera[:3, 3])
    travel = plan_travel(world[1], start)
    assert_inside(travel.safe, decision.waypoints)
    length = np.linalg.norm(np.diff(decision.waypoints, axis=0), axis=1).sum()
    assert decision.length == pytest.approx(length)
    assert info.num_candidates == info.num_reachable == len(decision.candidates) > 0
    for name in ("path", "total"):
        assert decision.utilities[name].shape == (len(decision.candidates),)
    best = int(np.argmax(decision.utilities["total"]))
    np.testing.assert_array_equal(decision.candidates[best], decision.T_world_camera)
    assert decision.score == decision.utilities["total"][best]
    assert {"travel", "candidates"} <= set(info.stage_seconds)
    assert np.asarray(state.trail)[6, 6, 4]


@pytest.mark.parametrize("policy", policies(), ids=lambda p: p.name)
def test_nowhere_to_go_is_an_outcome(policy):
    """Nothing known; then a safe place in reach of the arm but behind a wall."""
    nothing = (empty_map(64), grid_of(np.zeros((25, 14, 10), bool)))
    decision, state, info = decide(policy, nothing, center(6, 6, 4))
    assert decision is None
    assert info.outcome is DecisionOutcome.NO_CANDIDATE
    assert info.num_candidates == 0
    free = np.zeros((25, 14, 10), bool)
    free[6:12, 2:12, 1:9] = True
    walled = (empty_map(64), grid_of(free, ~free))
    decision, _, info = decide(policy, walled, center(5, 6, 4), state)
    assert decision is None
    assert info.outcome is DecisionOutcome.NO_REACHABLE_CANDIDATE
    assert info.num_candidates > 0
    assert info.num_reachable == 0
    decision, _, info = decide(policy, nothing, np.array([50.0, 0.0, 0.0]))
    assert decision is None


def test_utility_and_path_are_shares_of_their_sums():
    """Worked out by hand: utilities 1, 3, 4 of 8; paths 0, 1, 3 of 4; lambda2 = 0.5."""
    utility, path = np.array([1.0, 3.0, 4.0]), np.array([0.0, 1.0, 3.0])
    np.testing.assert_allclose(net_utility(utility, path, 0.5), [0.125, 0.25, 0.125])
    np.testing.assert_allclose(net_utility(utility, path * 0, 0.5), utility / 8)
    np.testing.assert_allclose(net_utility(utility * 0, path, 0.5), -0.5 * path / 4)
    far = np.array([0.0, np.inf, 3.0])
    np.testing.assert_allclose(net_utility(utility, far, 0.5), [0.2, -np.inf, 0.3])


def test_ours_weighs_what_the_scorer_says(world):
    decision, _, info = decide(R3(CONFIG, prefer_high_x), world, center(6, 6, 4))
    u = decision.utilities
    np.testing.assert_array_equal(u["utility"], u["rendering"] + u["exploration"])
    expected = u["utility"] / u["utility"].sum() - 0.5 * u["path"] / u["path"].sum()
    np.testing.assert_allclose(u["total"], expected, rtol=1e-12)
    assert len(np.unique(u["path"])) > 10
    assert "scoring" in info.stage_seconds
    greedy = R3(PlannerConfig(num_candidates=NUM, num_frontier=12, lambda2=0.0), prefer_high_x)
    farther, _, _ = decide(greedy, world, center(6, 6, 4))
    assert farther.T_world_camera[0, 3] == farther.candidates[:, 0, 3].max()


def test_ours_mixes_local_views_with_views_of_the_frontier(world):
    decision, _, _ = decide(R3(CONFIG, prefer_high_x), world, center(6, 6, 4))
    positions = decision.candidates[:, :3, 3]
    is_local = np.linalg.norm(positions - center(6, 6, 4), axis=1) <= 0.5
    assert NUM - 12 <= is_local.sum() < NUM
    # The frontier is the plane where the second room's far half begins; those views look at it.
    edge = center(17, 0, 0)[0]
    away = ~is_local
    assert np.all(np.abs(positions[away, 0] - edge) < 2.1)
    assert np.mean(decision.candidates[away, 0, 2] > 0) == 1.0
    local_only = R3(PlannerConfig(num_candidates=NUM, num_frontier=0), prefer_high_x)
    decision, _, _ = decide(local_only, world, center(6, 6, 4))
    offset = decision.candidates[:, :3, 3] - center(6, 6, 4)
    assert np.linalg.norm(offset, axis=1).max() <= 0.5


def test_pano_takes_the_direction_from_the_panorama(world):
    decision, _, _ = decide(R3Pano(CONFIG, look_down), world, center(6, 6, 4))
    np.testing.assert_allclose(decision.T_world_camera[:3, 2], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(
        decision.utilities["utility"], decision.candidates[:, 2, 3] ** 2, rtol=1e-5
    )


@pytest.mark.parametrize("policy_class", [R3, R3Pano])
def test_the_scorer_never_sees_hopeless_cells(policy_class):
    free, occupied = two_rooms()
    occupied[12] = True  # the door is shut: the second room cannot be entered
    free[12] = False
    free[13:24] = False
    occupied[13:] = False
    grids = []

    def spy(map_state, grid, camera, views, config, *more, **asked):
        grids.append(grid)
        stand_in = prefer_high_x if policy_class is R3 else look_down
        return stand_in(map_state, grid, camera, views, config, *more, **asked)

    grid = grid_of(free, occupied)
    assert bool(grid.unexplored[13:].all())
    decide(policy_class(CONFIG, spy), (empty_map(64), grid), center(6, 6, 4))
    assert not bool(grids[0].unexplored.any())
    np.testing.assert_array_equal(grids[0].free, grid.free)


def test_frontier_goes_to_the_unknown_and_then_looks_elsewhere(world):
    policy = Frontier(CONFIG)
    decision, state, _ = decide(policy, world, center(6, 6, 4))
    goal = decision.T_world_camera
    assert goal[0, 3] > center(13, 0, 0)[0]
    assert decision.utilities["path"].argmin() == 0
    # Nothing is learned from that look: the next one is at another part of the frontier.
    attempted = np.asarray(state.memory)
    assert attempted[17].any()
    target = np.argwhere(attempted & np.asarray(world[1].free))
    state_after = state
    for i in range(3):
        decision, state_after, _ = decide(
            policy, world, goal[:3, 3], state_after, key=jax.random.key(i)
        )
        fresh = np.asarray(state_after.memory) & ~attempted
        assert fresh[17].any()
        attempted = np.asarray(state_after.memory)
    assert len(target) < attempted.sum()


def test_frontier_walks_at_random_when_all_is_known():
    world = (empty_map(64), grid_of(*two_rooms()))
    decision, _, info = decide(Frontier(CONFIG), world, center(6, 6, 4))
    assert info.outcome is DecisionOutcome.MOVED
    assert np.linalg.norm(decision.T_world_camera[:3, 3] - center(6, 6, 4)) <= 0.5


def test_random_draws_another_view_with_another_key(world):
    poses = [
        decide(Random(CONFIG), world, center(6, 6, 4), key=jax.random.key(i))[0].T_world_camera
        for i in range(4)
    ]
    assert len(np.unique(np.stack(poses), axis=0)) == 4


def test_the_trail_follows_the_robot(world):
    policy = R3(CONFIG, prefer_high_x)
    _, state, _ = decide(policy, world, center(6, 6, 4))
    _, later, _ = decide(policy, world, center(3, 4, 4), state)
    before, after = np.asarray(state.trail), np.asarray(later.trail)
    assert before[6, 6, 4]
    assert not before[3, 4, 4]
    assert after[3, 4, 4]
    assert np.all(after[before])


def test_the_registry_makes_what_it_names():
    known = {
        "r3",
        "r3-pano",
        "cover",
        "frontier",
    }
    assert known | {"random"} <= set(policy_names())
    for name in policy_names():
        policy = make_policy(name, num_candidates=7, num_frontier=2)
        assert policy.name == name
        assert 20 < len(describe(name)) < 100
        assert 10 < len(source_of(name)) < 80
    assert make_policy("r3", lambda2=0.1).config.lambda2 == 0.1


def test_an_unknown_name_lists_the_known_ones():
    for call in (make_policy, describe, source_of):
        with pytest.raises(ValueError, match=r"'best'.*r3, r3-pano, .*random"):
            call("best")
        with pytest.raises(ValueError, match=r"'ours-demand'.*e43d800"):
            call("ours-demand")
        with pytest.raises(ValueError, match=r"'uniform'.*fb13156"):
            call("uniform")
    with pytest.raises(ValueError, match=r"speed.*num_candidates"):
        make_policy("r3", speed=1.0)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("num_candidates", 0),
        ("num_frontier", -1),
        ("num_frontier", 101),
        ("radius", np.inf),
        ("lambda2", -0.5),
        ("safety_margin", np.nan),
        ("refine", -1),
        ("refine", 101),
        ("refine_radius", np.inf),
    ],
)
def test_impossible_settings_are_named(setting, value):
    with pytest.raises(ValueError, match=setting):
        make_policy("r3", **{setting: value})


def test_cells_looked_at_in_vain_are_left_alone():
    """A window: the depth sensor learns nothing of what lies behind it, however often it looks."""
    free, occupied = two_rooms()
    known = (np.arange(25) < 18)[:, None, None]
    grid = grid_of(free & known, occupied & known)
    state = initial_state(CAMERA, grid)
    pose = poses_along(center(14, 6, 4)[None], np.array([[1.0, 0.0, 0.0]]))[0]
    config = PlannerConfig()
    in_view = None
    for look in range(MAX_FAILED_LOOKS):
        state, where = look_round(state, empty_map(64), grid, pose, config)
        masked = where.scoring_grid
        seen = np.asarray(state.looks) == look + 1
        assert in_view is None or np.array_equal(seen, in_view)
        in_view = seen
        left = np.asarray(masked.unexplored)
        assert left[in_view].any() == (look < MAX_FAILED_LOOKS - 1)
    assert in_view.sum() > 50
    assert np.asarray(masked.unexplored).any()  # what no view has shown still counts
    away = poses_along(center(14, 6, 4)[None], np.array([[-1.0, 0.0, 0.0]]))[0]
    state, _ = look_round(state, empty_map(64), grid, away, config)
    assert not np.any((np.asarray(state.looks) > MAX_FAILED_LOOKS) & in_view)
