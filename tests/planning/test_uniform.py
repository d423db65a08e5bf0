"""Farthest point: hand-computed distances, the metric's laws, a memory that loses nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import empty_map
from r3jax.planning.candidates import candidates_along, poses_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policies import uniform
from r3jax.planning.policies.uniform import Uniform, nearest_taken, no_poses, remember
from r3jax.planning.robot.travel import plan_travel
from tests.mutants import Modules, Mutant, assert_caught, each
from tests.planning.rooms import CELL, ORIGIN, candidates_of, center, grid_of, two_rooms

KEY = jax.random.key(2)
CAMERA = Camera.from_fov(8, 8)
CONFIG = PlannerConfig(num_candidates=60)
X, Y, Z = np.eye(3)


def taken_of(poses: np.ndarray, room: int = 4, module=uniform):
    taken = module.no_poses(room)
    for pose in poses:
        taken = module.remember(taken, pose)
    return taken


def random_poses(num: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, :3, 3] = random.uniform(-3.0, 3.0, (num, 3))
    poses[:, :3, :3] = np.linalg.qr(random.normal(size=(num, 3, 3)))[0]
    return poses


def law_by_hand(modules: Modules) -> None:
    """Two poses taken: at the origin along x, and 4 m along x from it, along y."""
    module = modules["uniform"]
    taken = taken_of(poses_along(np.array([0 * X, 4 * X]), np.array([X, Y])), module=module)
    cases = [
        (0 * X, X, 0.0),  # taken already
        (0 * X, Y, 1.0),  # a quarter turn is a meter
        (0 * X, -X, 2.0),
        (0 * X, X + Y, 0.5),
        (X, X, 1.0),
        (X, Y, 2.0),  # 1 m and a quarter turn from the first, 3 m from the second
        (3 * X, Y, 1.0),
        (3 * Y, X, 3.0),
        (2 * X + 1.5 * Y, X + Y, 3.0),  # 2.5 m and 45 degrees from both
    ]
    places, axes, expected = (np.array(part) for part in zip(*cases, strict=True))
    found = module.nearest_taken(taken, candidates_along(places, axes))
    np.testing.assert_allclose(found, expected, atol=2e-3)  # arccos of float32 near 1


def law_brute_force(modules: Modules) -> None:
    """The nearest of many, in float64, however often the memory has doubled."""
    module = modules["uniform"]
    poses, queries = random_poses(23, 1), random_poses(9, 2)
    taken = taken_of(poses, module=module)
    expected = [
        min(
            np.linalg.norm(q[:3, 3] - p[:3, 3])
            + np.rad2deg(np.arccos(np.clip(q[:3, 2] @ p[:3, 2], -1, 1))) / 90.0
            for p in poses
        )
        for q in queries
    ]
    np.testing.assert_allclose(
        module.nearest_taken(taken, candidates_of(queries)), expected, atol=1e-4
    )


def law_memory(modules: Modules) -> None:
    """Every pose is kept, in order; the room doubles only when it is full."""
    poses = random_poses(9, 3)
    rooms = []
    for num in range(len(poses) + 1):
        taken = taken_of(poses[:num], room=2, module=modules["uniform"])
        rooms.append(len(taken.position))
        assert int(taken.num) == num
        np.testing.assert_allclose(taken.position[:num], poses[:num, :3, 3], atol=1e-6)
        np.testing.assert_allclose(taken.axis[:num], poses[:num, :3, 2], atol=1e-6)
    assert rooms == [2, 2, 2, 4, 4, 8, 8, 8, 8, 16]


MUTANTS = [
    Mutant("uniform", "2.0 / np.pi", "np.pi / 2.0", law_by_hand),
    Mutant("uniform", ".min(axis=1)", ".mean(axis=1)", law_by_hand),
    Mutant("uniform", "candidates.axis @ axis.T", "candidates.position @ axis.T", law_by_hand),
    Mutant("uniform", "apart + METRES", "0 * apart + METRES", law_by_hand),
    Mutant("uniform", "np.float64)[:num]", "np.float64)", law_by_hand),
    Mutant("uniform", "T_world_camera[:3, 2]\n", "T_world_camera[2, :3]\n", law_brute_force),
    Mutant("uniform", "if num == room else 0", "if num > room - 2 else 0", law_memory),
    Mutant("uniform", "position[num], axis[num]", "position[0], axis[0]", law_memory),
]


@pytest.mark.parametrize("law", [law_by_hand, law_brute_force, law_memory])
def test_distances_and_memory(law):
    law({"uniform": uniform})


@each(MUTANTS)
def test_faults_are_noticed(mutant):
    assert_caught(("r3jax.planning.policies.uniform",), mutant)


@given(st.integers(0, 1000), st.integers(1, 12))
def test_it_is_a_distance_to_a_set(seed, num):
    """Zero at the members, never more with one more member, blind to order."""
    poses, queries = random_poses(num, seed), random_poses(5, seed + 1)
    taken = taken_of(poses)
    near = lambda taken, poses: nearest_taken(taken, candidates_of(poses))
    np.testing.assert_allclose(near(taken, poses), 0.0, atol=2e-3)
    before = near(taken, queries)
    assert np.all(before >= 0.0)
    assert np.all(near(remember(taken, queries[0]), queries) <= before)
    np.testing.assert_allclose(near(taken_of(poses[::-1]), queries), before)
    middle, end = queries[:1], queries[1:2]
    leg = near(taken_of(middle), end)
    assert near(taken, end) <= near(taken, middle) + leg + 1e-6


def test_before_the_first_view_nothing_is_near():
    assert np.all(np.isinf(nearest_taken(no_poses(), candidates_of(random_poses(3, 0)))))


def walk(num: int):
    """`num` decisions in two known rooms; the poses taken, and the last decision."""
    grid, map_state, policy = grid_of(*two_rooms()), empty_map(64), Uniform(CONFIG)
    state = policy.init(CAMERA, grid, key=KEY)
    pose, poses, decision = poses_along(center(2, 2, 2)[None], X[None])[0], [], None
    for step in range(num):
        poses.append(pose)
        state = policy.observe(state, map_state, frame_at(pose))
        key = jax.random.fold_in(KEY, step)
        decision, state, _ = policy.decide(state, map_state, grid, pose, key=key)
        assert decision is not None
        pose = decision.T_world_camera
    return np.stack(poses), decision


def frame_at(pose: np.ndarray) -> Frame:
    return Frame(
        rgb=jnp.zeros((8, 8, 3)),
        depth=jnp.zeros((8, 8)),
        camera=CAMERA,
        T_world_camera=jnp.asarray(pose, jnp.float32),
    )


def test_the_farthest_candidate_is_taken_whatever_the_path():
    poses, decision = walk(6)
    assert decision is not None
    expected = nearest_taken(taken_of(poses), candidates_of(decision.candidates))
    np.testing.assert_allclose(decision.utilities["utility"], expected, atol=1e-5)
    np.testing.assert_array_equal(decision.utilities["total"], decision.utilities["utility"])
    np.testing.assert_array_equal(decision.candidates[expected.argmax()], decision.T_world_camera)
    # From one corner the far room comes first, not what is near.
    assert poses[1, 0, 3] > center(16, 0, 0)[0]


def test_candidates_lie_in_all_cells_that_can_be_reached():
    grid = grid_of(*two_rooms())
    _, decision = walk(1)
    assert decision is not None
    travel = plan_travel(grid, center(2, 2, 2))
    cells = np.floor((decision.candidates[:, :3, 3] - ORIGIN) / CELL).astype(int)
    assert len(cells) == CONFIG.num_candidates
    assert travel.goals[tuple(cells.T)].all()
    assert (cells[:, 0] > 12).mean() == pytest.approx(0.5, abs=0.25)
    assert len(np.unique(decision.candidates[:, :3, 2], axis=0)) == len(cells)


def test_it_spreads_over_the_space_better_than_chance():
    """The least distance between any two of 20 views, against as many random candidates."""
    poses, decision = walk(20)
    assert decision is not None

    def least(poses):
        gaps = [
            nearest_taken(taken_of(poses[:i]), candidates_of(poses[i : i + 1]))
            for i in range(1, 20)
        ]
        return min(gap[0] for gap in gaps)

    assert least(poses) > 3.0 * least(decision.candidates)
