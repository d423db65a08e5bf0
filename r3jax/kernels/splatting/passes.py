"""The forward and the backward pass of a view: from the scene's arrays to images and gradients.

Gaussians are listed by tile, near ones first: projection, counting, one sort by (tile, depth). A
Gaussian is listed in the tiles that its ellipse touches: its exact rows in each column of tiles.
Large fresh arrays come in large pages: else the first write to 38 MB costs 10 000 page faults.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import sys

import numpy as np
from numba import prange, types

from r3jax.kernels.constants import TILE
from r3jax.kernels.native.compiled import claim, inlined, kernel, parallel_kernel
from r3jax.kernels.splatting import records as at
from r3jax.kernels.splatting.compositing import composite_all, gradient_of_all
from r3jax.kernels.splatting.gradient import gradient_of_cloud
from r3jax.kernels.splatting.project import color_one, project_one
from r3jax.kernels.splatting.records import (
    CENTER_X,
    CENTER_Y,
    INVERSE_XX,
    SLOPE,
    TWO_S,
    VARIANCE,
)

_SLACK = np.float32(2e-3)
"""Added to every extent [px], so that rounding never cuts off a pixel."""

_HALF = np.float32(0.5)
_ZERO = np.float32(0.0)


@inlined
def pixel_range(low, high, size):
    """Finds the first and last pixel whose center lies in [low, high], within the image."""
    first = np.ceil(max(low, _ZERO) - _HALF)
    last = np.floor(min(high, np.float32(size)) - _HALF)
    # Comparisons in floats first: a far-away bound would not fit an integer.
    if not (first <= last):
        return 0, -1
    return max(int(first), 0), min(int(last), size - 1)


@inlined
def tile_columns(record, width):
    """Finds the first and last column of tiles that the ellipse touches."""
    reach = np.sqrt(record[TWO_S] / record[INVERSE_XX]) + _SLACK
    first, last = pixel_range(record[CENTER_X] - reach, record[CENTER_X] + reach, width)
    if last < first:
        return 0, -1
    return first // TILE, last // TILE


@inlined
def rows_in_column(record, column, height):
    """Finds the first and last pixel row that the ellipse touches in one column of tiles.

    On the ellipse, dy = slope dx +- sqrt(variance (2 s - dx^2 / xx)) (the Gaussian's conditional
    mean and variance). Its highest point in a strip is that of the whole ellipse, or lies on the
    edge of the strip that is nearer to it.
    """
    slope, variance = record[SLOPE], record[VARIANCE]
    inverse, two_s = record[INVERSE_XX], record[TWO_S]
    reach = np.sqrt(two_s / inverse)
    left = np.float32(column * TILE) + _HALF - record[CENTER_X]
    low, high = max(left, -reach), min(left + np.float32(TILE - 1), reach)
    yy = variance + slope * slope / inverse
    at_top = slope / inverse * np.sqrt(two_s / yy)
    x = min(max(at_top, low), high)
    most = slope * x + np.sqrt(variance * max(two_s - x * x * inverse, _ZERO))
    x = min(max(-at_top, low), high)
    least = slope * x - np.sqrt(variance * max(two_s - x * x * inverse, _ZERO))
    y = record[CENTER_Y]
    return pixel_range(y + least - _SLACK, y + most + _SLACK, height)


_RADIX = 11  # bits a pass; three passes sort the 31 bits of a positive float


@inlined
def _tiles_of(record, width, height):
    """Counts the tiles that a Gaussian touches."""
    first, last = tile_columns(record, width)
    count = 0
    for column in range(first, last + 1):
        low, high = rows_in_column(record, column, height)
        if low <= high:
            count += high // TILE - low // TILE + 1
    return count


@kernel
def _project_block(block, cloud, view, size, records, counts):
    """Projects the Gaussians of a block; counts the visible ones and their intersections."""
    means, quats, log_scales, logits, sh, offsets = cloud
    width, height = size
    integers = records.view(np.int32)
    scratch, basis = np.empty(21, np.float32), np.empty(16, np.float32)
    drawn, intersections = 0, 0
    for i in range(block * at.BLOCK, min((block + 1) * at.BLOCK, means.shape[0])):
        record, count = records[i], 0
        if project_one(
            means[i], quats[i], log_scales[i], logits[i], offsets[i],
            view, width, height, scratch, record,
        ):  # fmt: skip
            count = _tiles_of(record, width, height)
            if count > 0 and not color_one(means[i], sh[i], view, basis, record):
                count = 0
        drawn += count > 0
        intersections += count
        integers[i, at.COUNT] = count
    counts[block, 0], counts[block, 1] = drawn, intersections


@parallel_kernel
def project_all(cloud, view, size, workers, records, counts):
    """Projects all Gaussians, block by block."""
    next_block = np.zeros(1, np.int64)
    for _ in prange(workers):
        block = claim(next_block)
        while block < counts.shape[0]:
            _project_block(block, cloud, view, size, records, counts)
            block = claim(next_block)


@kernel
def sums_before(counts):
    """Replaces the counts of the blocks by the sums of all earlier ones; returns the totals."""
    drawn, intersections = 0, 0
    for block in range(counts.shape[0]):
        a, b = counts[block]
        counts[block, 0], counts[block, 1] = drawn, intersections
        drawn, intersections = drawn + a, intersections + b
    return drawn, intersections


@kernel
def _emit_block(block, size, records, counts, drawn, tiles, rows):
    """Writes the intersections of a block's Gaussians, and who they are."""
    width, height = size
    keys, ids, starts = drawn
    columns = -(-width // TILE)
    integers = records.view(np.int32)
    number, slot = counts[block]
    for i in range(block * at.BLOCK, min((block + 1) * at.BLOCK, records.shape[0])):
        if integers[i, at.COUNT] == 0:
            continue
        record = records[i]
        # Depths are positive: their bits have the order of the numbers.
        keys[number], ids[number], starts[number] = integers[i, at.DEPTH], i, slot
        integers[i, at.START] = slot
        number += 1
        first, last = tile_columns(record, width)
        for column in range(first, last + 1):
            low, high = rows_in_column(record, column, height)
            if low > high:
                continue
            for tile_row in range(low // TILE, high // TILE + 1):
                top = max(low - tile_row * TILE, 0)
                bottom = min(high - tile_row * TILE, TILE - 1)
                tiles[slot] = tile_row * columns + column
                rows[slot] = top | (bottom << 4)
                slot += 1


@parallel_kernel
def emit_all(size, workers, records, counts, drawn, tiles, rows):
    """Writes all intersections, contiguous for each Gaussian, in the order of the Gaussians.

    `drawn` is written, too: of each Gaussian that is drawn its depth as a sort key, its row in
    the scene, and where its intersections start.
    """
    next_block = np.zeros(1, np.int64)
    for _ in prange(workers):
        block = claim(next_block)
        while block < counts.shape[0]:
            _emit_block(block, size, records, counts, drawn, tiles, rows)
            block = claim(next_block)
    drawn[2][-1] = tiles.shape[0]


@kernel
def order_of(keys):
    """Sorts the keys stably by radix sort, least significant digits first; returns the order."""
    n, buckets = keys.shape[0], 1 << _RADIX
    places = np.zeros((3, buckets), np.int32)
    for i in range(n):
        for digit in range(3):
            places[digit, (keys[i] >> (_RADIX * digit)) & (buckets - 1)] += 1
    for digit in range(3):
        total = np.int32(0)
        for bucket in range(buckets):
            count = places[digit, bucket]
            places[digit, bucket] = total
            total += count
    order, other_keys, other = (
        np.arange(n).astype(np.int32),
        np.empty_like(keys),
        np.empty(n, np.int32),
    )
    for digit in range(3):
        for i in range(n):
            bucket = (keys[i] >> (_RADIX * digit)) & (buckets - 1)
            place = places[digit, bucket]
            places[digit, bucket] = place + 1
            other_keys[place], other[place] = keys[i], order[i]
        keys, other_keys = other_keys, keys
        order, other = other, order
    return order


@inlined
def _share(n, part, parts):
    """Returns the part-th of `parts` equal ranges of n items."""
    return n * part // parts, n * (part + 1) // parts


@parallel_kernel
def list_by_tile(order, drawn, tiles, rows, workers, tile_starts, list_ids, list_slots, list_rows):
    """Deals the intersections to the lists of their tiles, in the order of depth.

    Every worker counts, then deals, a range of the order; the ranges follow each other in each
    list, so the lists do not depend on the number of workers.
    """
    _, ids, starts = drawn
    num_tiles = tile_starts.shape[0] - 1
    places = np.zeros((workers, num_tiles), np.int32)
    for worker in prange(workers):
        first, last = _share(order.shape[0], worker, workers)
        for number in order[first:last]:
            for slot in range(starts[number], starts[number + 1]):
                places[worker, tiles[slot]] += 1
    total = np.int32(0)
    for tile in range(num_tiles):
        tile_starts[tile] = total
        for worker in range(workers):
            count = places[worker, tile]
            places[worker, tile] = total
            total += count
    tile_starts[num_tiles] = total
    for worker in prange(workers):
        first, last = _share(order.shape[0], worker, workers)
        for number in order[first:last]:
            i = ids[number]
            for slot in range(starts[number], starts[number + 1]):
                place = places[worker, tiles[slot]]
                places[worker, tiles[slot]] = place + 1
                list_ids[place], list_slots[place] = i, slot
                list_rows[place] = rows[slot]


_ON_LINUX = sys.platform == "linux"
_MADV_HUGEPAGE = 14
_PAGE = 4096
_WORTH_IT = 1 << 22  # bytes

_madvise = types.ExternalFunction("madvise", types.int32(types.intp, types.uintp, types.int32))


@inlined
def expect_writes(array):
    """Asks Linux for huge pages below a large array that is about to be written as a whole.

    XLA and Numba allocate it for every call. This is only advice: a failure is ignored.
    """
    size = array.size * array.itemsize
    if _ON_LINUX and size >= _WORTH_IT:
        first = -(-array.ctypes.data // _PAGE) * _PAGE
        _madvise(first, (array.ctypes.data + size) // _PAGE * _PAGE - first, _MADV_HUGEPAGE)


@kernel
def forward_pass(cloud, view, workers, images, totals, records, lists):
    """Renders a view.

    Args:
        cloud: means [n, 3], quats [n, 4], log_scales [n, 3], opacity logits [n],
            harmonics [n, k * 3], center offsets [n, 2].
        view: see `VIEW_SIZE`.
        workers: threads to share the work.
        images: written; rgb [H, W, 3], depth [H, W], alpha [H, W].
        totals: written; intersections needed, and how many of them exceed the budget. If any
            does, the images are black.
        records: written; [n, 16].
        lists: written; ids, slots, rows [budget], starts [tiles + 1], ends [tiles].
    """
    rgb, depth, alpha = images
    list_ids, list_slots, list_rows, tile_starts, tile_ends = lists
    size = alpha.shape[1], alpha.shape[0]
    budget, n = list_ids.shape[0], records.shape[0]
    counts = np.empty((-(-n // at.BLOCK), 2), np.int64)
    expect_writes(records)
    project_all(cloud, view, size, workers, records, counts)
    drawn, needed = sums_before(counts)
    most = np.int64(2**31 - 1)
    totals[0], totals[1] = min(needed, most), min(max(needed - budget, 0), most)
    if needed > budget:
        tile_starts[:] = 0
        records.view(np.int32)[:, at.COUNT] = 0
    else:
        order_keys, ids = np.empty(drawn, np.int32), np.empty(drawn, np.int32)
        who = order_keys, ids, np.empty(drawn + 1, np.int32)
        tiles, rows = np.empty(needed, np.int32), np.empty(needed, np.uint8)
        emit_all(size, workers, records, counts, who, tiles, rows)
        order = order_of(order_keys)
        list_by_tile(order, who, tiles, rows, workers, tile_starts, list_ids, list_slots, list_rows)
    composite_all(records, list_ids, list_rows, tile_starts, workers, rgb, depth, alpha, tile_ends)


@kernel
def backward_pass(cloud, view, workers, images, records, lists, gradients, g_cloud, g_view):
    """Computes the gradients by cloud and view from those by the images and the forward pass."""
    tile_starts, alpha = lists[3], images[2]
    size = alpha.shape[1], alpha.shape[0]
    slots = np.empty(tile_starts[-1] * at.GRADIENT_SIZE, np.float32)
    expect_writes(slots)
    expect_writes(g_cloud[4])  # harmonics, by far the largest
    gradient_of_all(lists, records, (*images, *gradients), size, workers, slots)
    gradient_of_cloud(cloud, records, slots, view, size, workers, g_cloud, g_view)
