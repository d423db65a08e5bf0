"""ActiveGAMER's score by hand, its gain on a known map, and its decisions in a known flat."""

from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.baselines import active_gamer
from r3jax.baselines.active_gamer import ActiveGamer, empty_share
from r3jax.baselines.pixels import PixelView, score_pixels
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along, rigid_error
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import DecisionOutcome, Policy
from tests.planning.rooms import center, grid_of, pose_at, two_rooms

CAMERA = Camera.from_fov(32, 32)
KEY = jax.random.key(3)
NUM = 12
CONFIG = PlannerConfig(num_candidates=NUM, num_frontier=0)


class Scorer:
    """A stand-in for `score_pixels`: a gain by position, and what it was asked."""

    def __init__(self, gain=lambda positions: positions[:, 0] * 0 + 0.5):
        self.gain, self.asked = gain, []

    def __call__(self, value, map_state, grid, camera, poses, config):
        assert value.__name__ == "empty_share"
        assert poses.shape == (NUM, 4, 4)
        assert poses.dtype == np.float32
        self.asked.append((poses, float(config.max_range)))
        return jnp.asarray(self.gain(np.asarray(poses, np.float64)[:, :3, 3]), jnp.float32)


@pytest.fixture(scope="module")
def world():
    return empty_map(64), grid_of(*two_rooms())


def decide(policy, world, state=None, cell=(6, 6, 4), key=KEY):
    map_state, grid = world
    state = policy.init(CAMERA, grid, key=KEY) if state is None else state
    with mock.patch.object(active_gamer, "score_pixels", SCORERS[id(policy)]):
        return policy.decide(state, map_state, grid, pose_at(center(*cell)), key=key)


SCORERS: dict[int, Scorer] = {}
"""What gives the gains of a policy's views, in place of `score_pixels`."""


def policy_with(scorer: Scorer) -> ActiveGamer:
    policy = ActiveGamer(CONFIG)
    SCORERS[id(policy)] = scorer
    return policy


def shown(hit) -> PixelView:
    """A view of which only the pixels with a voxel are known."""
    empty = jnp.zeros(hit.shape)
    return PixelView(hit, empty, jnp.zeros((3, *hit.shape)), (), jnp.zeros(()), jnp.ones(()))


def test_score() -> None:
    """Distances 0, ln 2, ln 5 have softmax 1/8, 2/8, 5/8; gains 1, 3, 4 are 1/8, 3/8, 4/8."""
    score_of = active_gamer.score_of
    distance, gain = np.log([1.0, 2.0, 5.0]), np.array([1.0, 3.0, 4.0])
    np.testing.assert_allclose(
        score_of(gain, distance), [7 / 8 / 8, 6 / 8 * 3 / 8, 3 / 8 * 4 / 8], rtol=1e-12
    )
    np.testing.assert_array_equal(score_of(gain * 0, distance), 0.0)
    far = score_of(gain, distance + 2000.0)
    np.testing.assert_allclose(far, score_of(gain, distance), rtol=1e-9)


@given(st.integers(0, 10_000))
def test_nearer_of_equal_gains(seed):
    rng = np.random.default_rng(seed)
    distance, gain = rng.uniform(0, 9, 8), rng.uniform(0.01, 1, 8)
    gain[3] = gain[5]
    distance[3] = distance[5] + rng.uniform(0.1, 3)
    score = active_gamer.score_of(gain, distance)
    assert 0 <= score[3] < score[5] <= gain[5] / gain.sum()


def test_gain_is_the_share_of_empty_pixels() -> None:
    hit = jnp.asarray(np.arange(12).reshape(3, 4) < 5)
    share = active_gamer.empty_share(shown(hit))
    np.testing.assert_allclose(share, 7 / 12, rtol=1e-6)


def test_decision() -> None:
    """The greatest score is taken, leaves the pool, and so do the worthless."""
    # The robot stands by the wall; two of the twelve lie behind it, a detour away.
    scorer = Scorer(lambda p: np.where(p[:, 0] > 0.9, 0.004, 0.1 * (p[:, 1] - 2.0)))
    policy = policy_with(scorer)
    world = empty_map(64), grid_of(*two_rooms())
    decision, state, _ = decide(policy, world, cell=(10, 2, 4))
    u, positions = decision.utilities, decision.candidates[:, :3, 3]
    straight = np.linalg.norm(positions - center(10, 2, 4), axis=1)
    assert np.sum(u["path"] > straight + 0.5) == 2
    softmax = np.exp(straight) / np.exp(straight).sum()
    np.testing.assert_allclose(u["utility"], scorer.gain(positions), rtol=1e-6)
    np.testing.assert_allclose(
        u["total"], (1 - softmax) * u["utility"] / u["utility"].sum(), rtol=1e-6
    )
    best = int(np.argmax(u["total"]))
    np.testing.assert_array_equal(decision.T_world_camera, decision.candidates[best])
    np.testing.assert_allclose(positions[best], center(7, 7, 7), atol=1e-6)
    assert np.sum(u["utility"] < 0.005) == 2
    left = np.asarray(state.memory.of_stage[0].left).sum(axis=1)
    by_column = {4: 1, 9: 2}  # columns (7, 7) and (17, 2), of 5 x 3
    assert {int(i): int(left[i]) for i in np.flatnonzero(left)} == by_column
    grid_diagonal = 0.2 * np.linalg.norm([25, 14, 10])
    np.testing.assert_allclose(scorer.asked[0][1], grid_diagonal, rtol=1e-6)


