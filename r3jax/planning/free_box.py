"""Boxes of free space round a place: convex, so that what climbs in one need not look out."""

import itertools

import numpy as np

from r3jax.planning.candidates import JITTER
from r3jax.planning.travel import Travel


def free_box(travel: Travel, position: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """A box round a place all over which the robot may stop.

    The box of cells round the place's own grows, one layer at a time, over safe cells to which a
    way leads, and ends where candidates do: a quarter of a cell from the middles of its outermost.

    Args:
        travel: where the robot may stop.
        position: where it may [3] [m].
        radius: the box ends at this distance along each axis [m].

    Returns:
        The lowest and the highest corner [3] [m]; twice the position where its cell does not keep
        the margin: what stands there has nowhere to go.
    """
    stops = travel.safe & travel.reachable
    cell = travel.cell_of(position)
    if not (travel.contains(cell) and stops[cell]):
        return position.copy(), position.copy()
    lowest = np.maximum(travel.cell_of(position - radius), 0)
    highest = np.minimum(travel.cell_of(position + radius), np.array(stops.shape) - 1)
    first, last = np.array(cell), np.array(cell)
    grows = True
    while grows:
        grows = False
        for axis, (end, step) in itertools.product(range(3), ((first, -1), (last, 1))):
            beyond = end[axis] + step
            layer = [slice(a, b + 1) for a, b in zip(first, last, strict=True)]
            layer[axis] = slice(beyond, beyond + 1)
            if lowest[axis] <= beyond <= highest[axis] and stops[tuple(layer)].all():
                end[axis] = beyond
                grows = True
    reach = JITTER * travel.cell_size
    low, high = travel.centers(first) - reach, travel.centers(last) + reach
    low, high = np.maximum(low, position - radius), np.minimum(high, position + radius)
    low[2], high[2] = np.clip((low[2], high[2]), *travel.heights)
    return np.minimum(low, position), np.maximum(high, position)
