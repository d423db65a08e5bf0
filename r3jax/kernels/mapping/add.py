"""A frame's pixels join the map in machine code: `mapping.associate`, then `mapping.join`.

Blocks of image rows are grouped by voxel each by itself, and their groups put together: the groups
do not depend on the number of threads. The rows of the map that new voxels take are those of the
plain formulas: `JOINED` voxels claim together, in rounds, and of those that want the same row the
last one gets it.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.geometry.voxels import EMPTY_WORD, INDEX_LIMIT
from r3jax.kernels import constants
from r3jax.kernels.constants import JOINED, MAX_PROBES
from r3jax.kernels.mapping.bins import camera_of, is_valid, mark_rows
from r3jax.kernels.mapping.paging import hash_of
from r3jax.kernels.native.arithmetic import floor, high_word, low_word
from r3jax.kernels.native.compiled import (
    in_wide_vectors,
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
    prefetch,
)

_ROWS = 32
"""Rows of a block: a thread takes one block after the other."""

_AROUND = 2
"""Rows on both sides of a block that its medians and their neighbors reach."""

_SPREAD_LOW, _SPREAD_HIGH = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77)
"""Odd factors that spread the bits of packed keys."""

_HALF, _TWO = np.float32(0.5), np.float32(2.0)
_FAR, _NEAR, _INFINITE = np.float32(constants.FAR), np.float32(1e-4), np.float32(np.inf)
_STRAY, _THIN = np.float32(constants.STRAY), np.float32(constants.THIN)
_LOWEST, _HIGHEST = np.float32(-INDEX_LIMIT), np.float32(INDEX_LIMIT - 1)


@inlined_fused
def _copy_rows(depth, first, block):
    """Copies depths of a block's rows and of those around it, with a column more on both sides.

    The border repeats its own pixels; no measurement is 0, out of range is far.
    """
    height, width = depth.shape
    for k in range(block.shape[0]):
        row = min(max(first + k - _AROUND, 0), height - 1)
        for j in range(width):
            value = depth[row, j] if depth[row, j] > _ZERO else _ZERO
            block[k, j + 1] = min(value, _FAR)
        block[k, 0], block[k, width + 1] = block[k, 1], block[k, width]


@inlined_fused
def _sort3(a, b, c):
    low, high = min(a, b), max(a, b)
    top, rest = max(high, c), min(high, c)
    return min(low, rest), max(low, rest), top


@inlined_fused
def _or(value, other):
    """Returns a depth, or the other one if the first is no measurement."""
    return value if value > _ZERO else other


@inlined_fused
def _median_row(above, here, below, median):
    """Computes medians of the 3x3 neighborhoods of a row (`associate._median9`)."""
    in_wide_vectors()
    for j in range(1, here.shape[0] - 1):
        own = here[j]
        a0, a1, a2 = _sort3(_or(above[j - 1], own), _or(above[j], own), _or(above[j + 1], own))
        b0, b1, b2 = _sort3(_or(here[j - 1], own), own, _or(here[j + 1], own))
        c0, c1, c2 = _sort3(_or(below[j - 1], own), _or(below[j], own), _or(below[j + 1], own))
        smallest, largest = max(max(a0, b0), c0), min(min(a2, b2), c2)
        median[j] = _sort3(smallest, _sort3(a1, b1, c1)[1], largest)[1]
    median[0], median[here.shape[0] - 1] = median[1], median[here.shape[0] - 2]


@inlined_fused
def _inverse(depth):
    return _ONE / max(depth, _NEAR)


@inlined_fused
def _breaks(before, depth, after, limit):
    """Checks if the surface breaks between two neighbors of a pixel (`associate._breaks`)."""
    before, after = _or(before, depth), _or(after, depth)
    step = max(abs(before - depth), abs(after - depth))
    bend = abs(_inverse(before) + _inverse(after) - _TWO * _inverse(depth))
    bend *= depth * max(max(before, after), depth)
    return (step > limit) & (bend > limit)


@inlined_fused
def _drop_edges(block, medians, k, size, counted):
    """Writes the depths of row k of a block, 0 for pixels on edges (`associate.edge_pixels`)."""
    in_wide_vectors()
    above, here, below = block[k - 1], block[k], block[k + 1]
    above_it, median, below_it = medians[k - 1], medians[k], medians[k + 1]
    for j in range(1, here.shape[0] - 1):
        depth, middle = here[j], median[j]
        is_edge = abs(depth - middle) > size + _STRAY * depth
        is_edge |= _breaks(median[j - 1], middle, median[j + 1], size)
        is_edge |= _breaks(above_it[j], middle, below_it[j], size)
        limit = size + _THIN * depth
        is_edge |= _breaks(here[j - 1], depth, here[j + 1], limit)
        is_edge |= _breaks(above[j], depth, below[j], limit)
        counted[j - 1] = _ZERO if is_edge else _ONE


@inlined_fused
def _index(T, x, y, depth, size):
    """Computes the index of the voxel along one axis, as a float (`voxels.voxel_index`).

    Args:
        T: row of `T_world_camera` for that axis.
        x: of the point in the camera's frame [m].
        y: see x.
        depth: see x.
        size: edge of a voxel [m].
    """
    along = T[0] * x + T[1] * y
    along = along + T[2] * depth + T[3]
    return min(max(floor(along / size), _LOWEST), _HIGHEST)


@inlined_fused
def _pack_row(depths, counted, columns, v, frame, size, low, high, spread):
    """Packs keys of the voxels of a row's pixels, all ones where nothing counts."""
    in_wide_vectors()
    reach, T = frame.max_range, frame.T_world_camera
    T_x = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    T_y = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    T_z = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for j in range(depths.shape[0]):
        depth = depths[j]
        is_in = (depth > _ZERO) & (depth <= reach) & (depth < _INFINITE) & (counted[j] > _ZERO)
        depth = depth if is_in else _ONE
        x, y = columns[j] * depth, v * depth
        at_x, at_y = _index(T_x, x, y, depth, size), _index(T_y, x, y, depth, size)
        at_z = _index(T_z, x, y, depth, size)
        low[j] = low_word(at_x, at_y) if is_in else _EMPTY
        high[j] = high_word(at_y, at_z) if is_in else _EMPTY
        spread[j] = _spread(low[j], high[j])


