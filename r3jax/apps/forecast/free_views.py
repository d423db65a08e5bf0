"""Views that could be asked for once a place is known: all over the space that may be free.

While a place is being explored, nobody knows its free space: what is known to be free is too
little, and a forecast over it alone would be content with the first room. So the views stand
wherever the space is free or unexplored, connects to what is known to be free, and keeps its
distance from everything known to be occupied. That is too much while much is unexplored (the
forecast is then too low), and settles as the place becomes known.

The views are those of the referee's test sets: in one of six directions, along the axes.

Shape symbols: V views; X Y Z cells.
"""

import functools

import numpy as np
from scipy import ndimage
from scipy.stats import qmc

from r3jax.geometry.axis_views import LOOKS, poses_at
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.travel import safe_cells

MARGIN = 0.3
"""Of the views to what is occupied [m], as in the referee's test sets."""

_NUM_DRAWN = 1 << 14
"""Positions drawn over the scene's box; most of them lie in walls or outside."""

_FACES = ndimage.generate_binary_structure(3, 1)


def possible_cells(grid: OccupancyGrid, margin: float = MARGIN) -> np.ndarray:
    """Cells that a camera may stand in, for all that is known, [X, Y, Z] bool.

    None of them comes nearer than `margin` [m] to an occupied cell or to the end of the grid, and
    each connects over others of them to one that is known to be free.
    """
    open_cells = safe_cells(~np.asarray(grid.occupied), float(grid.cell_size), margin)
    labels = np.zeros(open_cells.shape, dtype=np.int32)
    ndimage.label(open_cells, _FACES, output=labels)
    reached = np.unique(labels[np.asarray(grid.free) & open_cells])
    return np.isin(labels, reached[reached > 0])


def free_space_views(grid: OccupancyGrid, num: int) -> np.ndarray:
    """The first `num` views of a fixed sequence over the grid that stand in possible cells.

    Args:
        grid: what is known.
        num: views at most; there are fewer where hardly anything is open.

    Returns:
        `T_world_camera`, [V, 4, 4] float32, without roll.
    """
    origin, size = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    shape = np.asarray(grid.log_odds.shape)
    unit = _sequence()
    cells = np.minimum(unit[:, :3] * shape, shape - 1).astype(int)
    chosen = np.flatnonzero(possible_cells(grid)[tuple(cells.T)])[:num]
    positions = origin + unit[chosen, :3] * shape * size
    looks = np.asarray(LOOKS)[(len(LOOKS) * unit[chosen, 3]).astype(int)]
    return poses_at(positions, looks).astype(np.float32)


@functools.cache
def _sequence() -> np.ndarray:
    """Positions and directions in the unit cube, evenly spread, [n, 4]; the same for every run."""
    return qmc.Sobol(d=4, scramble=False).random(_NUM_DRAWN)
