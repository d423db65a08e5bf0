"""Points join the map in machine code: `mapping.associate` and `mapping.join`, voxel by voxel.

The rows that new voxels take are those of the plain formulas: `CHUNK` voxels claim together, in
rounds, and of those that want the same row the last one gets it.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.mapping.backends.numba.bins import evidence, is_sound
from r3jax.mapping.join import CHUNK
from r3jax.mapping.table import MAX_PROBES
from r3jax.native.compiled import inlined, inlined_fused, kernel, parallel_kernel

_CHUNK, _PROBES = CHUNK, MAX_PROBES
_BITS = 6
"""Low bits of a voxel index that choose a slot of the scratch table, along each axis."""

_LOW = (1 << _BITS) - 1
_EMPTY = np.uint32(EMPTY_WORD)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _mix(h):
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return np.uint32(h ^ (h >> np.uint32(16)))


@inlined
def _hash(low, high):
    """`table.hash_key`."""
    h = _mix(np.uint32(low ^ np.uint32(0x9E3779B9)))
    return _mix(np.uint32(h ^ np.uint32(high * np.uint32(0x85EBCA6B))))


@inlined
def _slot(hashed, probe, capacity):
    """`table._slot`."""
    return np.int64(
        np.uint32(hashed + np.uint32(probe * (probe + 1) // 2)) & np.uint32(capacity - 1)
    )


@inlined
def _near_slot(low, high):
    """Slot of the scratch table by the low bits of a voxel's index.

    Not a hash: neighbors never share a slot, and a frame of room size has few searches.
    """
    x = low & np.uint32(_LOW)
    y = (low >> np.uint32(21)) & np.uint32(_LOW)
    z = (high >> np.uint32(10)) & np.uint32(_LOW)
    return np.uint32(x | (y << np.uint32(_BITS)) | (z << np.uint32(2 * _BITS)))


@inlined_fused
def _add_color(sums, group, rgb, point):
    """Adds a point's color and the point itself to the sums of its voxel."""
    for channel in range(3):
        sums[group, channel] += rgb[point, channel]
    sums[group, 3] += _ONE


@kernel
def group_points(points, rgb, groups):
    """Groups points by voxel, and lists the voxels in the order of their last points.

    Args:
        points: packed keys of their voxels, all ones for points to ignore [2, P].
        rgb: their colors [P, 3].
        groups: written: keys [2, P], sums of colors and numbers of points [P, 4], order [P].

    Returns:
        How many voxels there are.
    """
    keys, sums, order = groups
    num = points.shape[1]
    # Twice as many slots as points, so that a search ends.
    bits = 3 * _BITS
    while (1 << bits) < 2 * num:
        bits += 1
    slots = np.full(1 << bits, np.int32(-1))
    group_of, last = np.empty(num, np.int32), np.empty(num, np.int32)
    mask, count, group = np.uint32((1 << bits) - 1), 0, np.uint32(0)
    for i in range(num):
        low, high = points[0, i], points[1, i]
        group_of[i] = -1
        if high != _EMPTY:
            # Mostly the voxel of the pixel before.
            if count == 0 or keys[0, group] != low or keys[1, group] != high:
                slot = _near_slot(low, high)
                found = slots[slot]
                while found >= 0 and not (
                    keys[0, np.uint32(found)] == low and keys[1, np.uint32(found)] == high
                ):
                    slot = np.uint32(np.uint32(slot + np.uint32(1)) & mask)
                    found = slots[slot]
                if found < 0:
                    found = np.int32(count)
                    slots[slot], keys[0, count], keys[1, count] = found, low, high
                    sums[count] = _ZERO
                    count += 1
                group = np.uint32(found)
            _add_color(sums, group, rgb, i)
            group_of[i], last[group] = np.int32(group), i
    listed = 0
    for i in range(num):
        if group_of[i] >= 0 and last[np.uint32(group_of[i])] == i:
            order[listed] = group_of[i]
            listed += 1
    return listed


