"""Gathers the voxels near some views into bricks, with the inputs of R for each."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import center_of, center_of_words
from r3jax.kernels.native.arithmetic import bits_of, count_bits, float_of
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, kernel, parallel_kernel
from r3jax.kernels.scoring.terms import consistency, log2_or_never
from r3jax.kernels.visibility.bricks import bricks_of_shares, compact, mark_near, sorted_slots
from r3jax.kernels.visibility.views import CHUNK

_ZERO = np.float32(0.0)


class Voxels(NamedTuple):
    """The voxels near some views."""

    known: Any
    """Centers [m], delta, log2 of it, and best resolution [px/m], one a row [SIZE, n]."""

    visited: Any
    """Direction bins, 64 in a word [ceil(W / 2), n]."""

    rows: Any
    """Rows of the map [n]."""


X, Y, Z, DELTA, LOG_DELTA, RESOLUTION = 0, 1, 2, 3, 4, 5
"""Rows of `Voxels.known`."""

SIZE = 6

_ROW, _WORDS = 6, 7
"""Parts of a record beside those: the row of the map, and where the words of bins begin."""

_CLASSES = 8
"""Classes of the number of directions: 0 to 6, and more."""


@inlined
def bins_of(words, word, row):
    """Joins two words of 32 bins to one of 64; the second may be missing."""
    bits = np.uint64(words[word, row])
    if word + 1 < words.shape[0]:
        bits |= np.uint64(words[word + 1, row]) << np.uint64(32)
    return bits


@inlined
def _num_directions(record, words):
    """Counts the bins from which a voxel was seen."""
    num = np.int64(0)
    for word in range(words):
        num += count_bits(record[_WORDS + word])
    return num


@kernel
def _unpack_sorted(records, begin, end, words, counts, voxels):
    """Unpacks records, those that were seen from few directions first.

    A counting sort. Neighboring voxels then have equal trip counts, so that loop exits are
    predicted.
    """
    counts[:] = 0
    for i in range(begin, end):
        counts[min(_num_directions(records[i], words), _CLASSES - 1)] += 1
    place = begin
    for i in range(_CLASSES):
        counts[i], place = place, place + counts[i]
    for i in range(begin, end):
        record = records[i]
        group = min(_num_directions(record, words), _CLASSES - 1)
        place = counts[group]
        counts[group] += 1
        voxels.rows[place] = record[_ROW]
        for part in range(SIZE):
            voxels.known[part, place] = float_of(record[part])
        for word in range(0, words, 2):
            low = np.uint64(record[_WORDS + word])
            high = np.uint64(record[_WORDS + word + 1]) if word + 1 < words else np.uint64(0)
            voxels.visited[word >> 1, place] = low | (high << np.uint64(32))


@kernel
def empty_voxels(num, num_words):
    """Allocates room for this number of voxels, with the given number of 32-bit words of bins."""
    return Voxels(
        np.empty((SIZE, num), np.float32), np.empty(((num_words + 1) // 2, num), np.uint64),
        np.empty(num, np.int32),
    )  # fmt: skip


@kernel
def sorted_voxels(rows, views, is_valid, forms, workers):
    """Sorts the voxels that some view may see into bricks, with their observations."""
    slots, bricks = sorted_slots(rows, views, is_valid, workers)
    voxels = empty_voxels(bricks.starts[bricks.starts.shape[0] - 1], rows.visited.shape[0])
    _gather(slots, bricks, rows, forms, workers, voxels)
    return bricks, voxels


@parallel_kernel
def _gather(slots, bricks, rows, forms, workers, voxels):
    """Gathers voxels in the order of the bricks.

    Args:
        slots: of every row of the map, -1: none [N].
        bricks: of the slots.
        rows: of the map.
        forms: of R.
        workers: threads.
        voxels: written.
    """
    num, capacity, num_words = voxels.rows.shape[0], slots.shape[0], rows.visited.shape[0]
    starts = bricks.starts
    # Records, so that a voxel out of its order costs one miss of the cache and not one for each.
    records = np.empty((num, _WORDS + num_words), np.uint32)
    for share in prange(workers):
        for row in range(capacity * share // workers, capacity * (share + 1) // workers):
            if slots[row] >= 0:
                record = records[slots[row]]
                delta = consistency(rows.counts[row], rows.m2[row], forms.is_pairwise)
                x, y, z = center_of(rows.key, row, rows.voxel_size)
                record[X], record[Y], record[Z] = bits_of(x), bits_of(y), bits_of(z)
                record[DELTA], record[LOG_DELTA] = bits_of(delta), bits_of(log2_or_never(delta))
                record[RESOLUTION], record[_ROW] = bits_of(rows.resolution[row]), row
                for word in range(num_words):
                    record[_WORDS + word] = rows.visited[word, row]
    for share in prange(workers):
        first, last = num * share // workers, num * (share + 1) // workers
        counts = np.empty(_CLASSES, np.int64)
        for brick in range(starts.shape[0] - 1):
            for begin in range(starts[brick], starts[brick + 1], CHUNK):
                if first <= begin < last:
                    end = min(begin + CHUNK, starts[brick + 1])
                    _unpack_sorted(records, begin, end, num_words, counts, voxels)


@kernel
def near_voxels(rows, views, is_valid, layout, forms, workers):
    """Gathers the voxels that some of a few views may see, in the order of the map.

    There is one brick for each thread's share of the map.
    """
    capacity = rows.counts.shape[0]
    voxels = empty_voxels(capacity, rows.visited.shape[0])
    begins, ends = np.empty(workers, np.int64), np.empty(workers, np.int64)
    _gather_near(rows, views, is_valid, layout, forms, begins, ends, voxels)
    return bricks_of_shares(begins, ends, capacity), voxels


@parallel_kernel
def _gather_near(rows, views, is_valid, layout, forms, begins, ends, voxels):
    shares, capacity = begins.shape[0], rows.counts.shape[0]
    for share in prange(shares):
        begins[share] = capacity * share // shares
        ends[share] = _gather_share(
            rows, views, is_valid, layout, forms, begins[share],
            capacity * (share + 1) // shares, voxels,
        )  # fmt: skip


@kernel
def _gather_share(rows, views, is_valid, layout, forms, begin, end, voxels):
    """Gathers the rows from `begin` to `end` that some view may show.

    Returns:
        Where the voxels end; they begin where the rows do.
    """
    centers, is_near = np.empty((3, CHUNK), np.float32), np.empty(CHUNK, np.int32)
    chosen, to = np.empty(CHUNK + 1, np.int32), begin
    for first in range(begin, end, CHUNK):
        count = min(CHUNK, end - first)
        x, y, z = centers[X, :count], centers[Y, :count], centers[Z, :count]
        _find_centers(rows.key[0, first:], rows.key[1, first:], rows.voxel_size, x, y, z)
        mark_near(views, is_valid, layout, rows.voxel_size, x, y, z, is_near)
        for i in range(count):
            is_near[i] &= np.int32(rows.counts[first + i] > _ZERO)
        num = compact(is_near, count, chosen)
        _take_chosen(rows, first, centers, chosen, num, to, voxels)
        deltas, logs = voxels.known[DELTA, to : to + num], voxels.known[LOG_DELTA, to : to + num]
        _find_consistency(deltas, logs, forms.is_pairwise)
        to += num
    return to


@kernel
def _find_centers(low, high, voxel_size, x, y, z):
    """Finds centers of voxels from the words of their keys [m]."""
    in_wide_vectors()
    for i in range(x.shape[0]):
        x[i], y[i], z[i] = center_of_words(low[i], high[i], voxel_size)


@inlined
def _take_chosen(rows, first, centers, chosen, num, to, voxels):
    """Copies chosen rows of a chunk, counts and spreads in the places of delta and its log."""
    # One array after the other: more misses of the cache are then under way at a time.
    for axis in range(3):
        for j in range(num):
            voxels.known[axis, to + j] = centers[axis, np.int64(chosen[j])]
    for j in range(num):
        voxels.rows[to + j] = first + np.int64(chosen[j])
    for j in range(num):
        voxels.known[DELTA, to + j] = rows.counts[first + np.int64(chosen[j])]
    for j in range(num):
        voxels.known[LOG_DELTA, to + j] = rows.m2[first + np.int64(chosen[j])]
    for j in range(num):
        voxels.known[RESOLUTION, to + j] = rows.resolution[first + np.int64(chosen[j])]
    for word in range(0, rows.visited.shape[0], 2):
        for j in range(num):
            row = first + np.int64(chosen[j])
            voxels.visited[word >> 1, to + j] = bins_of(rows.visited, word, row)


@kernel
def _find_consistency(counts, spreads, is_pairwise):
    """Replaces counts by delta, and spreads of colors by its logarithm."""
    in_wide_vectors()
    for i in range(counts.shape[0]):
        delta = consistency(counts[i], spreads[i], is_pairwise)
        counts[i], spreads[i] = delta, log2_or_never(delta)
