"""Scores of many candidates against one map: the inner loop of planning.

Shape symbols: C candidates.
"""

import functools

import jax
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import Panorama, panorama_of
from r3jax.scoring.utility import ViewUtility, utility_of_view
from r3jax.scoring.voxels import voxels_of


@jax.jit
def score_views(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    poses: Float[Array, "C 4 4"],
    config: ScoringConfig,
) -> ViewUtility:
    """`view_utility` of every pose; fields of shape [C]."""
    voxels = voxels_of(state, config.delta)
    score = functools.partial(utility_of_view, voxels, grid, camera, config=config)
    return jax.lax.map(score, poses)


@jax.jit
def score_positions(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
) -> Panorama:
    """`panorama` of every position; fields of shape [C, ...]."""
    voxels = voxels_of(state, config.delta)
    score = functools.partial(panorama_of, voxels, grid, camera, config=config)
    return jax.lax.map(score, positions)
