"""Visible unexplored cells of the coarse grid: the exploration side of a view.

Shape symbols: X Y Z cells of the grid; c cells at hand; B bins of the panorama.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.visibility.depth_buffer import DepthBuffer, is_visible
from r3jax.visibility.selection import Selection, narrow, select
from r3jax.visibility.views import View


class Cells(eqx.Module):
    """Some or all cells of a grid. The coordinates are apart: XLA fills each in one sweep."""

    x: Float[Array, " c"]
    """Center [m]."""

    y: Float[Array, " c"]
    """Center [m]."""

    z: Float[Array, " c"]
    """Center [m]."""

    unexplored: Bool[Array, " c"]
    """False for cells that are known, and for padding."""

    def take(self, index: Int[Array, " k"], valid: Bool[Array, " k"]) -> "Cells":
        """The cells at `index`; not unexplored where `valid` is False."""
        part = (self.x[index], self.y[index], self.z[index])
        return Cells(*part, valid & self.unexplored[index])


def cells_of(grid: OccupancyGrid) -> Cells:
    """All cells of a grid, z fastest."""
    shape = grid.log_odds.shape
    x, y, z = (
        grid.origin[i] + (jnp.arange(n, dtype=jnp.float32) + 0.5) * grid.cell_size
        for i, n in enumerate(shape)
    )
    fill: Callable[[Array], Array] = lambda axis: jnp.broadcast_to(axis, shape).reshape(-1)
    return Cells(
        fill(x[:, None, None]),
        fill(y[None, :, None]),
        fill(z[None, None, :]),
        grid.unexplored.reshape(-1),
    )


def visible_cells(
    cells: Cells, view: View, buffer: DepthBuffer, among: Selection | None = None
) -> Selection:
    """The unexplored cells whose center the view sees; `among`: which it may see, if known."""

    def test(index: Int[Array, " n"]) -> Bool[Array, " n"]:
        points = jnp.stack([cells.x[index], cells.y[index], cells.z[index]])
        # Before the surface itself: the slack behind it is for voxels that belong to it.
        return is_visible(view, view.place(points), buffer.distance)

    if among is None:
        in_view = view.may_see((cells.x, cells.y, cells.z), jnp.zeros(()))
        among = select(cells.unexplored & in_view)
    return narrow(among, test)
