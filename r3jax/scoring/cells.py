"""Visible unexplored cells of the coarse grid: the exploration side of a view.

Shape symbols: c cells of the grid.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.mapping.occupancy import OccupancyGrid


def unexplored_cells(grid: OccupancyGrid) -> tuple[Float[Array, "3 c"], Bool[Array, " c"]]:
    """Centers of all cells [m], and which of them are unexplored."""
    axes = [
        grid.origin[i] + (jnp.arange(n, dtype=jnp.float32) + 0.5) * grid.cell_size
        for i, n in enumerate(grid.log_odds.shape)
    ]
    shape = grid.log_odds.shape
    reshaped = (axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :])
    center = jnp.stack([jnp.broadcast_to(axis, shape).reshape(-1) for axis in reshaped])
    return center, grid.unexplored.reshape(-1)
