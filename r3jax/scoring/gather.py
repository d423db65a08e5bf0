"""Gathers, once for all candidates, the voxels and cells that any of them may see.

Candidates of a step lie close together, so that this leaves out most of a large map.

Shape symbols: C candidates; n voxels; c cells.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import is_traced
from r3jax.geometry.selection import positions_of_set
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid, cells_of
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.visibility.views import Coordinates

SMALLEST = 1 << 16
"""Gathered voxels are padded to this number or 4, 16, ... times it. Each pair of sizes is compiled
once, which takes seconds and memory; padding costs little."""


def gather_in_range(
    state: MapState, grid: OccupancyGrid, positions: Float[Array, "C 3"], config: ScoringConfig
) -> tuple[MapState, Cells, Int[Array, " n"]]:
    """Gathers the voxels and unexplored cells that at least one of the positions may see.

    Returns:
        Voxels and cells, padded with absent ones, and each voxel's row in the map (N: padding).
    """
    if is_traced(state.key, positions):
        raise TypeError("score_views and score_positions choose array sizes: call them outside jit")
    # The box round all positions: one test per voxel, however many candidates there are.
    places = np.asarray(positions)
    low, high = places.min(axis=0), places.max(axis=0)
    # Counted first, on the host: the shapes of gathered arrays must be static.
    counts = np.asarray(_count_near(state, grid, low, high, config))
    sizes = _sizes(int(counts[0]), int(counts[1]), state.capacity, grid.log_odds.size)
    return _gather_near(state, grid, low, high, config, sizes)


def _sizes(voxels: int, cells: int, capacity: int, num_cells: int) -> tuple[int, int]:
    """Rounds numbers of voxels and cells up to one of a few pairs.

    Cells are padded to the voxels' size, or to all cells of the grid if that is less.
    """
    room = SMALLEST
    while room < min(voxels, capacity):
        room *= 4
    return min(room, capacity), num_cells if cells > room else min(room, num_cells)


def _masks(
    voxels: MapState,
    cells: Cells,
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    config: ScoringConfig,
) -> tuple[Bool[Array, " n"], Bool[Array, " c"]]:
    """Finds voxels and unexplored cells within range of a box."""

    def is_near(points: Coordinates, margin: Float[Array, ""] | float) -> Bool[Array, " k"]:
        # The distance to the box is at most that to any position in it: nothing in range is lost.
        gap = [
            jnp.maximum(jnp.maximum(low[i] - points[i], points[i] - high[i]), 0.0) for i in range(3)
        ]
        reach = config.max_range + margin
        return gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2] <= reach * reach

    # A margin of one voxel: occlusion is the same as with the whole map.
    near_voxels = voxels.present & is_near(voxels.center, voxels.voxel_size)
    near_cells = cells.unexplored & is_near((cells.x, cells.y, cells.z), 0.0)
    return near_voxels, near_cells


@jax.jit
def _count_near(
    state: MapState,
    grid: OccupancyGrid,
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    config: ScoringConfig,
) -> Int[Array, " 2"]:
    masks = _masks(state, cells_of(grid), low, high, config)
    return jnp.stack([jnp.sum(mask, dtype=jnp.int32) for mask in masks])


@functools.partial(jax.jit, static_argnames="sizes")
def _gather_near(
    state: MapState,
    grid: OccupancyGrid,
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    config: ScoringConfig,
    sizes: tuple[int, int],
) -> tuple[MapState, Cells, Int[Array, " n"]]:
    cells = cells_of(grid)
    gathered, indices = [], []
    masks = _masks(state, cells, low, high, config)
    for items, mask, size in zip((state, cells), masks, sizes, strict=True):
        index = positions_of_set(mask, size)
        gathered.append(items.take(jnp.minimum(index, mask.shape[0] - 1), index < mask.shape[0]))
        indices.append(index)
    return *gathered, indices[0]
