"""Visible unexplored cells of the coarse grid: the exploration side of a view.

Shape symbols: X Y Z cells of the grid; c all cells; B bins of the panorama.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.scoring.chunks import for_selected, select
from r3jax.scoring.lack import sum_by_direction
from r3jax.scoring.visibility import DepthBuffer, View, is_visible


def cell_points(grid: OccupancyGrid) -> Float[Array, "3 c"]:
    """Centers of all cells [m], z fastest."""
    shape = grid.log_odds.shape
    axes = [
        grid.origin[i] + (jnp.arange(n, dtype=jnp.float32) + 0.5) * grid.cell_size
        for i, n in enumerate(shape)
    ]
    along = (axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :])
    return jnp.stack([jnp.broadcast_to(axis, shape).reshape(-1) for axis in along])


def unexplored_by_direction(
    grid: OccupancyGrid,
    view: View,
    buffer: DepthBuffer,
    position: Float[Array, " 3"],
    num_bins: int,
) -> Float[Array, " B"]:
    """U_G: number of unexplored cells whose center the view sees, per direction bin.

    Args:
        grid: the coarse grid.
        view: where from.
        buffer: what hides.
        position: of the camera [m].
        num_bins: bins of the Fibonacci lattice; 1 counts over all directions.
    """
    center = cell_points(grid)

    def count(index, valid, total):
        points = center[:, index]
        is_seen = valid & is_visible(view, view.place(points), buffer.distance)
        weight = is_seen.astype(jnp.float32)
        return total + sum_by_direction(points, weight, position, num_bins)

    selection = select(grid.unexplored.reshape(-1) & view.may_see(center, jnp.zeros(())))
    return for_selected(selection, count, jnp.zeros(num_bins, dtype=jnp.float32))
