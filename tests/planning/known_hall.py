"""A small hall, a third of it known: a map and a grid for policies that weigh views."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import r3jax
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.config import PlannerConfig
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.travel import safe_cells
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import simulate_view
from r3jax.scoring.utility import visible_unexplored
from tests.exploration.hall import Hall

CAMERA = Camera.from_fov(32, 32, 70.0)
SCORING = ScoringConfig(zbuffer_size=32, panorama_size=32, max_range=4.0)
CONFIG = PlannerConfig(num_candidates=20, num_frontier=0, scoring=SCORING)
EYE = np.array([1.0, 0.9, 1.2])
"""Where it was seen from [m]."""

Known = tuple[MapState, OccupancyGrid]


@functools.cache
def known() -> Known:
    """What three views from one place show."""
    hall = Hall((4.0, 3.0, 2.4), Camera.from_fov(48, 48, 90.0))
    state = r3jax.empty_map(1 << 13, 0.08)
    grid = r3jax.empty_grid(hall.bounds, 0.2)
    for direction in ([1.0, 1.0, 0.0], [1.0, -0.2, -0.3], [0.2, 1.0, 0.2]):
        pose = pose_along(jnp.asarray(EYE, jnp.float32), jnp.asarray(direction))
        frame = hall.render(np.asarray(pose, np.float64))
        state = r3jax.integrate(state, frame)
        grid = r3jax.integrate_depth(grid, frame)
    return state, grid


def safe_mask() -> np.ndarray:
    """Cells that keep the margin, [X, Y, Z] bool."""
    return safe_cells(np.asarray(known()[1].free), 0.2, CONFIG.safety_margin)


def for_scoring() -> Known:
    """The map, and the grid without unexplored cells that nobody can look at."""
    state, grid = known()
    return state, mask_unexplorable(grid, safe_mask())


def after_view(world: Known, T: Array) -> Known:
    """What is known after an imagined view, with every row of the map and every cell."""
    state, grid = world
    shown = visible_unexplored(state, grid, CAMERA, T, SCORING)
    state, _ = simulate_view(state, CAMERA, T, SCORING)
    return state, grid.ignoring(shown)
