"""The smooth utility: finite differences, a float64 oracle, and the exact utility without softness.

A wall with a plate before it, and unexplored cells to the side of both.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.scoring import soft_utility as real
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import view_utility

pytestmark = pytest.mark.full

VOXEL, CAPACITY = 0.1, 1 << 11  # one shape: one compile
CAMERA = Camera(96, 72, 90.0, 84.0, 45.0, 37.5)
SCORING = ScoringConfig(max_range=2.4, zbuffer_size=96, lambda1=4.0)
MIDDLE = np.array([0.0, 0.0, 1.25])
CRISP = 1e-4
seeds = st.integers(0, 10_000)


def surface(x: float, y: tuple[float, float], z: tuple[float, float]) -> np.ndarray:
    """Centers of a sheet of voxels [n, 3] [m]."""
    at = lambda ends: (np.arange(round(ends[0] / VOXEL), round(ends[1] / VOXEL)) + 0.5) * VOXEL
    return np.stack(np.meshgrid([x + 0.5 * VOXEL], at(y), at(z), indexing="ij"), -1).reshape(-1, 3)


WALL = surface(2.0, (-1.2, 1.2), (0.1, 2.5))
PLATE = surface(1.0, (0.1, 0.6), (0.9, 1.6))


@functools.cache
def room(num_surfaces: int):
    """The wall alone, or with the plate; each was seen from its own place."""
    state = r3jax.empty_map(CAPACITY, VOXEL)
    for number, points in enumerate((WALL, PLATE)[:num_surfaces]):
        padded = np.resize(points, (900, 3)).astype(np.float32)
        eye = np.array([0.5 - number, -3.0, 1.0], np.float32)
        state = r3jax.integrate_points(state, padded, np.full_like(padded, 0.5), eye, 84.0)
    return state


@functools.cache
def grid():
    origin, shape = np.array([-2.5, -2.5, 0.0]), (25, 25, 13)
    x, y, _ = origin[:, None, None, None] + 0.2 * (np.indices(shape) + 0.5)
    log_odds = jnp.asarray(np.where((y < -0.9) & (x < 1.8), 0.0, -3.0), jnp.float32)
    return OccupancyGrid(log_odds, jnp.asarray(origin, jnp.float32), jnp.asarray(0.2, jnp.float32))


def view_of(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A position and a direction from which some of the wall and of the cells is in view."""
    rng = np.random.default_rng(seed)
    direction = np.array([1.0, *rng.uniform(-0.4, 0.4, 2)])
    return MIDDLE + rng.uniform(-0.3, 0.3, 3), direction / np.linalg.norm(direction)


def pose_of(view: tuple[np.ndarray, np.ndarray]) -> jax.Array:
    return r3jax.pose_along(*(np.asarray(x, np.float32) for x in view))


STEP = 4e-3
"""Of central differences [m] and [rad]: a tenth of the softness, far above float32's rounding."""

TOLERANCE = 2e-3
"""Of a component, as a share of the greatest of its kind: the error of the differences."""


def test_the_gradient_is_that_of_finite_differences():
    """At 100 poses, each near the one that the utility was made for, in position and direction."""
    known = room(2), grid(), CAMERA

    @jax.jit
    def slopes(anchor, position, direction):
        utility = real.soft_utility(*known, anchor, SCORING)
        value = lambda p, d: utility(r3jax.pose_along(p, d))
        found = jnp.concatenate(jax.grad(value, argnums=(0, 1))(position, direction))
        moved = STEP * jnp.concatenate([jnp.eye(6), -jnp.eye(6)])
        there = jax.lax.map(lambda m: value(position + m[:3], direction + m[3:]), moved)
        return found, (there[:6] - there[6:]) / (2.0 * STEP)

    found, wanted = [], []
    for seed in range(100):
        position, direction = view_of(seed)
        rng = np.random.default_rng(seed)
        near = position + rng.uniform(-0.1, 0.1, 3), direction + rng.uniform(-0.1, 0.1, 3)
        both = slopes(pose_of((position, direction)), *(jnp.asarray(x, jnp.float32) for x in near))
        found.append(np.asarray(both[0]))
        wanted.append(np.asarray(both[1]))
    found, wanted = np.stack(found), np.stack(wanted)
    for part in (slice(0, 3), slice(3, 6)):
        scale = np.abs(wanted[:, part]).max(axis=1)
        assert np.median(scale) > 10.0
        error = np.abs(found - wanted)[:, part].max(axis=1)
        np.testing.assert_array_less(error, TOLERANCE * scale)


