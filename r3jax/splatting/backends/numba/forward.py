"""Compositing of tiles, front to back: one vector of 16 pixels for each row of a tile."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.splatting import config
from r3jax.splatting.backends.numba import records as at
from r3jax.splatting.backends.numba.compiled import claim, inlined, kernel, parallel_kernel
from r3jax.splatting.backends.numba.lanes import (
    any_above,
    exp2,
    fma,
    keep_ge,
    keep_gt,
    lane_numbers,
    larger,
    load,
    prefetch,
    smaller,
    splat,
    store,
)
from r3jax.splatting.config import TILE

PIXELS = TILE * TILE
ALPHA_MIN, ALPHA_MAX = np.float32(config.ALPHA_MIN), np.float32(config.ALPHA_MAX)
TRANSMITTANCE_MIN = np.float32(config.TRANSMITTANCE_MIN)
CHECK_EVERY = 16
"""Gaussians between two looks whether a tile is finished."""

AHEAD = 8
"""Gaussians between the request of a record and its use."""

_POWER_MIN = np.float32(-30.0)  # far below 1/255, far above the end of float32
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)


@inlined
def alpha_in_row(record, dx, across, slant, dy):
    """Alpha before it is cut off at 0.99, and 0 where it is below 1/255, for a row of pixels.

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
def _blend_row(k, alpha, color, depth, state):
    """Blends one Gaussian into a row of the tile's state.

    The transmittance is 0 from where compositing stops: what follows then weighs nothing.
    """
    red, green, blue = color
    before = load(state, k)
    behind = before - before * alpha
    weight = keep_gt(before * alpha, behind, TRANSMITTANCE_MIN)
    store(state, k, keep_gt(behind, behind, TRANSMITTANCE_MIN))
    store(state, PIXELS + k, fma(weight, red, load(state, PIXELS + k)))
    store(state, 2 * PIXELS + k, fma(weight, green, load(state, 2 * PIXELS + k)))
    store(state, 3 * PIXELS + k, fma(weight, blue, load(state, 3 * PIXELS + k)))
    store(state, 4 * PIXELS + k, fma(weight, depth, load(state, 4 * PIXELS + k)))
    store(state, 5 * PIXELS + k, load(state, 5 * PIXELS + k) + weight)


@inlined
def tile_is_finished(state):
    """Whether no pixel lets any light through."""
    most = load(state, 0)
    for k in range(TILE, PIXELS, TILE):
        most = larger(most, load(state, k))
    return not any_above(most, _ZERO)


@inlined
def _clear_tile(left, top, width, height, state):
    """An empty tile: light passes the pixels of the image, and none beside it."""
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
        dx = (record[at.CENTER_X] - (np.float32(left) + _HALF)) - lanes
        slant = record[at.B] * dx
        across = record[at.A] * dx * dx
        color = record[at.RED], record[at.GREEN], record[at.BLUE]
        depth = record[at.DEPTH]
        y = record[at.CENTER_Y] - (np.float32(top) + _HALF)
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
            _clear_tile(left, top, alpha.shape[1], alpha.shape[0], state)
            tile_ends[tile] = _composite_tile(
                tile_starts[tile], tile_starts[tile + 1], left, top,
                records, list_ids, list_rows, state,
            )  # fmt: skip
            _write_tile(left, top, state, rgb, depth, alpha)
            tile = claim(next_tile)