@parallel_kernel
def _find_rows(table, keys, order, first, count, workers, rows):
    """Row of each voxel of a chunk; the capacity where it has none (`table.find`)."""
    capacity = table.shape[1]
    for worker in prange(workers):
        for i in range(worker * count // workers, (worker + 1) * count // workers):
            group = order[first + i]
            low, high = keys[0, group], keys[1, group]
            hashed, found, probe = _hash(low, high), np.int64(capacity), 0
            while probe < _PROBES:
                slot = _slot(hashed, probe, capacity)
                if table[1, slot] == high and table[0, slot] == low:
                    found = slot
                    break
                if table[1, slot] == _EMPTY:
                    break
                probe += 1
            rows[i] = found


@kernel
def _claim_rows(table, keys, order, first, count, rows):
    """Gives rows to the voxels of a chunk that have none (`table._claim`); -1 where none is left.

    In each round everyone bids for the row of its next probe, and the last bidder gets it.
    """
    capacity = table.shape[1]
    wanting, bids = np.empty(count, np.int32), np.empty(count, np.int32)
    num = 0
    for i in range(count):
        if rows[i] == capacity:
            wanting[num] = i
            num += 1
    probe = 0
    while num > 0 and probe < _PROBES:
        for k in range(num):
            group = order[first + wanting[k]]
            slot = _slot(_hash(keys[0, group], keys[1, group]), probe, capacity)
            bids[k] = slot if table[1, slot] == _EMPTY else -1
        for k in range(num):
            if bids[k] >= 0:
                group = order[first + wanting[k]]
                table[0, bids[k]], table[1, bids[k]] = keys[0, group], keys[1, group]
        left = 0
        for k in range(num):
            group = order[first + wanting[k]]
            slot = bids[k]
            if slot >= 0 and table[0, slot] == keys[0, group] and table[1, slot] == keys[1, group]:
                rows[wanting[k]] = slot
            else:
                wanting[left] = wanting[k]
                left += 1
        num = left
        probe += 1
    return num


@inlined_fused
def _combine(table, row, red, green, blue):
    """One observation joins a row's moments (`join.combine_moments`)."""
    count, mean, m2 = table[2], table[3], table[4]
    before = count[row]
    after = before + _ONE
    weight = _ONE / after
    squared = _ZERO
    for channel, color in ((0, red), (1, green), (2, blue)):
        d = color - mean[channel, row]
        mean[channel, row] += d * weight
        squared += d * d
    count[row] = after
    m2[row] += squared * before * weight


@parallel_kernel
def _join_rows(
    key, visited, count, mean, m2, resolution,
    sums, order, first, num, rows, camera, bins, lattice, workers,
):  # fmt: skip
    """The observations of a chunk join their rows (`update.observe_voxels`, `join.join`)."""
    capacity = key.shape[1]
    for worker in prange(workers):
        for i in range(worker * num // workers, (worker + 1) * num // workers):
            row, group = rows[i], order[first + i]
            if row < capacity:
                points = max(sums[group, 3], _ONE)
                _combine(
                    (key, visited, count, mean, m2, resolution), row,
                    sums[group, 0] / points, sums[group, 1] / points, sums[group, 2] / points,
                )  # fmt: skip
                chosen, sharper = evidence(key, row, camera, bins, lattice)
                visited[chosen >> 5, row] |= np.uint32(1) << np.uint32(chosen & 31)
                resolution[row] = max(resolution[row], sharper)


@kernel
def add_pass(table, camera, points, rgb, bins, lattice, workers, lost):
    """Adds a frame's points to the map, in place.

    Args:
        table: key, visited, count, mean, m2, resolution.
        camera: voxel size, focal length and position.
        points: packed keys of their voxels, all ones for points to ignore [2, P].
        rgb: their colors [P, 3].
        bins: candidates of each octahedral cell [S^2, K].
        lattice: directions of the bins [B, 3].
        workers: threads.
        lost: written: voxels that found no row [1].
    """
    lost[0] = 0
    if not is_sound(camera):
        return
    key, visited, count, mean, m2, resolution = table
    num = points.shape[1]
    keys, sums = np.empty((2, num), np.uint32), np.empty((num, 4), np.float32)
    order, rows = np.empty(num, np.int32), np.empty(_CHUNK, np.int64)
    voxels = group_points(points, rgb, (keys, sums, order))
    for first in range(0, voxels, _CHUNK):
        size = min(_CHUNK, voxels - first)
        _find_rows(key, keys, order, first, size, workers, rows)
        lost[0] += _claim_rows(key, keys, order, first, size, rows)
        _join_rows(
            key, visited, count, mean, m2, resolution,
            sums, order, first, size, rows, camera, bins, lattice, workers,
        )  # fmt: skip
