"""Compositing of tiles and its gradient: one vector of 16 pixels for each row of a tile.

The forward pass goes front to back, and so does the gradient, by every intersection. With
q = color . dL/drgb + depth dL/ddepth + dL/dalpha at a pixel, L depends on the alpha of the i-th
Gaussian by

    dL/dalpha_i = T_i q_i - (sum over j > i of w_j q_j) / (1 - alpha_i),

where the sum is the pixel's total minus what has been passed. Every decision (skip, stop) is the
forward pass's own.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels import constants
from r3jax.kernels.constants import TILE
from r3jax.kernels.native.compiled import claim, inlined, kernel, parallel_kernel, prefetch
from r3jax.kernels.splatting import records as at
from r3jax.kernels.splatting.lanes import (
    any_above,
    exp2,
    fma,
    keep_ge,
    keep_gt,
    lane_numbers,
    larger,
    load,
    quotient,
    smaller,
    splat,
    store,
    store12,
    sums_of_10,
)

PIXELS = TILE * TILE
ALPHA_MIN, ALPHA_MAX = np.float32(constants.ALPHA_MIN), np.float32(constants.ALPHA_MAX)
TRANSMITTANCE_MIN = np.float32(constants.TRANSMITTANCE_MIN)
CHECK_EVERY = 16
"""Gaussians between two looks whether a tile is finished."""

AHEAD = 8
"""Gaussians between the request of a record and its use."""

_POWER_MIN = np.float32(-30.0)  # far below 1/255, far above the end of float32
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)


@inlined
def alpha_in_row(record, dx, across, slant, dy):
    """Computes alpha for a row of pixels before it is clipped at 0.99; 0 below 1/255.

    Args:
        record: the Gaussian.
        dx: center minus pixel, columns.
        across: A dx^2.
        slant: B dx.
        dy: center minus pixel, rows; a scalar.
    """
    power = fma(slant + record[at.C] * dy, splat(dy), across)
    alpha = exp2(larger(record[at.LOG_OPACITY] - power, splat(_POWER_MIN)))
    return keep_ge(keep_ge(alpha, alpha, ALPHA_MIN), power, _ZERO)


@inlined
def in_tile(record, left, top, lanes):
    """Computes the terms of a Gaussian's alpha in a tile: dx, A dx^2, B dx, its center's row."""
    dx = (record[at.CENTER_X] - (np.float32(left) + _HALF)) - lanes
    y = record[at.CENTER_Y] - (np.float32(top) + _HALF)
    return dx, record[at.A] * dx * dx, record[at.B] * dx, y


@inlined
def take_light(k, alpha, state):
    """Takes a Gaussian's weight in a row of pixels from the light that passes, and returns it.

    The transmittance is 0 from where compositing stops: what follows then weighs nothing.
    """
    before = load(state, k)
    behind = before - before * alpha
    store(state, k, keep_gt(behind, behind, TRANSMITTANCE_MIN))
    return keep_gt(before * alpha, behind, TRANSMITTANCE_MIN)


@inlined
def _blend_row(k, alpha, color, depth, state):
    """Blends one Gaussian into a row of the tile's state."""
    red, green, blue = color
    weight = take_light(k, alpha, state)
    store(state, PIXELS + k, fma(weight, red, load(state, PIXELS + k)))
    store(state, 2 * PIXELS + k, fma(weight, green, load(state, 2 * PIXELS + k)))
    store(state, 3 * PIXELS + k, fma(weight, blue, load(state, 3 * PIXELS + k)))
    store(state, 4 * PIXELS + k, fma(weight, depth, load(state, 4 * PIXELS + k)))
    store(state, 5 * PIXELS + k, load(state, 5 * PIXELS + k) + weight)


@inlined
def tile_is_finished(state):
    """Checks whether no pixel transmits any light."""
    most = load(state, 0)
    for k in range(TILE, PIXELS, TILE):
        most = larger(most, load(state, k))
    return not any_above(most, _ZERO)


@inlined
def clear_tile(left, top, width, height, state):
    """Clears a tile: light passes the pixels of the image, and none beside it."""
    state[:] = _ZERO
    for y in range(min(TILE, height - top)):
        state[TILE * y : TILE * y + min(TILE, width - left)] = _ONE


