"""Finds the unexplored cells that the robot could ever see.

The inside of walls, the ground below the floor and the outside of the building stay unexplored. A
planner that counts them would be attracted by them forever.
"""

import numpy as np

from r3jax.mapping.occupancy import OccupancyGrid


def explorable_cells(free: np.ndarray, unexplored: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Finds unexplored cells that connect, through such cells, to space the robot can enter.

    A region of unexplored cells (connected over faces) counts as a whole if one of its cells
    has a face neighbor in the *known-free reachable space*: the free cells that connect over
    faces to a cell of `reached`.

    Args:
        free: cells known to be free, [X, Y, Z] bool.
        unexplored: cells neither free nor occupied, [X, Y, Z] bool.
        reached: cells that the robot can reach, [X, Y, Z] bool; those not free are ignored.

    Returns:
        The unexplored cells that count, [X, Y, Z] bool.
    """
    # Lazy import: Numba is only loaded when a path is planned.
    from r3jax.kernels.robot.cells import flood

    # Free space seen through a window does not count: the robot cannot go there.
    open_space = flood(free, reached)
    # Grown by one cell: the two kinds of cells are adjacent but disjoint.
    return flood(unexplored, _grown(open_space))


def mask_unexplorable(
    grid: OccupancyGrid, reached: np.ndarray, exhausted: np.ndarray | None = None
) -> OccupancyGrid:
    """Masks a grid for scoring, so that only explorable cells count as unexplored.

    Args:
        grid: the grid.
        reached: cells that the robot can reach, [X, Y, Z] bool.

        exhausted: cells that were looked
            at in vain, [X, Y, Z] bool; None: there are none.
    """
    # On the host: the number of regions is not known in advance.
    free, unexplored = np.array(grid.free), np.array(grid.unexplored)
    is_hopeless = unexplored & ~explorable_cells(free, unexplored, reached)
    if exhausted is not None:
        is_hopeless |= unexplored & exhausted
    return grid.ignoring(is_hopeless)


def _grown(mask: np.ndarray) -> np.ndarray:
    """Grows a mask by all face neighbors of its cells."""
    grown = mask.copy()
    for axis in range(3):
        # Views, so that each axis is grown in place.
        cells, before = np.moveaxis(grown, axis, 0), np.moveaxis(mask, axis, 0)
        cells[1:] |= before[:-1]
        cells[:-1] |= before[1:]
    return grown
