"""The smooth stand-in for the utility: a float64 oracle, its slope, and the utility itself.

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
from r3jax.planning.refinement.climb import rotation_of
from r3jax.scoring import surrogate as real
from r3jax.scoring.cells import cells_of
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import utility_of_view

pytestmark = pytest.mark.full

VOXEL, CAPACITY = 0.1, 1 << 11  # one shape: one compile
CAMERA = Camera(96, 72, 90.0, 84.0, 45.0, 37.5)
SCORING = ScoringConfig(max_range=2.4, zbuffer_size=96, lambda1=4.0)
MIDDLE = np.array([0.0, 0.0, 1.25])
BOX = np.array([0.3, 0.35, 0.2])
"""Half of the box of positions [m]."""

CRISP = real.Softness(angle=1e-4, depth=1e-3)
SOFT = real.Softness()
seeds = st.integers(0, 10_000)


def surface(x: float, y: tuple[float, float], z: tuple[float, float]) -> np.ndarray:
    """Centers of a sheet of voxels [n, 3] [m]."""
    at = lambda ends: (np.arange(round(ends[0] / VOXEL), round(ends[1] / VOXEL)) + 0.5) * VOXEL
    return np.stack(np.meshgrid([x + 0.5 * VOXEL], at(y), at(z), indexing="ij"), -1).reshape(-1, 3)


def voxels_with(*surfaces: np.ndarray):
    """Each seen from its own place, so that they lack more or less."""
    state = r3jax.empty_map(CAPACITY, VOXEL)
    for number, points in enumerate(surfaces):
        padded = np.resize(points, (900, 3)).astype(np.float32)
        eye = np.array([0.5 - number, -3.0, 1.0], np.float32)
        state = r3jax.integrate_points(state, padded, np.full_like(padded, 0.5), eye, 84.0)
    return state


def cells_where(unexplored) -> object:
    """Cells of a box round everything; `unexplored` takes their centers x, y, z."""
    origin, shape = np.array([-2.5, -2.5, 0.0]), (25, 25, 13)
    x, y, z = origin[:, None, None, None] + 0.2 * (np.indices(shape) + 0.5)
    log_odds = jnp.asarray(np.where(unexplored(x, y, z), 0.0, -3.0), jnp.float32)
    grid = OccupancyGrid(log_odds, jnp.asarray(origin, jnp.float32), jnp.asarray(0.2, jnp.float32))
    return cells_of(grid)


WALL = surface(2.0, (-1.2, 1.2), (0.1, 2.5))
PLATE = surface(1.0, (0.1, 0.6), (0.9, 1.6))


@functools.cache
def bare():
    return voxels_with(WALL)


@functools.cache
def hidden():
    return voxels_with(WALL, PLATE)


@functools.cache
def cells():
    return cells_where(lambda x, y, z: (y < -0.9) & (x < 1.8))


def numbers_of(seed: int, reach: float = 1.0) -> np.ndarray:
    """A view from the box: position, azimuth and elevation."""
    rng = np.random.default_rng(seed)
    return np.concatenate([MIDDLE + rng.uniform(-reach, reach, 3) * BOX, rng.uniform(-0.3, 0.3, 2)])


def pose_of(numbers: np.ndarray) -> jax.Array:
    axes = rotation_of(*jnp.asarray(numbers[3:], jnp.float32))
    position = jnp.asarray(numbers[:3], jnp.float32)
    return jnp.eye(4).at[:3, :3].set(axes).at[:3, 3].set(position)


class Stand:
    """The functions of a module, jitted."""

    def __init__(self, soft) -> None:
        def around(voxels, cells, softness, half):
            middle, start = jnp.asarray(MIDDLE, jnp.float32), pose_of(np.append(MIDDLE, (0.0, 0.0)))
            return soft.surrogate_of(
                voxels, cells, CAMERA, start, middle - half, middle + half, SCORING, softness
            )

        def value(around, numbers, softness):
            axes = rotation_of(numbers[3], numbers[4])
            return soft.soft_utility(around, CAMERA, numbers[:3], axes, softness)

        self.around = jax.jit(around)
        self.value = jax.jit(value)
        self.slope = jax.jit(jax.grad(value, argnums=1))


STAND = Stand(real)
HALF = jnp.asarray(BOX, jnp.float32)
exact = jax.jit(utility_of_view)


def by_hand(around, numbers: np.ndarray, angle: float) -> float:
    """The sum over all points in float64: parabola, cut off, times four sigmoids."""
    worth = np.asarray(around.worth, np.float64)
    t = (numbers[:3] - MIDDLE) / BOX
    total = worth[0].copy()
    for axis in range(3):
        a, b = worth[1 + 2 * axis], worth[2 + 2 * axis]
        # Through (-1, a), (0, middle), (1, b), by Lagrange.
        p = t[axis]
        line = 0.5 * p * (p - 1) * a + (1 - p) * (1 + p) * worth[0] + 0.5 * p * (p + 1) * b
        total += line - worth[0]
    total = np.minimum(np.maximum(total, worth.min(axis=0)), worth.max(axis=0))
    points = np.stack([np.asarray(v, np.float64) for v in (around.x, around.y, around.z)], axis=1)
    azimuth, elevation = numbers[3:]
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    seen = (points - numbers[:3]) @ np.stack([right, np.cross(forward, right), forward], axis=1)
    inside = np.ones(len(points))
    corners = [
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]
        for u, v in ((0, 0), (CAMERA.width, 0), (CAMERA.width, CAMERA.height), (0, CAMERA.height))
    ]
    for k in range(4):  # planes through the camera and an edge of the image
        normal = np.cross(np.array(corners[k], float), np.array(corners[(k + 1) % 4], float))
        sine = seen @ normal / np.linalg.norm(normal) / np.linalg.norm(seen, axis=1)
        inside = inside / (1.0 + np.exp(-np.clip(sine / angle, -500, 500)))
    return float((inside * total).sum())


def law_oracle(seed: int = 0) -> None:
    stand = STAND
    around = stand.around(hidden(), cells(), SOFT, HALF)
    numbers = numbers_of(seed)
    found = float(stand.value(around, jnp.asarray(numbers, jnp.float32), SOFT))
    assert found == pytest.approx(by_hand(around, numbers, float(SOFT.angle)), rel=1e-4)


@given(seeds)
def test_the_sum_matches_an_oracle(seed):
    law_oracle(seed)


@given(seeds)
def test_the_slope_is_that_of_finite_differences(seed):
    """In float64, of the oracle."""
    around = STAND.around(hidden(), cells(), SOFT, HALF)
    numbers, step = numbers_of(seed, 0.9), 1e-5
    found = np.asarray(STAND.slope(around, jnp.asarray(numbers, jnp.float32), SOFT))
    angle = float(SOFT.angle)
    wanted = [
        (by_hand(around, numbers + e, angle) - by_hand(around, numbers - e, angle)) / (2 * step)
        for e in step * np.eye(5)
    ]
    np.testing.assert_allclose(found, wanted, atol=5e-3 * np.abs(wanted).max())


def on_the_border(around, numbers: np.ndarray) -> float:
    """The worth of points so near to the image's border or the range that a rounding decides."""
    near = by_hand(around, numbers, 2e-3) - by_hand(around, numbers, 1e-4)
    points = np.stack([np.asarray(v, np.float64) for v in (around.x, around.y, around.z)], axis=1)
    distance = np.linalg.norm(points - numbers[:3], axis=1)
    at_range = np.abs(distance - float(SCORING.max_range)) < 2e-3
    return abs(near) + float(np.asarray(around.worth).max(axis=0)[at_range].sum())