@kernel
def _composite_tile(first, last, left, top, records, list_ids, list_rows, state):
    """Composites the list of one tile on its cleared state; returns how far it went."""
    flat = records.reshape(-1)
    lanes = lane_numbers()
    for place in range(first, last):
        if (place - first) % CHECK_EVERY == CHECK_EVERY - 1 and tile_is_finished(state):
            return place
        if place + AHEAD < last:
            prefetch(flat, list_ids[place + AHEAD] * at.SIZE)
        record = records[list_ids[place]]
        dx, across, slant, y = in_tile(record, left, top, lanes)
        color = record[at.RED], record[at.GREEN], record[at.BLUE]
        depth = record[at.DEPTH]
        rows = list_rows[place]
        for row in range(rows & 15, (rows >> 4) + 1):
            alpha = alpha_in_row(record, dx, across, slant, y - np.float32(row))
            _blend_row(TILE * row, smaller(alpha, splat(ALPHA_MAX)), color, depth, state)
    return last


@inlined
def _write_tile(left, top, state, rgb, depth, alpha):
    """Copies the pixels of a tile that lie in the image."""
    for y in range(min(TILE, alpha.shape[0] - top)):
        for x in range(min(TILE, alpha.shape[1] - left)):
            k = TILE * y + x
            for channel in range(3):
                rgb[top + y, left + x, channel] = state[(channel + 1) * PIXELS + k]
            depth[top + y, left + x] = state[4 * PIXELS + k]
            alpha[top + y, left + x] = state[5 * PIXELS + k]


