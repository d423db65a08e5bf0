"""Views that a place may offer: where nothing is known to stand in the way."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.forecast import forecast as real
from r3jax.mapping.occupancy import OccupancyGrid, empty_grid

SHAPE, CELL, ORIGIN = (22, 18, 10), 0.2, -0.2  # a cell more on every side of the box
BOUNDS = np.array([[0.0, 0.0, 0.0], [4.0, 3.2, 1.6]])
seeds = st.integers(0, 1000)


def grid_of(free: np.ndarray, occupied: np.ndarray) -> OccupancyGrid:
    log_odds = np.where(occupied, 4.0, np.where(free, -4.0, 0.0)).astype(np.float32)
    grid = empty_grid(BOUNDS, CELL)
    assert grid.log_odds.shape == SHAPE
    return eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(log_odds))


def random_grid(seed: int) -> OccupancyGrid:
    rng = np.random.default_rng(seed)
    occupied = rng.random(SHAPE) < 0.01
    free = np.zeros(SHAPE, dtype=bool)
    x, y, z = rng.integers([3, 3, 3], [16, 12, 7])
    free[x - 2 : x + 4, y - 2 : y + 4, z - 2 : z + 3] = True
    return grid_of(free & ~occupied, occupied)


@given(seeds)
def test_views_keep_their_distance(seed):
    """Every view keeps 0.3 m from every occupied cell (brute force), and can be come to."""
    grid = random_grid(seed)
    poses = real.free_space_views(grid, 40)
    corners = np.argwhere(np.asarray(grid.occupied)) * CELL + ORIGIN
    possible = real.possible_cells(grid)
    for position in poses[:, :3, 3].astype(np.float64):
        cell = np.minimum((position - ORIGIN) / CELL, np.array(SHAPE) - 1).astype(int)
        center = (cell + 0.5) * CELL + ORIGIN
        gap = np.maximum(np.maximum(corners - center, center - corners - CELL), 0.0)
        assert np.linalg.norm(gap, axis=1).min() > 0.3 - 1e-6
        assert possible[tuple(cell)]


def test_a_wall_closes_and_a_door_opens():
    """A wall across the box: what is behind it cannot be come to, unless there is a door."""
    occupied, free = np.zeros(SHAPE, dtype=bool), np.zeros(SHAPE, dtype=bool)
    occupied[10] = True
    free[3:6, 4:8, 2:6] = True
    closed = real.possible_cells(grid_of(free, occupied))
    assert closed[:8].any()
    assert not closed[10:].any()
    occupied[10, 4:10, 1:7] = False
    opened = real.possible_cells(grid_of(free, occupied))
    assert opened[13:].any()
    assert not real.possible_cells(grid_of(np.zeros(SHAPE, bool), occupied)).any()
    views = real.free_space_views(grid_of(free, occupied), 60)
    assert (views[:, 0, 3] > 2.6).any()
    # Six directions, all of them, and only along axes.
    forward = views[:, :3, 2]
    assert set(np.abs(forward).max(axis=1)) == {1.0}
    assert len(np.unique(forward, axis=0)) == 6


def test_views_are_a_fixed_sequence():
    """Fewer views are the first of more; where nothing is known to be free there is none."""
    grid = random_grid(3)
    many = real.free_space_views(grid, 60)
    np.testing.assert_array_equal(real.free_space_views(grid, 20), many[:20])
    assert many.shape == (60, 4, 4)
    assert many.dtype == np.float32
    assert real.free_space_views(empty_grid(BOUNDS, CELL), 20).shape == (0, 4, 4)
