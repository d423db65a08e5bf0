"""Columns of cells that zones and costmaps cover, on a lattice without end.

Shape symbols: k columns or corners.
"""

import itertools
from typing import NamedTuple

import numpy as np

from r3jax.errors import InputError
from r3jax.mapping.occupancy import MAX_CELLS


class Plane(NamedTuple):
    """A lattice of columns, and the part of it that matters."""

    origin: np.ndarray
    """Lower corner of column (0, 0), world, [2] [m]."""

    size: float
    """Edge of a column [m]."""

    window: np.ndarray
    """First column and the first one beyond the last, [2, 2]; infinite where there is no end."""

    def cut(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Finds the columns of the window between two corners, [2] [m]: first, and numbers, [2].

        Raises:
            ValueError: more columns than a grid may have cells.
        """
        first, last = (np.floor((corner - self.origin) / self.size) for corner in (low, high))
        first = np.clip(first, *self.window)
        num = np.clip(last + 1.0, *self.window) - first
        if not num.prod() <= MAX_CELLS:  # NaN, too
            raise InputError(
                f"a zone or costmap from {low.tolist()} to {high.tolist()} m covers "
                f"{num.prod():.2g} columns of cells, more than {MAX_CELLS:.0e}: cut it to the place"
            )
        return first.astype(np.int64), num.astype(np.int64)


def polygon_columns(plane: Plane, corners: np.ndarray) -> np.ndarray:
    """Finds the columns that a polygon [k, 2] [m] overlaps, by the even-odd rule, [k, 2] int64."""
    first, (nx, ny) = plane.cut(corners.min(axis=0), corners.max(axis=0))
    num = 4  # zones thinner than a quarter of a cell may be missed
    low = plane.origin + first * plane.size
    x, y = (low[i] + plane.size / num * (np.arange(num * n) + 0.5) for i, n in enumerate((nx, ny)))
    inside = np.zeros((len(x), len(y)), bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if ay != by:  # each edge to the right of a point flips its state
            crosses = (ay > y) != (by > y)
            inside ^= crosses & (x[:, None] < ax + (y - ay) * (bx - ax) / (by - ay))
    return np.argwhere(inside.reshape(nx, num, ny, num).any(axis=(1, 3))) + first


def pixel_columns(plane: Plane, corners: np.ndarray, resolution: float) -> np.ndarray:
    """Finds the columns that pixels overlap, [k, 2] int64, by their lower corners [k, 2] [m]."""
    if not len(corners):
        return np.zeros((0, 2), np.int64)
    first, num = plane.cut(corners.min(axis=0), corners.max(axis=0) + resolution)
    columns = np.zeros(num, bool)
    # Both edges of a pixel, and between them in steps of a cell at most: all cells it overlaps.
    offsets = np.linspace(0.01, 0.99, max(int(np.ceil(resolution / plane.size)), 1) + 1)
    for offset in itertools.product(offsets, repeat=2):
        places = corners + resolution * np.array(offset)
        cells = np.floor((places - plane.origin) / plane.size).astype(np.int64) - first
        cells = cells[np.all((cells >= 0) & (cells < num), axis=1)]
        columns[tuple(cells.T)] = True
    return np.argwhere(columns) + first


def without(columns: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Leaves out the columns [k, 2] that are among others."""
    keys, gone = (x[:, 0] * (1 << 32) + x[:, 1] for x in (columns, others))
    return columns[~np.isin(keys, gone)]


def cells_of(columns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Finds the cells of columns [k, 2] in a grid of a shape, [X, Y, Z] bool; drops the others."""
    mask = np.zeros(shape[:2], bool)
    mask[tuple(columns[np.all((columns >= 0) & (columns < shape[:2]), axis=1)].T)] = True
    return np.broadcast_to(mask[:, :, None], shape)
