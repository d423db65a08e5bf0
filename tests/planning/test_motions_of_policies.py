"""Every policy keeps to every motion: a walk of some decisions in the two-room flat, real scores.

The limits are checked from scratch: angles by SciPy, ways point by point.
"""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.candidates import poses_along
from r3jax.planning.policy import DecisionOutcome
from r3jax.planning.registry import make_policy, policy_names
from r3jax.planning.robot.motion import MOTIONS, Motion
from r3jax.scoring import batch
from r3jax.scoring.config import ScoringConfig
from tests.planning.rooms import CELL, ORIGIN, center, grid_of, known_flat, pose_at
from tests.planning.test_travel import assert_inside
from tests.tiers import quick_and_full

CAMERA = Camera.from_fov(16, 16, 60.0)
SCORING = ScoringConfig(max_range=4.0, zbuffer_size=16)
NUM = 12
CONSTRAINED = ("ground", "gimbal", "handheld")
PAIRS = [(name, motion) for name in policy_names() for motion in CONSTRAINED]
ONE_OF_EACH = [
    ("frontier", "ground"),
    *((name, CONSTRAINED[i % 3]) for i, name in enumerate(policy_names())),
]
"""Every policy with one motion; the others are left to `make stress`."""

ROUNDING = 0.1
"""float32 poses know small angles to some hundredths [deg]."""


@pytest.fixture(scope="module")
def world():
    return known_flat()


def policy_of(name: str, motion: Motion):
    """With a body that fits under the two-room flat's camera."""
    motion = replace(motion, body=0.6) if motion.body else motion
    return make_policy(name, num_candidates=NUM, num_frontier=4, scoring=SCORING, motion=motion)


def walk(policy, world, seed: int, num_decisions: int = 3):
    """Pairs of the pose before and the decision, from a random level pose in the first room."""
    rng = np.random.default_rng(seed)
    start = center(*rng.uniform((3, 3, 5), (6, 11, 5.9)))
    pose = poses_along(start[None], np.append(rng.normal(size=2), 0.0)[None])[0]
    state = policy.init(CAMERA, world[1], key=jax.random.key(0))
    pairs = []
    for step in range(num_decisions):
        pose = np.asarray(pose, np.float32).astype(np.float64)  # as the trace has it
        key = jax.random.key(1000 * seed + step)
        decision, state, info = policy.decide(state, *world, pose, key=key)
        assert info.outcome is DecisionOutcome.MOVED
        pairs.append((pose, decision))
        pose = decision.T_world_camera
    return pairs