def law_exact(seed: int = 0) -> None:
    """Nothing hides, hard borders: from the middle of the box it is the utility of any view."""
    stand = STAND
    numbers = numbers_of(seed, 0.0)
    around = stand.around(bare(), cells(), CRISP, HALF)
    found = float(stand.value(around, jnp.asarray(numbers, jnp.float32), CRISP))
    wanted = float(exact(bare(), cells(), CAMERA, pose_of(numbers), SCORING).total)
    slack = on_the_border(around, numbers) + 0.5 * float(SCORING.lambda1)
    assert wanted > 50.0
    assert found == pytest.approx(wanted, abs=slack + 0.01 * wanted)


@given(seeds)
@settings(max_examples=20)
def test_without_softness_it_is_the_utility(seed):
    law_exact(seed)


def test_at_the_nodes_it_is_the_utility() -> None:
    """Behind a plate, from the middle and from every side: what the plate hides there is left out.

    It hides a third of what is in view. The buffers are wider and so coarser: along the plate's
    edges they differ by a voxel.
    """
    stand = STAND
    around = stand.around(hidden(), cells(), CRISP, HALF)
    sides = [np.zeros(3), *(s * BOX * np.eye(3)[i] for i in range(3) for s in (-1.0, 1.0))]
    found, wanted = [], []
    for side in sides:
        numbers = np.concatenate([MIDDLE + side, [0.1, 0.0]])
        found.append(float(stand.value(around, jnp.asarray(numbers, jnp.float32), CRISP)))
        view = exact(hidden(), cells(), CAMERA, pose_of(numbers), SCORING)
        wanted.append(float(view.total))
    np.testing.assert_allclose(found, wanted, rtol=0.15)
    assert np.ptp(wanted) > 0.5 * wanted[0]
    assert np.corrcoef(found, wanted)[0, 1] > 0.93


def law_sample(seed: int = 0) -> None:
    """Of 300, at most 64: each chosen, none twice, and together they count for all."""
    rng = np.random.default_rng(seed)
    chosen = rng.random(300) < rng.random()
    index, is_real, each_one = real._sample(jnp.asarray(chosen), 64)
    kept, count = np.asarray(index)[np.asarray(is_real)], int(chosen.sum())
    assert chosen[kept].all()
    assert len(set(kept.tolist())) == len(kept)
    assert len(kept) * float(each_one) == pytest.approx(count, abs=float(each_one))
    if count <= 64:
        assert set(kept.tolist()) == set(np.flatnonzero(chosen).tolist())
        assert float(each_one) == 1.0
    else:  # evenly: no gap is twice another
        gaps = np.diff(np.searchsorted(np.flatnonzero(chosen), kept))
        assert gaps.max() <= gaps.min() + 1


@given(seeds)
@settings(max_examples=30)
def test_a_sample_counts_for_all(seed):
    law_sample(seed)


def test_a_camera_that_stays_needs_one_node():
    start = pose_of(np.append(MIDDLE, (0.0, 0.0)))
    place = jnp.asarray(MIDDLE, jnp.float32)
    look = jax.jit(real.surrogate_of, static_argnames="moves")
    args = (hidden(), cells(), CAMERA, start, place, place, SCORING, SOFT)
    still, moving = look(*args, moves=False), look(*args)
    assert still.worth.shape[0] == 1
    for row in moving.worth:
        np.testing.assert_allclose(row, still.worth[0], atol=1e-5)
