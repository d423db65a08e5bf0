"""Which unexplored cells are worth a look: those that a robot could ever look at.

The inside of walls, the ground below the floor and whatever lies outside the building stay
unexplored for ever. A planner that counts them is drawn to them for ever.
"""

import numpy as np
from scipy import ndimage

from r3jax.mapping.occupancy import OccupancyGrid

_FACES = ndimage.generate_binary_structure(3, 1)


def explorable_cells(free: np.ndarray, unexplored: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Unexplored cells that connect, through unexplored cells, to space the robot can enter.

    A region of unexplored cells (connected over faces) counts as a whole if one of its cells
    has a face neighbor in the *known-free reachable space*: the free cells that connect over
    faces to a cell of `reached`.

    Args:
        free: cells known to be free, [X, Y, Z] bool.
        unexplored: cells neither free nor occupied, [X, Y, Z] bool.
        reached: cells the robot can come to, [X, Y, Z] bool; those not free are ignored.

    Returns:
        The unexplored cells that count, [X, Y, Z] bool.
    """
    # Free space seen through a window counts for nothing: no robot gets there to look on.
    open_space = _regions_that_touch(free, reached)
    # Dilated by one cell: the two kinds of cells border on each other, and share none.
    return _regions_that_touch(unexplored, ndimage.binary_dilation(open_space, _FACES))


def mask_unexplorable(
    grid: OccupancyGrid, reached: np.ndarray, exhausted: np.ndarray | None = None
) -> OccupancyGrid:
    """Masks a grid for scoring, so that only explorable cells count as unexplored.

    Args:
        grid: the grid.
        reached: cells the robot can come to, [X, Y, Z] bool.
        exhausted: cells that were looked at in vain, [X, Y, Z] bool; None: there are none.
    """
    # Labels of regions are no work for XLA: their number is not known beforehand.
    free, unexplored = np.asarray(grid.free), np.asarray(grid.unexplored)
    is_hopeless = unexplored & ~explorable_cells(free, unexplored, reached)
    if exhausted is not None:
        is_hopeless |= unexplored & exhausted
    return grid.ignoring(is_hopeless)


def _regions_that_touch(mask: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The regions of a mask, connected over faces, that hold at least one seed."""
    labels = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, _FACES, output=labels)
    is_wanted = np.zeros(int(labels.max()) + 1, dtype=bool)
    is_wanted[labels[seeds]] = True
    is_wanted[0] = False  # the label of everything that is not in the mask
    return is_wanted[labels]