def by_hand(utility: real.SoftUtility, pose: np.ndarray) -> float:
    """The sum over all points in float64; R is that of the map's own closed form."""
    points = np.asarray(utility.points, np.float64).T
    seen = (points - pose[:3, 3]) @ pose[:3, :3]
    distance, soft = np.linalg.norm(seen, axis=1), float(utility.softness)
    sigmoid = lambda x: 1.0 / (1.0 + np.exp(-np.clip(x, -500, 500)))
    weight = np.asarray(utility.count, np.float64)
    weight = weight * sigmoid((1.0 - distance / float(SCORING.max_range)) / soft)
    corners = [
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]
        for u, v in ((0, 0), (CAMERA.width, 0), (CAMERA.width, CAMERA.height), (0, CAMERA.height))
    ]
    for k in range(4):  # planes through the camera and an edge of the image
        normal = np.cross(np.array(corners[k], float), np.array(corners[(k + 1) % 4], float))
        weight = weight * sigmoid(seen @ normal / np.linalg.norm(normal) / distance / soft)
    place = np.asarray(pose[:3, 3], np.float32)
    known = np.asarray(r3jax.voxel_renderability(utility.voxels, place, CAMERA.focal).value)
    return float(weight @ np.append(1.0 - known, np.full(len(weight) - len(known), 4.0)))


@given(seeds)
@settings(max_examples=20)
def test_the_sum_matches_an_oracle(seed):
    """At the pose that it was made for: kappa is the one from there."""
    pose = pose_of(view_of(seed))
    utility = real.soft_utility(room(2), grid(), CAMERA, pose, SCORING)
    found = float(utility(pose))
    assert found == pytest.approx(by_hand(utility, np.asarray(pose, np.float64)), rel=1e-4)


def assert_exact(seed: int, num_surfaces: int = 1, slack: float = 0.03) -> None:
    """With hard borders it is the utility; a coarser buffer decides about points at its edges."""
    pose = pose_of(view_of(seed))
    known = (room(num_surfaces), grid(), CAMERA, pose, SCORING)
    found = float(real.soft_utility(*known, softness=CRISP)(pose))
    wanted = float(view_utility(*known).total)
    assert wanted > 20.0
    assert found == pytest.approx(wanted, abs=2.0 * float(SCORING.lambda1) + slack * wanted)


@given(seeds)
@settings(max_examples=20)
def test_without_softness_it_is_the_utility(seed):
    assert_exact(seed)


@given(seeds)
@settings(max_examples=20)
def test_what_the_plate_hides_is_left_out(seed):
    assert_exact(seed, num_surfaces=2, slack=0.1)


@given(seeds)
@settings(max_examples=30)
def test_a_sample_counts_for_all(seed):
    """Of 300, at most 64: each chosen, none twice, and together they count for all."""
    rng = np.random.default_rng(seed)
    chosen = rng.random(300) < rng.random()
    index, each_one = (np.asarray(x) for x in real._sample(jnp.asarray(chosen), 64))
    kept, count = index[each_one > 0.0], int(chosen.sum())
    assert chosen[kept].all()
    assert len(set(kept.tolist())) == len(kept)
    assert each_one.sum() == pytest.approx(count, abs=float(each_one.max()))
    if count <= 64:
        assert set(kept.tolist()) == set(np.flatnonzero(chosen).tolist())
    else:  # evenly: no gap is twice another
        gaps = np.diff(np.searchsorted(np.flatnonzero(chosen), kept))
        assert gaps.max() <= gaps.min() + 1