# Rows and tables are filled one by one: Numba compiles each assignment to a slice for a second.


@inlined
def _repeat(row, copy):
    for j in range(row.shape[0]):
        copy[j] = row[j]


@inlined
def _empty(slots):
    for i in range(slots.shape[0]):
        slots[i] = np.int32(-1)


@inlined_fused
def _fill_medians(block, medians, first, height):
    """Computes medians of a block's rows and one row on both sides; the border is repeated."""
    last = block.shape[0] - _AROUND
    for k in range(_AROUND - 1, last + 1):
        if 0 <= first + k - _AROUND < height:
            _median_row(block[k - 1], block[k], block[k + 1], medians[k])
    if first == 0:
        _repeat(medians[_AROUND], medians[_AROUND - 1])
    if first + _ROWS >= height:
        end = height - first + _AROUND
        _repeat(medians[end - 1], medians[end])


@inlined
def _spread(low, high):
    """Spreads a packed key over a word, whose upper bits depend on all bits of the key.

    Two products instead of the hash of the map's table: no row is chosen by it, and every pixel
    needs one.
    """
    return np.uint32(np.uint32(low * _SPREAD_LOW) ^ np.uint32(high * _SPREAD_HIGH))


@inlined
def _group_of(low, high, spread, shift, slots, keys, new):
    """Finds the group of a voxel in a scratch table; a voxel without one becomes group `new`."""
    slot, mask = np.uint32(spread >> shift), np.uint32(slots.shape[0] - 1)
    while slots[slot] >= 0:
        found = np.uint32(slots[slot])
        if keys[found, 0] == low and keys[found, 1] == high:
            return np.int64(found)
        slot = np.uint32(slot + np.uint32(1)) & mask
    slots[slot], keys[new, 0], keys[new, 1] = np.int32(new), low, high
    return np.int64(new)


@inlined
def _shift_for(num):
    """Computes the bits to drop from a word for a table of twice `num` slots: searches end."""
    shift = 31
    while (1 << (32 - shift)) < 2 * num:
        shift -= 1
    return np.uint32(shift)


@inlined_fused
def _group_row(low, high, spread, rgb, shift, slots, keys, sums, count):
    """Adds a row's pixels to the groups of a block, last pixel first; returns how many there are.

    Each pixel is looked up by itself: whether it shares the voxel of the pixel before is a guess
    that fails too often where a surface lies between two voxels.
    """
    for k in range(low.shape[0]):
        j = np.uint32(low.shape[0] - 1 - k)
        if high[j] != _EMPTY:
            found = _group_of(low[j], high[j], spread[j], shift, slots, keys, count)
            group = np.uint32(found)
            if found == count:
                sums[group, 0], sums[group, 1], sums[group, 2] = _ZERO, _ZERO, _ZERO
                sums[group, 3] = _ZERO
                count += 1
            sums[group, 0] += rgb[j, 0]
            sums[group, 1] += rgb[j, 1]
            sums[group, 2] += rgb[j, 2]
            sums[group, 3] += _ONE
    return count