def turns(first: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Angle of the rotation to each pose [deg]."""
    relative = Rotation.from_matrix(first[:3, :3]).inv() * Rotation.from_matrix(poses[:, :3, :3])
    return np.degrees(relative.magnitude())


def assert_obeys(motion: Motion, start: np.ndarray, before: np.ndarray, decision, grid) -> None:
    """Every candidate that was scored, the chosen one and the way to it keep to the motion."""
    poses, way = decision.candidates, decision.waypoints
    low, high = motion.heights_from(float(start[2, 3]))
    for heights in (poses[:, 2, 3], way[:, 2]):
        assert np.all((heights >= low) & (heights <= high))
    elevation = np.degrees(np.arcsin(np.clip(poses[:, 2, 2], -1, 1)))
    assert np.all(elevation >= motion.elevations[0] - 0.01)
    assert np.all(elevation <= motion.elevations[1] + 0.01)
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-6)
    assert all(rigid_error(pose) is None for pose in poses)
    turned = turns(before, poses)
    straight = np.linalg.norm(poses[:, :3, 3] - before[:3, 3], axis=1)
    if motion.turn_per_meter is not None:
        assert np.all(turned <= motion.turn_per_meter * straight + ROUNDING)
    gaps = np.abs(poses - decision.T_world_camera).max(axis=(1, 2))
    chosen = int(np.argmin(gaps))
    assert gaps[chosen] == 0.0
    np.testing.assert_array_equal(way[-1], decision.T_world_camera[:3, 3])
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    seconds = length / motion.speed + turned[chosen] / motion.turn_rate
    assert decision.seconds == pytest.approx(seconds, abs=ROUNDING / motion.turn_rate)
    paths = decision.utilities["path"]
    meters = turned * motion.speed / motion.turn_rate
    assert np.all(paths >= straight + meters - 0.01)
    assert_inside(np.asarray(grid.free), way)
    if motion.body:  # nothing below the camera on the way: not over the table
        cells = np.floor((way - ORIGIN) / CELL).astype(int)
        layer = cells[0, 2]
        below = np.asarray(grid.occupied)[:, :, layer - 3 : layer].any(axis=2)
        assert_inside(np.repeat(~below[:, :, None], 10, axis=2), way)


@pytest.mark.parametrize(
    "pair",
    quick_and_full(PAIRS, [("frontier", "ground")], slow=set(PAIRS) - set(ONE_OF_EACH)),
    ids="-".join,
)
def test_every_policy_keeps_to_every_motion(pair, world):
    name, motion_name = pair
    motion = MOTIONS[motion_name]
    pairs = walk(policy_of(name, motion), world, seed=3)
    for before, decision in pairs:
        assert_obeys(motion, pairs[0][0], before, decision, world[1])


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), name=st.sampled_from(["random", "frontier"]))
def test_walks_from_anywhere_keep_to_the_limits(world, seed, name):
    for motion_name in CONSTRAINED:
        motion = MOTIONS[motion_name]
        pairs = walk(policy_of(name, motion), world, seed, num_decisions=4)
        for before, decision in pairs:
            assert_obeys(motion, pairs[0][0], before, decision, world[1])


def test_a_panorama_serves_every_motion_without_compiling_again(world):
    walk(policy_of("r3-pano", MOTIONS["free"]), world, seed=3, num_decisions=1)
    before = batch._score_positions._cache_size()
    for motion_name in CONSTRAINED:
        walk(policy_of("r3-pano", MOTIONS[motion_name]), world, seed=3, num_decisions=1)
    assert batch._score_positions._cache_size() == before


def test_the_panorama_takes_the_best_of_the_directions_that_are_allowed(world):
    positions = np.stack([center(4, 3 + 0.5 * k, 5) for k in range(NUM)]).astype(np.float32)
    free = batch.score_positions(*world, CAMERA, positions, SCORING)
    scores = np.asarray(free.direction_scores)
    best = scores.argmax(axis=1)
    allowed = np.random.default_rng(0).random(scores.shape) < 0.2
    allowed[np.arange(NUM), best] = False
    some = batch.score_positions(*world, CAMERA, positions, SCORING, allowed)
    np.testing.assert_array_equal(some.direction_scores, scores)
    rivals = np.where(allowed, scores, -np.inf)
    np.testing.assert_array_equal(some.best_score, rivals.max(axis=1))
    assert np.all(np.asarray(some.best_score) < np.asarray(free.best_score))
    axes = fibonacci_lattice(scores.shape[1])[rivals.argmax(axis=1)]
    np.testing.assert_allclose(some.best_direction, axes, atol=1e-6)


def test_a_robot_that_fits_nowhere_says_so(world):
    """A body as deep as the flat is high: there is floor in it everywhere but where it stands."""
    motion = replace(MOTIONS["ground"], body=3.0)
    policy = make_policy("random", num_candidates=NUM, num_frontier=4, motion=motion)
    start = pose_at(center(5, 5, 5).astype(np.float32).astype(np.float64))
    state = policy.init(CAMERA, world[1], key=jax.random.key(0))
    decision, _, _ = policy.decide(state, *world, start, key=jax.random.key(1))
    np.testing.assert_array_equal(decision.candidates[:, :3, 3], np.tile(start[:3, 3], (NUM, 1)))
    nowhere = (world[0], grid_of(np.zeros((25, 14, 10), bool)))
    decision, _, info = policy.decide(state, *nowhere, start, key=jax.random.key(1))
    assert decision is None
    assert info.outcome is DecisionOutcome.NO_CANDIDATE
