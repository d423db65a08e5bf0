"""Small known worlds for the planning tests."""

import functools

import jax.numpy as jnp
import numpy as np

import r3jax
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates, candidates_along

CELL = 0.2
ORIGIN = np.array([-1.0, 2.0, 0.5])


def grid_of(free: np.ndarray, occupied: np.ndarray | None = None) -> OccupancyGrid:
    """A grid in which the given cells are known; all others are unexplored."""
    log_odds = np.where(free, -3.0, 0.0)
    if occupied is not None:
        log_odds = np.where(occupied, 3.0, log_odds)
    return OccupancyGrid(
        log_odds=jnp.asarray(log_odds, jnp.float32),
        origin=jnp.asarray(ORIGIN, jnp.float32),
        cell_size=jnp.asarray(CELL, jnp.float32),
    )


def center(*cell: float) -> np.ndarray:
    """Center of a cell in the world [m]."""
    return ORIGIN + (np.array(cell, float) + 0.5) * CELL


def pose_at(position: np.ndarray) -> np.ndarray:
    """A pose there; where it looks does not matter."""
    T = np.eye(4)
    T[:3, 3] = position
    return T


def candidates_of(poses: np.ndarray) -> Candidates:
    """The candidates with these poses, [C, 4, 4]."""
    return candidates_along(poses[:, :3, 3], poses[:, :3, 2])


def two_rooms() -> tuple[np.ndarray, np.ndarray]:
    """Two rooms with a doorway of five cells between them: the free and the occupied cells.

    Walls are at x = 0, 12, 24 and round the outside; the door spans y = 4..8 and z = 1..7.
    """
    free = np.zeros((25, 14, 10), dtype=bool)
    free[1:12, 1:13, 1:9] = True
    free[13:24, 1:13, 1:9] = True
    free[12, 4:9, 1:8] = True
    return free, ~free


@functools.cache
def known_flat() -> tuple[MapState, OccupancyGrid]:
    """Two rooms, the far half of the second unknown, with voxels on the walls that are known."""
    free, walls = two_rooms()
    known = (np.arange(25) < 18)[:, None, None]
    free, walls = free & known, walls & known
    free[8:10, 1:9, 3], walls[8:10, 1:9, 3] = False, True  # a table
    points = (np.argwhere(walls) + 0.5) * CELL + ORIGIN
    state = r3jax.integrate_points(
        r3jax.empty_map(1 << 12, 0.1),
        points.astype(np.float32),
        np.full(points.shape, 0.5, np.float32),
        center(6, 6, 4).astype(np.float32),
    )
    return state, grid_of(free, walls)