def test_decisions_are_safe_complete_and_repeatable(world):
    policy = policy_with(Scorer())
    assert isinstance(policy, Policy)
    decision, state, info = decide(policy, world)
    again, _, _ = decide(policy, world)
    np.testing.assert_array_equal(decision.T_world_camera, again.T_world_camera)
    assert info.outcome is DecisionOutcome.MOVED
    assert info.num_candidates == info.num_reachable == NUM
    assert {"travel", "candidates", "scoring"} == set(info.stage_seconds)
    assert rigid_error(decision.T_world_camera) is None
    np.testing.assert_array_equal(decision.waypoints[0], center(6, 6, 4))
    np.testing.assert_array_equal(decision.waypoints[-1], decision.T_world_camera[:3, 3])
    assert np.asarray(state.trail)[6, 6, 4]
    directions = decision.candidates[:, :3, 2]
    cosine = directions @ fibonacci_lattice(5).T
    np.testing.assert_allclose(cosine.max(axis=1), 1.0, atol=1e-6)


def test_every_view_of_a_run_is_another_one_until_views_are_random(world):
    """20 views of stage 0 or fewer; then stage 1; with all worthless, soon none is left."""
    policy, state, seen = policy_with(Scorer(lambda p: p[:, 0] * 0)), None, set()
    for _ in range(400):
        decision, state, info = decide(policy, world, state)
        if "lot" in decision.utilities:
            break
        pose = tuple(np.round(decision.T_world_camera.reshape(-1), 6))
        assert pose not in seen
        seen.add(pose)
    else:
        raise AssertionError("the pools were never exhausted")
    assert int(state.memory.num_ended) == 2
    assert info.outcome is DecisionOutcome.MOVED
    assert np.linalg.norm(decision.T_world_camera[:3, 3] - center(6, 6, 4)) <= 0.5


def test_nowhere_to_go_is_an_outcome():
    policy = policy_with(Scorer())
    nothing = (empty_map(64), grid_of(np.zeros((25, 14, 10), bool)))
    decision, state, info = decide(policy, nothing)
    assert decision is None
    assert info.outcome is DecisionOutcome.NO_CANDIDATE
    assert int(state.memory.num_ended) == 0


def test_the_state_is_a_pytree_of_the_same_form_throughout(world):
    policy = policy_with(Scorer())
    first = policy.init(CAMERA, world[1], key=KEY)
    _, after, _ = decide(policy, world, first)
    shapes = lambda state: [(x.shape, x.dtype) for x in jax.tree.leaves(state)]
    assert jax.tree.structure(first) == jax.tree.structure(after)
    assert shapes(first) == shapes(after)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(after.memory))
    moved = eqx.tree_at(lambda s: s.memory.num_ended, after, jnp.int32(2))
    decision, _, _ = decide(policy, world, moved)
    assert "lot" in decision.utilities


def test_the_gain_of_a_wall_that_fills_half_the_picture():
    """A wall 1.5 m ahead, from the camera's height upwards: the lower half is empty.

    From 4.5 m farther back it lies beyond the sensor's 5 m and still counts as known: 1.7 m x
    0.9 m of 6.9 m x 6.9 m, that is 3 %.
    """
    pose = pose_along(np.zeros(3), np.array([0.0, 1.0, 0.0]))
    depth = np.full((64, 64), 1.5, np.float32)
    depth[32:] = 0.0
    frame = Frame(jnp.full((64, 64, 3), 0.5), jnp.asarray(depth), pose, Camera.from_fov(64, 64))
    state = integrate(empty_map(1 << 13), frame, 5.0)
    back = np.array(pose)
    back[1, 3] = -4.5
    poses = np.stack([np.array(pose), back]).astype(np.float32)
    grid, camera = grid_of(np.zeros((25, 14, 10), bool)), Camera.from_fov(32, 32)
    config = ActiveGamer(CONFIG).scoring_for(grid)
    gain = np.asarray(score_pixels(empty_share, state, grid, camera, poses, config))
    np.testing.assert_allclose(gain, [0.48, 0.965], atol=0.02)
    assert gain[1] < 0.985