@parallel_kernel
def composite_all(records, list_ids, list_rows, tile_starts, workers, rgb, depth, alpha, tile_ends):
    """Composites all tiles; `tile_ends` tells the gradient how far each list was used."""
    columns = -(-alpha.shape[1] // TILE)
    next_tile = np.zeros(1, np.int64)
    for _ in prange(workers):
        state = np.empty(6 * PIXELS, np.float32)
        tile = claim(next_tile)
        while tile < tile_ends.shape[0]:
            left, top = tile % columns * TILE, tile // columns * TILE
            clear_tile(left, top, alpha.shape[1], alpha.shape[0], state)
            tile_ends[tile] = _composite_tile(
                tile_starts[tile], tile_starts[tile + 1], left, top,
                records, list_ids, list_rows, state,
            )  # fmt: skip
            _write_tile(left, top, state, rgb, depth, alpha)
            tile = claim(next_tile)


def over_lists(planes, slot_size, read_tile, no_sums, add_row, store_sums):
    """Makes a kernel that goes through the lists of all tiles once more, as the forward pass did.

    It sums up numbers of each intersection over the pixels of a tile, and writes them to its slot;
    slots of a Gaussian lie side by side.

    Args:
        planes: numbers of each pixel in the state of a tile; the transmittance comes first.
        slot_size: floats of an intersection.
        read_tile: lays out the state, with transmittance 1.
        no_sums: returns the sums of no pixels.
        add_row: adds a row of pixels: place in the state, distance from the center, alpha before
            it was cut off and after, transmittance in front, weight.
        store_sums: adds up the lanes, and writes them to a slot.
    """

    @kernel
    def of_tile(
        first, last, left, top, records, list_ids, list_slots, list_rows, inputs, state, slots
    ):
        flat = records.reshape(-1)
        lanes = lane_numbers()
        for place in range(first, last):
            if place + AHEAD < last:
                prefetch(flat, list_ids[place + AHEAD] * at.SIZE)
            record = records[list_ids[place]]
            dx, across, slant, y = in_tile(record, left, top, lanes)
            sums = no_sums()
            rows = list_rows[place]
            for row in range(rows & 15, (rows >> 4) + 1):
                k, dy = TILE * row, y - np.float32(row)
                free = alpha_in_row(record, dx, across, slant, dy)
                alpha = smaller(free, splat(ALPHA_MAX))
                before = load(state, k)
                weight = take_light(k, alpha, state)
                pixels = k, dy, free, alpha, before, weight
                sums = add_row(record, pixels, inputs, state, sums)
            store_sums(sums, dx, slots, list_slots[place] * slot_size)

    @parallel_kernel
    def of_all(lists, records, inputs, size, workers, slots):
        list_ids, list_slots, list_rows, tile_starts, tile_ends = lists
        columns = -(-size[0] // TILE)
        next_tile = np.zeros(1, np.int64)
        for _ in prange(workers):
            state = np.empty(planes * PIXELS, np.float32)
            tile = claim(next_tile)
            while tile < tile_ends.shape[0]:
                left, top = tile % columns * TILE, tile // columns * TILE
                read_tile(left, top, inputs, state)
                end = tile_ends[tile]
                of_tile(
                    tile_starts[tile], end, left, top,
                    records, list_ids, list_slots, list_rows, inputs, state, slots,
                )  # fmt: skip
                for place in range(end, tile_starts[tile + 1]):  # hidden behind the rest
                    slot = list_slots[place] * slot_size
                    slots[slot : slot + slot_size] = _ZERO
                tile = claim(next_tile)

    return of_all


@inlined
def _read_gradients(left, top, inputs, state):
    """Lays out a tile: transmittance 1, the pixel's total, and the five gradients of the images."""
    rgb, depth, alpha, g_rgb, g_depth, g_alpha = inputs
    state[:PIXELS] = _ONE
    state[PIXELS:] = _ZERO
    for y in range(min(TILE, alpha.shape[0] - top)):
        for x in range(min(TILE, alpha.shape[1] - left)):
            k, v, u = TILE * y + x, top + y, left + x
            total = depth[v, u] * g_depth[v, u] + alpha[v, u] * g_alpha[v, u]
            for channel in range(3):
                state[(2 + channel) * PIXELS + k] = g_rgb[v, u, channel]
                total += rgb[v, u, channel] * g_rgb[v, u, channel]
            state[PIXELS + k] = total
            state[5 * PIXELS + k], state[6 * PIXELS + k] = g_depth[v, u], g_alpha[v, u]


@inlined
def gradient_by_alpha(k, free, alpha, weight, q, state):
    """Computes alpha dL/dalpha in a row of pixels, and takes the Gaussian off their total.

    Args:
        k: first pixel of the row.
        free: alpha before it was cut off.
        alpha: after.
        weight: of the Gaussian.
        q: see above.
        state: of the tile; the total comes second.
    """
    passed = weight * q
    rest = load(state, PIXELS + k) - passed
    store(state, PIXELS + k, rest)
    v = passed - quotient(alpha * rest, _ONE - alpha)
    # Nothing flows where compositing has stopped, nor through the cut-off at 0.99.
    return keep_ge(keep_gt(v, weight, _ZERO), ALPHA_MAX, free)


@inlined
def _no_gradients():
    zero = splat(_ZERO)
    return zero, zero, zero, zero, zero, zero, zero


@inlined
def _add_gradients(record, pixels, inputs, state, sums):
    """Adds v, v dy, v dy^2, and the gradients by color and depth."""
    k, dy, free, alpha, _, weight = pixels
    v0, v1, v2, red, green, blue, depth = sums
    g_red, g_green = load(state, 2 * PIXELS + k), load(state, 3 * PIXELS + k)
    g_blue, g_depth = load(state, 4 * PIXELS + k), load(state, 5 * PIXELS + k)
    q = fma(g_red, record[at.RED], load(state, 6 * PIXELS + k))
    q = fma(g_green, record[at.GREEN], q)
    q = fma(g_blue, record[at.BLUE], q)
    q = fma(g_depth, record[at.DEPTH], q)
    v = gradient_by_alpha(k, free, alpha, weight, q, state)
    v_dy = v * dy
    red, green = fma(weight, g_red, red), fma(weight, g_green, green)
    blue, depth = fma(weight, g_blue, blue), fma(weight, g_depth, depth)
    return v0 + v, v1 + v_dy, fma(v_dy, dy, v2), red, green, blue, depth


@inlined
def _store_gradients(sums, dx, slots, slot):
    v0, v1, v2, red, green, blue, depth = sums
    v_dx = v0 * dx
    store12(slots, slot, sums_of_10(v0, v_dx, v_dx * dx, v1, v1 * dx, v2, red, green, blue, depth))


gradient_of_all = over_lists(
    7, at.GRADIENT_SIZE, _read_gradients, _no_gradients, _add_gradients, _store_gradients
)
"""Computes the gradients of all intersections; takes the images and the gradients by them."""