@parallel_kernel
def _group_blocks(frame, size, workers, keys, sums, counts):
    """Groups the pixels of each block; those of the block from row i on stand from i W on."""
    depth, rgb = frame.depth, frame.rgb
    height, width = depth.shape
    columns, shift = np.empty(width, np.float32), _shift_for(_ROWS * width)
    for j in range(width):
        columns[j] = (np.float32(j) + _HALF - frame.cx) / frame.fx
    for worker in prange(workers):
        block = np.empty((_ROWS + 2 * _AROUND, width + 2), np.float32)
        medians = np.empty((_ROWS + 2 * _AROUND, width + 2), np.float32)
        counted = np.empty(width, np.float32)
        for j in range(width):
            counted[j] = _ONE
        low, high = np.empty(width, np.uint32), np.empty(width, np.uint32)
        spread = np.empty(width, np.uint32)
        # A thread's own, which stay in its caches from block to block.
        slots = np.empty(1 << (32 - shift), np.int32)
        own_keys = np.empty((_ROWS * width, 2), np.uint32)
        own_sums = np.empty((_ROWS * width, 4), np.float32)
        for number in range(worker, counts.shape[0], workers):
            first, end = number * _ROWS, min((number + 1) * _ROWS, height)
            if frame.drops_edges > _ZERO:
                _copy_rows(depth, first, block)
                _fill_medians(block, medians, first, height)
            _empty(slots)
            count = 0
            for row in range(end - 1, first - 1, -1):
                if frame.drops_edges > _ZERO:
                    _drop_edges(block, medians, row - first + _AROUND, size, counted)
                v = (np.float32(row) + _HALF - frame.cy) / frame.fy
                _pack_row(depth[row], counted, columns, v, frame, size, low, high, spread)
                count = _group_row(
                    low, high, spread, rgb[row], shift, slots, own_keys, own_sums, count
                )
            counts[number] = count
            for i in range(count):
                place = first * width + i
                keys[place, 0], keys[place, 1] = own_keys[i, 0], own_keys[i, 1]
                for channel in range(4):
                    sums[place, channel] = own_sums[i, channel]


@kernel
def group_pixels(frame, size, workers):
    """Groups a frame's pixels by voxel.

    Args:
        frame: `calls.FrameArrays`.
        size: edge of a voxel [m].
        workers: threads.

    Returns:
        Packed keys [G, 2] and sums of colors and numbers of pixels [G, 4] of the voxels that
        pixels fall into, in the order of their last pixels.
    """
    height, width = frame.depth.shape
    num = height * width
    keys, sums = np.empty((num, 2), np.uint32), np.empty((num, 4), np.float32)
    counts, most = np.empty((height + _ROWS - 1) // _ROWS, np.int64), 0
    _group_blocks(frame, size, workers, keys, sums, counts)
    for number in range(counts.shape[0]):
        most += counts[number]
    merged_keys, merged_sums = np.empty((most, 2), np.uint32), np.empty((most, 4), np.float32)
    shift, place = _shift_for(most), most
    slots = np.empty(1 << (32 - shift), np.int32)
    _empty(slots)
    # From the last pixel to the first, as the blocks were gone through: the first group of a
    # voxel that is met has its last pixel. Filled from the end, so the order is that of pixels.
    for number in range(counts.shape[0] - 1, -1, -1):
        for i in range(number * _ROWS * width, number * _ROWS * width + counts[number]):
            low, high = keys[i, 0], keys[i, 1]
            group = _group_of(low, high, _spread(low, high), shift, slots, merged_keys, place - 1)
            if group == place - 1:
                for channel in range(4):
                    merged_sums[group, channel] = _ZERO
                place -= 1
            for channel in range(4):
                merged_sums[group, channel] += sums[i, channel]
    return merged_keys[place:], merged_sums[place:]


_AHEAD = 8
"""Prefetch distance [voxels]: rows lie anywhere in memory."""

_EMPTY = np.uint32(EMPTY_WORD)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


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
            rows[i] = _slot(hash_of(keys[i, 0], keys[i, 1]), 0, capacity)
        for i in range(begin, end):
            if i + _AHEAD < end:
                prefetch(table[0], rows[i + _AHEAD])
                prefetch(table[1], rows[i + _AHEAD])
            low, high = keys[i, 0], keys[i, 1]
            hashed, found, probe = hash_of(low, high), np.int64(capacity), 0
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
            slot = _slot(hash_of(keys[group, 0], keys[group, 1]), probe, capacity)
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
    """Prefetches a row. Columns are separate arrays, so each is its own cache line."""
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
