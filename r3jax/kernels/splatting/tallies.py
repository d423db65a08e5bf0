"""What single Gaussians show of a view: their weights, summed over pixels one by one."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.constants import TILE
from r3jax.kernels.native.compiled import claim, inlined, kernel, parallel_kernel, prefetch
from r3jax.kernels.splatting import records as at
from r3jax.kernels.splatting.compositing import (
    AHEAD,
    ALPHA_MAX,
    PIXELS,
    alpha_in_row,
    clear_tile,
    in_tile,
    take_light,
)
from r3jax.kernels.splatting.lanes import (
    fma,
    keep_gt,
    lane_numbers,
    load,
    smaller,
    splat,
    store12,
    sums_of_10,
)
from r3jax.kernels.splatting.passes import expect_writes

_ZERO = np.float32(0.0)


@inlined
def _read_tile(left, top, value, counts, state):
    """Lays out a tile: transmittance 1 in the image and 0 beside it, the value, what counts."""
    clear_tile(left, top, value.shape[1], value.shape[0], state)
    for y in range(min(TILE, value.shape[0] - top)):
        for x in range(min(TILE, value.shape[1] - left)):
            k = TILE * y + x
            state[PIXELS + k] = value[top + y, left + x]
            state[2 * PIXELS + k] = counts[top + y, left + x]


@kernel
def _tallies_of_tile(
    first, last, left, top, records, list_ids, list_slots, list_rows, least, state, slots
):
    """Writes the tallies of a tile's intersections to their slots."""
    flat = records.reshape(-1)
    lanes = lane_numbers()
    zero = splat(_ZERO)
    for place in range(first, last):
        if place + AHEAD < last:
            prefetch(flat, list_ids[place + AHEAD] * at.SIZE)
        record = records[list_ids[place]]
        dx, across, slant, y = in_tile(record, left, top, lanes)
        total, number = zero, zero
        rows = list_rows[place]
        for row in range(rows & 15, (rows >> 4) + 1):
            k = TILE * row
            alpha = alpha_in_row(record, dx, across, slant, y - np.float32(row))
            alpha = smaller(alpha, splat(ALPHA_MAX))
            before = load(state, k)
            weight = take_light(k, alpha, state)
            weight = keep_gt(keep_gt(weight, before, least[0]), weight, least[1])
            total = fma(weight, load(state, PIXELS + k), total)
            number = number + keep_gt(load(state, 2 * PIXELS + k), weight, _ZERO)
        sums = sums_of_10(total, number, zero, zero, zero, zero, zero, zero, zero, zero)
        store12(slots, list_slots[place] * at.GRADIENT_SIZE, sums)


@parallel_kernel
def _tallies_of_all(lists, records, value, counts, least, workers, slots):
    """Computes the tallies of all intersections, those of a Gaussian side by side."""
    list_ids, list_slots, list_rows, tile_starts, tile_ends = lists
    columns = -(-value.shape[1] // TILE)
    next_tile = np.zeros(1, np.int64)
    for _ in prange(workers):
        state = np.empty(3 * PIXELS, np.float32)
        tile = claim(next_tile)
        while tile < tile_ends.shape[0]:
            left, top = tile % columns * TILE, tile // columns * TILE
            _read_tile(left, top, value, counts, state)
            end = tile_ends[tile]
            _tallies_of_tile(
                tile_starts[tile], end, left, top,
                records, list_ids, list_slots, list_rows, least, state, slots,
            )  # fmt: skip
            for place in range(end, tile_starts[tile + 1]):  # hidden behind the rest
                store12(slots, list_slots[place] * at.GRADIENT_SIZE, splat(_ZERO))
            tile = claim(next_tile)


@kernel
def tallies_pass(records, lists, workers, value, counts, least, tallies):
    """Sums over pixels of single Gaussians' weights; takes what the forward pass wrote.

    Args:
        records: [n, 16].
        lists: ids, slots, rows [budget], starts [tiles + 1], ends [tiles].
        workers: threads to share the work.
        value: [H, W].
        counts: what each pixel counts, [H, W].
        least: pixels are left out where the transmittance in front is not above the first, or
            the weight not above the second.
        tallies: written; [n, 2], the sum of weight x value, and of the counts.
    """
    tile_starts = lists[3]
    slots = np.empty(np.int64(tile_starts[-1]) * at.GRADIENT_SIZE, np.float32)
    expect_writes(slots)
    _tallies_of_all(lists, records, value, counts, least, workers, slots)
    integers = records.view(np.int32)
    for i in range(records.shape[0]):
        total, number = _ZERO, _ZERO
        start = integers[i, at.START]
        for slot in range(start, start + integers[i, at.COUNT]):
            total += slots[slot * at.GRADIENT_SIZE]
            number += slots[slot * at.GRADIENT_SIZE + 1]
        tallies[i, 0], tallies[i, 1] = total, number
