"""Shortest paths from one cell of a grid to all others, in machine code.

Dijkstra's algorithm with buckets (Dial 1969): a bucket holds cells whose costs differ by less than
one, and no step is shorter than that, so that none of them can lie on the shortest path to another
one. They are settled in any order, and no heap is needed. The costs are bit for bit those of
Dijkstra's algorithm with a heap: the least of the same sums.

Steps go to the 26 neighbors. A diagonal step needs every cell of the block that it crosses.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from r3jax.kernels.native.platform import compiled_or_plain

_LONGEST = 6
"""Cells between the two ends of a diagonal step through space."""

_Kernel = Callable[..., None]


def shortest_paths(
    usable: Bool[np.ndarray, "X Y Z"], start: tuple[int, int, int] | None
) -> tuple[Float[np.ndarray, "X Y Z"], Int[np.ndarray, "X Y Z"]]:
    """Finds the length of the shortest path to each cell, and the cell before it.

    Args:
        usable: cells that paths may cross.
        start: where they begin, a usable cell; None: nothing can be reached.

    Returns:
        Lengths between cells' centers [cells], inf where there is no path; and the flat index of
        the cell before, -1 at the start and where there is no path.
    """
    # A border of closed cells: no step needs to be checked against the edges.
    padded = np.pad(usable, 1)
    cost = np.full(padded.size, np.inf)
    previous = np.full(padded.size, -1, dtype=np.int64)
    if start is not None:
        number = np.pad(np.arange(usable.size).reshape(usable.shape), 1).reshape(-1)
        first = int(np.ravel_multi_index([i + 1 for i in start], padded.shape))
        # A bucket holds no cell twice, so that no queue outgrows the usable cells.
        room = int(np.count_nonzero(usable))
        steps = _steps(padded.shape)
        _compiled()(padded.reshape(-1), number, *steps, first, room, cost, previous)
    # Contiguous: `Travel.path` flattens what comes out on every call, and must not copy it.
    inner = lambda x: np.ascontiguousarray(x.reshape(padded.shape)[1:-1, 1:-1, 1:-1])
    return inner(cost), inner(previous)


def _steps(
    shape: tuple[int, ...],
) -> tuple[
    Int[np.ndarray, " 26"],
    Float[np.ndarray, " 26"],
    Int[np.ndarray, "26 6"],
    Int[np.ndarray, " 26"],
]:
    """Lists the 26 steps in a flattened grid: offsets, lengths, offsets of the cells between."""
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    steps = [d for d in itertools.product((-1, 0, 1), repeat=3) if d != (0, 0, 0)]
    between = np.zeros((len(steps), _LONGEST), dtype=np.int64)
    sizes = np.zeros(len(steps), dtype=np.int64)
    for i, step in enumerate(steps):
        corners = itertools.product(*(sorted({0, d}) for d in step))
        inner = [np.dot(c, strides) for c in corners if c not in (step, (0, 0, 0))]
        sizes[i] = len(inner)
        between[i, : len(inner)] = inner
    lengths = np.array([np.linalg.norm(step) for step in steps])
    return np.array(steps) @ strides, lengths, between, sizes


@functools.cache
def _compiled() -> _Kernel:
    """Compiles the kernel on the first call; the disk keeps it for the next process."""
    return compiled_or_plain(_settle)  # only here: a command without paths need not wait for Numba


def _settle(
    usable: Any,
    number: Any,
    steps: Any,
    lengths: Any,
    between: Any,
    sizes: Any,
    start: int,
    room: int,
    cost: Any,
    previous: Any,
) -> None:
    """Fills `cost` and `previous` of a flattened grid with a border, for Numba.

    `number` holds the cells' flat index in the grid without the border.
    """
    queues = np.empty((3, room), dtype=np.int32)  # a step ends at most two buckets further on
    filled = np.zeros(3, dtype=np.int64)
    queued = np.full(usable.size, -1, dtype=np.int32)  # the bucket that holds a cell
    cost[start] = 0.0
    queues[0, 0] = start
    filled[0] = 1
    queued[start] = 0
    bucket = 0
    # None is empty before the last: a diagonal step has straight ones beside it.
    while filled[bucket % 3] > 0:
        row = bucket % 3
        num = filled[row]
        # Steps are 1 to 1.8 cells long: they fill the next two buckets, never this row.
        filled[row] = 0
        for i in range(num):
            here = queues[row, i]
            if int(cost[here]) < bucket:
                continue  # a shorter path was found since then, and it was settled earlier
            for k in range(26):
                there = here + steps[k]
                length = cost[here] + lengths[k]
                if not usable[there] or length >= cost[there]:
                    continue
                is_open = True
                for j in range(sizes[k]):
                    is_open = is_open and usable[here + between[k, j]]
                if not is_open:
                    continue
                cost[there] = length
                previous[there] = number[here]
                new = int(length)
                # A cell in that bucket already is read in its turn, with the cost that it has then.
                if queued[there] != new:
                    queued[there] = new
                    queues[new % 3, filled[new % 3]] = there
                    filled[new % 3] += 1
        bucket += 1
