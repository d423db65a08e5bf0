"""Groups of pixels join the map in machine code: `mapping.join`, voxel by voxel.

The rows that new voxels take are those of the plain formulas: `JOINED` voxels claim together, in
rounds, and of those that want the same row the last one gets it.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.kernels.constants import JOINED, MAX_PROBES
from r3jax.kernels.mapping.bins import camera_of, is_valid, mark_rows
from r3jax.kernels.mapping.group import group_pixels
from r3jax.kernels.native.compiled import (
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
    prefetch,
)

_AHEAD = 8
"""Prefetch distance [voxels]: rows lie anywhere in memory."""

_EMPTY = np.uint32(EMPTY_WORD)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _mix(h):
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return np.uint32(h ^ (h >> np.uint32(16)))


@inlined
def _hash(low, high):
    """Computes `table.hash_key`."""
    h = _mix(np.uint32(low ^ np.uint32(0x9E3779B9)))
    return _mix(np.uint32(h ^ np.uint32(high * np.uint32(0x85EBCA6B))))


@inlined
def _slot(hashed, probe, capacity):
    """Computes `table._slot`."""
    return np.int64(
        np.uint32(hashed + np.uint32(probe * (probe + 1) // 2)) & np.uint32(capacity - 1)
    )


@parallel_kernel
def _find_rows(table, keys, workers, rows):
    """Finds the row of each voxel of a chunk; the capacity where it has none (`table.find`)."""
    capacity, count = table.shape[1], keys.shape[0]
    for worker in prange(workers):
        begin, end = worker * count // workers, (worker + 1) * count // workers
        for i in range(begin, end):
            rows[i] = _slot(_hash(keys[i, 0], keys[i, 1]), 0, capacity)
        for i in range(begin, end):
            if i + _AHEAD < end:
                prefetch(table[0], rows[i + _AHEAD])
                prefetch(table[1], rows[i + _AHEAD])
            low, high = keys[i, 0], keys[i, 1]
            hashed, found, probe = _hash(low, high), np.int64(capacity), 0
            while probe < MAX_PROBES:
                slot = _slot(hashed, probe, capacity)
                if table[1, slot] == high and table[0, slot] == low:
                    found = slot
                    break
                if table[1, slot] == _EMPTY:
                    break
                probe += 1
            rows[i] = found


@kernel
def _claim_rows(table, keys, rows):
    """Gives rows to the voxels of a chunk that have none (`table._claim`); -1 where none is left.

    In each round everyone bids for the row of its next probe, and the last bidder gets it.
    """
    capacity, count = table.shape[1], keys.shape[0]
    wanting, bids = np.empty(count, np.int32), np.empty(count, np.int32)
    num = 0
    for i in range(count):
        if rows[i] == capacity:
            wanting[num] = i
            num += 1
    probe = 0
    while num > 0 and probe < MAX_PROBES:
        for k in range(num):
            group = wanting[k]
            slot = _slot(_hash(keys[group, 0], keys[group, 1]), probe, capacity)
            bids[k] = slot if table[1, slot] == _EMPTY else -1
        for k in range(num):
            if bids[k] >= 0:
                group = wanting[k]
                table[0, bids[k]], table[1, bids[k]] = keys[group, 0], keys[group, 1]
        left = 0
        for k in range(num):
            group = wanting[k]
            slot = bids[k]
            if slot >= 0 and table[0, slot] == keys[group, 0] and table[1, slot] == keys[group, 1]:
                rows[wanting[k]] = slot
            else:
                wanting[left] = wanting[k]
                left += 1
        num = left
        probe += 1
    return num


@inlined_fused
def _combine(rows, mean, row, red, green, blue):
    """Adds one observation to a row's moments (`join.combine_moments`)."""
    before = rows.counts[row]
    if before == _ZERO:  # a new row, or one whose voxel was removed: its marks are void
        rows.resolution[row] = _ZERO
        for word in range(rows.visited.shape[0]):
            rows.visited[word, row] = np.uint32(0)
    after = before + _ONE
    weight = _ONE / after
    squared = _ZERO
    for channel, color in ((0, red), (1, green), (2, blue)):
        d = color - mean[channel, row]
        mean[channel, row] += d * weight
        squared += d * d
    rows.counts[row] = after
    rows.m2[row] += squared * before * weight


@inlined
def _prefetch_row(rows, mean, row):
    """Prefetches what is known of a row, which lies in as many places as it has numbers."""
    if row < rows.counts.shape[0]:
        for word in range(rows.visited.shape[0]):
            prefetch(rows.visited[word], row)
        for channel in range(3):
            prefetch(mean[channel], row)
        prefetch(rows.key[0], row)
        prefetch(rows.key[1], row)
        prefetch(rows.counts, row)
        prefetch(rows.m2, row)
        prefetch(rows.resolution, row)


@parallel_kernel
def _join_rows(rows, mean, sums, found, camera, bins, lattice, workers):
    """Adds the observations of a chunk to their rows (`update.observe_voxels`, `join.join`)."""
    capacity, num = rows.counts.shape[0], sums.shape[0]
    for worker in prange(workers):
        begin, end = worker * num // workers, (worker + 1) * num // workers
        joined, number = np.empty(end - begin, np.int64), 0
        for i in range(begin, end):
            if i + _AHEAD < end:
                _prefetch_row(rows, mean, found[i + _AHEAD])
            if found[i] < capacity:
                points = max(sums[i, 3], _ONE)
                colors = sums[i, 0] / points, sums[i, 1] / points, sums[i, 2] / points
                _combine(rows, mean, found[i], colors[0], colors[1], colors[2])
                joined[number] = found[i]
                number += 1
        mark_rows(rows.key, rows.visited, rows.resolution, joined, number, camera, bins, lattice)


@kernel
def map_add(rows, mean, frame, bins, lattice, workers, lost):
    """Adds a frame's pixels to the map, in place.

    Args:
        rows: of the map, `calls.MapRows`.
        mean: colors of the rows [3, N].
        frame: `calls.FrameArrays`.
        bins: candidates of each octahedral cell [S^2, K].
        lattice: directions of the bins [B, 3].
        workers: threads.
        lost: written: voxels that found no row [1].
    """
    lost[0], camera = 0, camera_of(frame, rows.voxel_size)
    if not is_valid(camera):
        return
    all_keys, all_sums = group_pixels(frame, rows.voxel_size, workers)
    found, voxels = np.empty(JOINED, np.int64), all_keys.shape[0]
    for first in range(0, voxels, JOINED):
        size = min(JOINED, voxels - first)
        keys, sums = all_keys[first : first + size], all_sums[first : first + size]
        _find_rows(rows.key, keys, workers, found)
        lost[0] += _claim_rows(rows.key, keys, found)
        _join_rows(rows, mean, sums, found, camera, bins, lattice, workers)
