"""Cells that are closed to the camera because of what carries it. On the host: NumPy.

Shape symbols: X Y Z cells along the axes.
"""

import itertools

import numpy as np

_BORDER = 1e-3
"""A height this close to a border of layers is on the upper one's side [cells]."""


def layers_between(
    heights: tuple[float, float], origin: float, cell_size: float, num: int
) -> tuple[int, int]:
    """The first and the last layer of cells that hold heights [m] out of a range.

    Args:
        heights: lowest and highest, either may be infinite.
        origin: height of the lowest cell's lower face [m].
        cell_size: edge of a cell [m].
        num: layers that there are.
    """
    low, high = np.clip((np.array(heights) - origin) / cell_size, -1.0, float(num))
    return int(np.floor(low)), int(np.floor(high))


def cells_over_matter(
    occupied: np.ndarray,
    body: float,
    margin: float,
    heights: tuple[float, float],
    origin: float,
    cell_size: float,
) -> np.ndarray:
    """Cells in which a camera on a body would have something known inside the body.

    The body is a cylinder below the camera, as wide as the safety margin; of a cell the lowest
    allowed height counts. What is unknown is open: a camera that looks ahead never sees the floor
    at the robot's own wheels.

    Args:
        occupied: cells known to be occupied, [X, Y, Z] bool.
        body: how far it reaches down [m]; 0: there is none.
        margin: its radius, round the middle of a cell [m].
        heights: the camera's lowest and highest height [m].
        origin: height of the lowest cell's lower face [m].
        cell_size: edge of a cell [m].

    Returns:
        [X, Y, Z] bool.
    """
    closed = np.zeros(occupied.shape, dtype=bool)
    if body == 0.0:
        return closed
    wide = _widened(occupied, margin / cell_size)
    first, last = layers_between(heights, origin, cell_size, occupied.shape[2])
    for layer in range(max(first, 0), min(last, occupied.shape[2] - 1) + 1):
        lowest = max(origin + layer * cell_size, heights[0])
        foot = (lowest - body - origin) / cell_size
        below = max(0, int(np.floor(max(foot, -1.0) + _BORDER)))
        closed[:, :, layer] = wide[:, :, below:layer].any(axis=2)
    return closed


def _widened(mask: np.ndarray, radius: float) -> np.ndarray:
    """Cells within whose disk of `radius` [cells], level and round the middle, the mask holds."""
    reach = int(np.ceil(radius + 0.5)) - 1
    padded = np.pad(mask, ((reach, reach), (reach, reach), (0, 0)))
    wide = mask.copy()
    for x, y in itertools.product(range(-reach, reach + 1), repeat=2):
        gap = np.hypot(max(abs(x) - 0.5, 0.0), max(abs(y) - 0.5, 0.0))
        if gap < radius - _BORDER:  # touching is not overlapping
            wide |= padded[
                reach + x : reach + x + mask.shape[0], reach + y : reach + y + mask.shape[1]
            ]
    return wide
