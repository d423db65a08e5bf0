"""A wall of voxels in a small unexplored box: what policies that score pixels are asked about."""

import jax.numpy as jnp
import numpy as np

import r3jax
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Situation
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.travel import plan_travel
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import view_utility

VOXEL = 0.1
CAMERA = Camera.from_fov(32, 32, 60.0)
SCORING = ScoringConfig(max_range=4.0, zbuffer_size=32)
SEEN_FROM = np.array([0.0, 0.0, 1.25])
"""Where the wall was seen from, straight ahead; the robot stands here."""


def config(num_candidates: int) -> PlannerConfig:
    return PlannerConfig(num_candidates=num_candidates, num_frontier=0, scoring=SCORING)


def wall() -> MapState:
    """2.5 m x 2.5 m at x = 2, in one look."""
    y, z = np.meshgrid(np.arange(-12, 13), np.arange(0, 25))
    index = np.stack([np.full(y.size, 20), y.ravel(), z.ravel()], axis=1)
    points = ((index + 0.5) * VOXEL).astype(np.float32)
    return r3jax.integrate_points(
        r3jax.empty_map(1 << 10, VOXEL),
        points,
        np.full_like(points, 0.5),
        SEEN_FROM.astype(np.float32),
    )


def box(unexplored_from_y: float) -> OccupancyGrid:
    """Free space round the robot; from some y on nothing is known."""
    shape = (25, 25, 13)
    y = -2.5 + 0.2 * (np.arange(25) + 0.5)
    log_odds = np.where(y < unexplored_from_y, -3.0, 0.0)[None, :, None] * np.ones(shape)
    return OccupancyGrid(
        log_odds=jnp.asarray(log_odds, jnp.float32),
        origin=jnp.asarray([-2.5, -2.5, 0.0], jnp.float32),
        cell_size=jnp.asarray(0.2, jnp.float32),
    )


def situation(map_state: MapState, grid: OccupancyGrid) -> Situation:
    """What a policy knows when the robot stands where it saw the wall from."""
    travel = plan_travel(grid, SEEN_FROM)
    masked = mask_unexplorable(grid, travel.reachable)
    return Situation(map_state, grid, masked, travel, CAMERA, None)


def cells_in_view(where: Situation, poses: np.ndarray) -> np.ndarray:
    """U_G of every pose, [C]."""
    score = lambda pose: view_utility(where.map_state, where.scoring_grid, CAMERA, pose, SCORING)
    return np.array([float(score(jnp.asarray(p, jnp.float32)).exploration) for p in poses])
