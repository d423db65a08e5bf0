"""Panoramas and utilities against float64 sums over a world that can be counted by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.scoring.batch import score_positions, score_views

CAPACITY = 1 << 12
LAMBDA1 = 3.0
LATTICE = fibonacci_lattice(526)
POSITION = jnp.array([0.013, -0.021, 0.017], dtype=jnp.float32)
CONFIG = r3jax.ScoringConfig(lambda1=LAMBDA1)


def axes_of(forward: np.ndarray) -> np.ndarray:
    """Right, down and forward of a level camera, as rows."""
    right = np.array([forward[1], -forward[0], 0.0])
    norm = np.linalg.norm(right)
    right = right / norm if norm > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def in_view(offsets: np.ndarray, forward: np.ndarray, camera: r3jax.Camera) -> np.ndarray:
    """True for offsets from the camera inside its rectangular field of view."""
    x, y, z = axes_of(forward) @ offsets.T
    z_safe = np.where(z > 0.0, z, 1.0)
    column = float(camera.fx) * x / z_safe + float(camera.cx)
    row = float(camera.fy) * y / z_safe + float(camera.cy)
    is_in = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return is_in & (z > 0.0)


def nearest_bins(offsets: np.ndarray) -> np.ndarray:
    return np.argmax(offsets / np.linalg.norm(offsets, axis=1, keepdims=True) @ LATTICE.T, axis=1)


class World:
    """Lone voxels in front (+x), none before another; unexplored cells behind."""

    def __init__(self) -> None:
        directions = fibonacci_lattice(200)
        directions = directions[directions[:, 0] > 0.35]
        distances = np.random.default_rng(0).uniform(1.5, 3.0, len(directions))
        points = (np.asarray(POSITION) + directions * distances[:, None]).astype(np.float32)
        colors = np.random.default_rng(1).random((2, len(points), 3)).astype(np.float32)
        m = r3jax.empty_map(CAPACITY)
        m = r3jax.integrate_points(m, points, colors[0], np.array([1.0, 2.0, 0.5]), focal=90.0)
        self.map = r3jax.integrate_points(m, points, colors[1], np.array([0.5, -2.0, 0.9]), 90.0)
        self.rows = np.asarray(r3jax.lookup(self.map, jnp.asarray(points)))
        self.centers = (np.floor(points.astype(np.float64) / 0.05) + 0.5) * 0.05
        log_odds = np.random.default_rng(2).choice([-3.0, 0.0, 3.0], (8, 12, 10))
        self.origin = np.array([-2.6, -1.2, -1.0])
        self.grid = OccupancyGrid(
            jnp.asarray(log_odds, jnp.float32),
            jnp.asarray(self.origin, jnp.float32),
            jnp.asarray(0.2, jnp.float32),
        )
        self.cells = self.origin + (np.argwhere(log_odds == 0.0) + 0.5) * 0.2

    def lack(self, camera: r3jax.Camera) -> np.ndarray:
        value = r3jax.voxel_renderability(self.map, POSITION, camera.focal).value
        return 1.0 - np.asarray(value, np.float64)[self.rows]


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.fixture(scope="module")
def camera():
    return r3jax.Camera(90, 71, 80.3, 76.7, 46.1, 34.3)  # nothing symmetric, nothing on an edge


@pytest.fixture(scope="module")
def found(world, camera):
    return r3jax.panorama(world.map, world.grid, camera, POSITION, CONFIG)


def expected_bins(world, camera):
    bins = np.zeros(len(LATTICE))
    np.add.at(bins, nearest_bins(world.centers - np.asarray(POSITION)), world.lack(camera))
    np.add.at(bins, nearest_bins(world.cells - np.asarray(POSITION)), LAMBDA1)
    return bins


def test_bins_collect_what_lies_in_their_direction(world, camera, found):
    np.testing.assert_allclose(found.bin_scores, expected_bins(world, camera), atol=1e-4)


def test_directions_sum_the_bins_in_their_field_of_view(world, camera, found):
    bins = expected_bins(world, camera)
    sums = np.array([bins[in_view(LATTICE, q, camera)].sum() for q in LATTICE])
    np.testing.assert_allclose(found.direction_scores, sums, atol=1e-2)
    best = int(np.argmax(sums))
    np.testing.assert_allclose(found.best_direction, LATTICE[best], atol=1e-6)
    assert float(found.best_score) == pytest.approx(sums[best], abs=1e-2)
    np.testing.assert_allclose(found.T_world_camera[:3, :3].T, axes_of(LATTICE[best]), atol=1e-5)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.9, 0.5, 0.2), (-1.0, 0.1, -0.2)])
def test_a_view_counts_what_is_in_its_frustum(world, camera, direction):
    forward = np.array(direction) / np.linalg.norm(direction)
    pose = r3jax.pose_along(POSITION, jnp.asarray(forward, jnp.float32))
    utility = r3jax.view_utility(world.map, world.grid, camera, pose, CONFIG)
    is_seen = in_view(world.centers - np.asarray(POSITION), forward, camera)
    num_cells = in_view(world.cells - np.asarray(POSITION), forward, camera).sum()
    lack = world.lack(camera)[is_seen].sum()
    assert float(utility.exploration) == num_cells
    assert float(utility.rendering) == pytest.approx(lack, abs=1e-3)
    assert float(utility.total) == pytest.approx(LAMBDA1 * num_cells + lack, abs=1e-2)
    assert num_cells + is_seen.sum() > 0


def test_the_best_score_is_close_to_its_view(world, camera, found):
    pose = found.T_world_camera
    total = float(r3jax.view_utility(world.map, world.grid, camera, pose, CONFIG).total)
    assert float(found.best_score) == pytest.approx(total, rel=0.15)


def test_out_of_range_counts_nothing(world, camera):
    near = r3jax.ScoringConfig(lambda1=LAMBDA1, max_range=1.2)
    found = r3jax.panorama(world.map, world.grid, camera, POSITION, near)
    distance = np.linalg.norm(world.cells - np.asarray(POSITION), axis=1)
    assert float(found.bin_scores.sum()) == LAMBDA1 * (distance <= 1.2).sum() > 0.0


def test_cells_behind_a_wall_do_not_count(world, camera):
    steps = np.arange(-2.5, 2.5, 0.0125)
    y, z = (x.reshape(-1) for x in np.meshgrid(steps, steps))
    wall = np.stack([np.full_like(y, -0.52), y, z], axis=1).astype(np.float32)
    m = r3jax.integrate_points(
        r3jax.empty_map(1 << 14), wall, np.full_like(wall, 0.5), POSITION, focal=90.0
    )
    forward = jnp.array([-1.0, 0.0, 0.0])
    pose = r3jax.pose_along(POSITION, forward)
    free = r3jax.view_utility(world.map, world.grid, camera, pose, CONFIG)
    hidden = r3jax.view_utility(m, world.grid, camera, pose, CONFIG)
    assert float(free.exploration) > 50
    assert float(hidden.exploration) == 0.0


def test_batches_equal_single_calls(world, camera):
    shifts = np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 0.1], [-0.1, 0.3, 0.0]], np.float32)
    positions = POSITION[None] + shifts
    poses = jax.vmap(lambda p: r3jax.pose_along(p, jnp.array([1.0, 0.2, 0.1])))(positions)
    arguments = (world.map, world.grid, camera)
    views = score_views(*arguments, poses, CONFIG)
    panoramas = score_positions(*arguments, positions, CONFIG)
    for i in range(len(shifts)):
        single = r3jax.view_utility(*arguments, poses[i], CONFIG)
        assert float(views.exploration[i]) == float(single.exploration)
        assert float(views.total[i]) == pytest.approx(float(single.total), abs=1e-3)
        alone = r3jax.panorama(*arguments, positions[i], CONFIG)
        np.testing.assert_allclose(panoramas.bin_scores[i], alone.bin_scores, atol=1e-4)
        np.testing.assert_array_equal(panoramas.best_direction[i], alone.best_direction)
