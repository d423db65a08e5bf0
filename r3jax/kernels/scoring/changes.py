"""What imagined views have changed for positions that keep which voxels and cells they see."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels.native.compiled import inlined, kernel
from r3jax.kernels.scoring.near import find_consistency, gather
from r3jax.kernels.scoring.shown import add_by_direction, find_deficits, find_directions
from r3jax.kernels.scoring.sums import unexplored_of
from r3jax.kernels.scoring.terms import ANGLES
from r3jax.kernels.scoring.voxels import DELTA, LOG_DELTA, SIZE
from r3jax.kernels.visibility.views import CHUNK

_ONE = np.float32(1.0)


@kernel
def _shown_rows(before, after):
    """Gathers the rows that the views show: each of them adds to the count of just these."""
    rows, num = np.empty(after.shape[0] + 1, np.int32), 0
    for row in range(after.shape[0]):
        rows[num] = row
        num += after[row] > before[row]
    return rows[:num]


@inlined
def _find_set(items, bits, chosen):
    """Writes where the items stand whose bit is set; returns how many they are."""
    num = 0
    for i in range(items.shape[0]):
        item = np.int64(items[i])
        chosen[num] = i
        num += (bits[item >> 3] >> (7 - (item & 7))) & 1
    return num


@kernel
def _known(state, rows, is_pairwise):
    """Gathers what R needs to know of some rows, once for all positions."""
    key, words, count, m2, resolution, voxel_size = state
    num = rows.shape[0]
    voxels, same = np.empty((SIZE, num), np.float32), np.empty(num, np.int32)
    visited = np.empty(((words.shape[0] + 1) // 2, num), np.uint64)
    gather(key, words, count, m2, resolution, voxel_size, num, rows, 0, voxels, visited, same)
    find_consistency(voxels[DELTA], voxels[LOG_DELTA], is_pairwise)
    return voxels, visited


@kernel
def _add_voxels(point, chosen, before, after, is_always_one, tables, scratch, sums):
    """Adds 1 - R after the views less 1 - R before them, for chosen voxels."""
    directions, table, lattice = tables
    angles, bins, weights, was = scratch
    position, settings = (point[0], point[1], point[2]), (is_always_one, point[3])
    size = np.float32(math.sqrt(table.shape[0]))
    for first in range(0, chosen.shape[0], CHUNK):
        some = chosen[first : first + CHUNK]
        num = some.shape[0]
        find_directions(position, before[0], 0, some, num, size, angles, bins)
        find_deficits(before, 0, some, num, settings, directions, angles, was)
        find_deficits(after, 0, some, num, settings, directions, angles, weights)
        for j in range(num):
            weights[j] -= was[j]
        add_by_direction(angles, bins, weights, num, table, lattice, sums)


@kernel
def _count_cells(point, chosen, centers, tables, scratch, counts):
    """Counts chosen cells by direction."""
    _, table, lattice = tables
    angles, bins, weights, _ = scratch
    position, size = (point[0], point[1], point[2]), np.float32(math.sqrt(table.shape[0]))
    weights[:] = _ONE
    for first in range(0, chosen.shape[0], CHUNK):
        some = chosen[first : first + CHUNK]
        num = some.shape[0]
        find_directions(position, centers, 0, some, num, size, angles, bins)
        add_by_direction(angles, bins, weights, num, table, lattice, counts)


@kernel
def changes_pass(before, after, cells, kept, points, forms, tables, results):
    """Sums up what imagined views have changed, for positions that see the same as before.

    By the thread that calls: a search over paths has one for each core.

    Args:
        before: the map, as in `sums_of_many`.
        after: the same voxels after the views.
        cells: x, y, z [m], and which are unexplored before, but not after [c].
        kept: bits of the rows and of the cells that each position sees [P, N / 8], [P, c / 8].
        points: positions [m] and focal lengths [px], [P, 4].
        forms: whether kappa is always 1, whether delta is that of pairs.
        tables: as in `sums_of_many`.
        results: written; sums of 1 - R after less before, and numbers of cells that are no longer
            unexplored [P, B].
    """
    shown = _shown_rows(before[2], after[2])
    was, now = _known(before, shown, forms[1]), _known(after, shown, forms[1])
    centers, explored = unexplored_of(cells[:3], cells[3])
    chosen = np.empty(max(shown.shape[0], explored.shape[0]) + 1, np.int32)
    sums = np.empty(results[0].shape[1], np.float64)
    scratch = (
        np.empty(ANGLES, np.float32), np.zeros(CHUNK, np.int32), np.empty(CHUNK, np.float32),
        np.empty(CHUNK, np.float32),
    )  # fmt: skip
    for i in range(points.shape[0]):
        for bin in range(sums.shape[0]):
            sums[bin], results[1][i, bin] = 0.0, 0.0
        num = _find_set(shown, kept[0][i], chosen)
        _add_voxels(points[i], chosen[:num], was, now, forms[0], tables, scratch, sums)
        num = _find_set(explored, kept[1][i], chosen)
        _count_cells(points[i], chosen[:num], centers, tables, scratch, results[1][i])
        for bin in range(sums.shape[0]):
            results[0][i, bin] = sums[bin]
