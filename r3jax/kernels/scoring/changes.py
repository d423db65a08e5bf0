"""What imagined views have changed for positions that keep which voxels and cells they see."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels.mapping.bins import center_of
from r3jax.kernels.native.compiled import inlined, kernel
from r3jax.kernels.scoring.sums import (
    add_by_direction,
    find_deficits,
    find_directions,
    new_scratch,
    unexplored_of,
)
from r3jax.kernels.scoring.terms import consistency, log2_or_never
from r3jax.kernels.scoring.voxels import (
    DELTA,
    LOG_DELTA,
    RESOLUTION,
    X,
    Y,
    Z,
    bins_of,
    empty_voxels,
)
from r3jax.kernels.visibility.views import CHUNK

_ONE = np.float32(1.0)


@kernel
def _visible_rows(before, after):
    """Gathers the rows that the views show: each of them adds to the count of just these."""
    rows, num = np.empty(after.shape[0] + 1, np.int32), 0
    for row in range(after.shape[0]):
        rows[num] = row
        num += after[row] > before[row]
    return rows[:num]


@inlined
def _find_set(items, bits, chosen):
    """Writes the indices of the items whose bit is set, and returns their number."""
    num = 0
    for i in range(items.shape[0]):
        item = np.int64(items[i])
        chosen[num] = i
        num += (bits[item >> 3] >> (7 - (item & 7))) & 1
    return num


@kernel
def _known(rows, visible, is_pairwise):
    """Gathers the inputs of R for some rows, once for all positions."""
    voxels = empty_voxels(visible.shape[0], rows.visited.shape[0])
    for j in range(visible.shape[0]):
        row = np.int64(visible[j])
        delta = consistency(rows.counts[row], rows.m2[row], is_pairwise)
        x, y, z = center_of(rows.key, row, rows.voxel_size)
        voxels.known[X, j], voxels.known[Y, j], voxels.known[Z, j] = x, y, z
        voxels.known[DELTA, j], voxels.known[LOG_DELTA, j] = delta, log2_or_never(delta)
        voxels.known[RESOLUTION, j], voxels.rows[j] = rows.resolution[row], row
        for word in range(0, rows.visited.shape[0], 2):
            voxels.visited[word >> 1, j] = bins_of(rows.visited, word, row)
    return voxels


@inlined
def _take(chosen, first, num, scratch):
    """Copies a chunk of chosen items to where the passes read them."""
    for j in range(num):
        scratch.chosen[j] = chosen[first + j]


@kernel
def _add_voxels(position, focal, chosen, num, was, now, is_kappa_one, tables, scratch, old, sums):
    """Adds 1 - R after the views less 1 - R before them, for chosen voxels."""
    size = np.float32(math.sqrt(tables.table.shape[0]))
    for first in range(0, num, CHUNK):
        count = min(CHUNK, num - first)
        _take(chosen, first, count, scratch)
        find_directions(position, was.known, 0, count, size, scratch)
        find_deficits(was, 0, count, is_kappa_one, focal, tables.directions, scratch, old)
        find_deficits(
            now, 0, count, is_kappa_one, focal, tables.directions, scratch, scratch.weights
        )
        for j in range(count):
            scratch.weights[j] -= old[j]
        add_by_direction(scratch, count, tables, sums)


@kernel
def _count_cells(position, chosen, num, centers, tables, scratch, counts):
    """Counts chosen cells by direction."""
    size = np.float32(math.sqrt(tables.table.shape[0]))
    scratch.weights[:] = _ONE
    for first in range(0, num, CHUNK):
        count = min(CHUNK, num - first)
        _take(chosen, first, count, scratch)
        find_directions(position, centers, 0, count, size, scratch)
        add_by_direction(scratch, count, tables, counts)


@kernel
def changes(before, after, cells, seen, positions, focals, forms, tables, results):
    """Sums up what imagined views have changed, for positions that see the same as before.

    By the thread that calls: a search over paths has one for each core.

    Args:
        before: rows of the map, `calls.MapRows`.
        after: the same rows after the views.
        cells: `calls.Cells`; those count that are unexplored before, but not after.
        seen: bits of the rows and of the cells that each position sees [P, N / 8], [P, c / 8].
        positions: of the cameras [P, 3] [m].
        focals: focal lengths [P] [px].
        forms: `Choices` of R.
        tables: of the voxels' and the panorama's bins.
        results: written; sums of 1 - R after less before, and numbers of cells that are no longer
            unexplored [P, B].
    """
    visible = _visible_rows(before.counts, after.counts)
    was, now = _known(before, visible, forms.is_pairwise), _known(after, visible, forms.is_pairwise)
    explored = unexplored_of(cells)
    chosen = np.empty(max(visible.shape[0], explored.numbers.shape[0]) + 1, np.int32)
    sums, scratch = np.empty(results[0].shape[1], np.float64), new_scratch()
    old = np.empty(CHUNK, np.float32)
    for i in range(positions.shape[0]):
        position = positions[i, 0], positions[i, 1], positions[i, 2]
        for bin in range(sums.shape[0]):
            sums[bin], results[1][i, bin] = 0.0, 0.0
        num = _find_set(visible, seen[0][i], chosen)
        _add_voxels(
            position, focals[i], chosen, num, was, now, forms.is_kappa_one, tables, scratch, old,
            sums,
        )  # fmt: skip
        num = _find_set(explored.numbers, seen[1][i], chosen)
        _count_cells(position, chosen, num, explored.centers, tables, scratch, results[1][i])
        for bin in range(sums.shape[0]):
            results[0][i, bin] = sums[bin]
