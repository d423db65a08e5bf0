"""Squared gradients of single pixels, summed over the image: the Hessian diagonal of FisherRF.

Of one pixel's color, summed over its channels, the gradient by a Gaussian's parameters is linear
in seven numbers: v, v dx, v dy, v dx^2, v dx dy, v dy^2 with v = alpha dC/dalpha (see
`compositing.py`), and the weight w. With A the matrix of that map, which depends on the Gaussian
and the view alone,

    sum over pixels of (A s)^2 = diagonal of A M A^T,    M = sum over pixels of s s^T.

So the tiles sum up M, and A is applied once per Gaussian. v alone moves nothing but the opacity,
so that of its row of M one number is needed, and 19 in all. The other columns of A come from the
backward pass, given one of the six numbers at a time.

What single Gaussians show of a view: their weights, summed over pixels one by one.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.constants import TILE
from r3jax.kernels.native.compiled import claim, inlined, kernel, parallel_kernel
from r3jax.kernels.splatting import records as at
from r3jax.kernels.splatting.compositing import (
    PIXELS,
    clear_tile,
    gradient_by_alpha,
    over_lists,
)
from r3jax.kernels.splatting.gradient import (
    ROOM,
    center_gradient,
    color_gradient,
    conic_gradient,
    geometry_of,
    shape_gradient,
    sum_slots,
)
from r3jax.kernels.splatting.lanes import (
    fma,
    keep_gt,
    load,
    splat,
    store12,
    sums_of_10,
)
from r3jax.kernels.splatting.passes import expect_writes
from r3jax.kernels.splatting.project import sigmoid

MOMENTS = 19
"""Different numbers in M: v^2 by the monomials 1, dx^2, dx^3, dx^4, dx dy, dx^2 dy, dx^3 dy, dy^2,
dx dy^2, dx^2 dy^2, dy^3, dx dy^3, dy^4; v w by dx, dx^2, dy, dx dy, dy^2; w^2."""

_PLACES = (
    (1, 4, 2, 5, 8, 13),
    (4, 7, 5, 8, 10, 15),
    (2, 5, 3, 6, 9, 14),
    (5, 8, 6, 9, 11, 16),
    (8, 10, 9, 11, 12, 17),
    (13, 15, 14, 16, 17, 18),
)
"""Where each entry of M stands among the moments, for v dx, v dy, v dx^2, v dx dy, v dy^2, w."""

_NUMBERS = (1, 3, 2, 4, 5)
"""Where the backward pass takes the first five."""

SLOT = 24
"""Floats of an intersection: `MOMENTS`, and what the last vector that is stored writes beyond."""

_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)


@inlined
def _read_colors(left, top, inputs, state):
    """Lays out a tile: transmittance 1, and the pixel's color over black less alpha background."""
    rgb, alpha, background = inputs
    # Pixels beside the image have no gradient.
    clear_tile(left, top, alpha.shape[1], alpha.shape[0], state)
    for y in range(min(TILE, alpha.shape[0] - top)):
        for x in range(min(TILE, alpha.shape[1] - left)):
            v, u = top + y, left + x
            color = rgb[v, u, 0] + rgb[v, u, 1] + rgb[v, u, 2]
            state[PIXELS + TILE * y + x] = color - alpha[v, u] * background


@inlined
def _no_moments():
    zero = splat(_ZERO)
    return zero, zero, zero, zero, zero, zero, zero, zero, zero


@inlined
def _add_moments(record, pixels, inputs, state, sums):
    """Adds v^2 by powers of dy up to the fourth, v w by those up to the second, and w^2."""
    k, dy, free, alpha, _, weight = pixels
    vv0, vv1, vv2, vv3, vv4, vw0, vw1, vw2, ww = sums
    q = splat(record[at.RED] + record[at.GREEN] + record[at.BLUE] - inputs[2])
    v = gradient_by_alpha(k, free, alpha, weight, q, state)
    vv, vw = v * v, v * weight
    vv_dy, vw_dy = vv * dy, vw * dy
    vv_dy2 = vv_dy * dy
    vv_dy3 = vv_dy2 * dy
    vv0, vv1, vv2 = vv0 + vv, vv1 + vv_dy, vv2 + vv_dy2
    vv3, vv4 = vv3 + vv_dy3, fma(vv_dy3, dy, vv4)
    vw0, vw1, vw2 = vw0 + vw, vw1 + vw_dy, fma(vw_dy, dy, vw2)
    return vv0, vv1, vv2, vv3, vv4, vw0, vw1, vw2, fma(weight, weight, ww)


@inlined
def _store_moments(sums, dx, slots, slot):
    vv0, vv1, vv2, vv3, vv4, vw0, vw1, vw2, ww = sums
    dx2 = dx * dx
    dx3, dx4 = dx2 * dx, dx2 * dx2
    a = sums_of_10(
        vv0, vv0 * dx2, vv0 * dx3, vv0 * dx4,
        vv1 * dx, vv1 * dx2, vv1 * dx3, vv2, vv2 * dx, vv2 * dx2,
    )  # fmt: skip
    b = sums_of_10(
        vv3, vv3 * dx, vv4, vw0 * dx, vw0 * dx2, vw1, vw1 * dx, vw2, ww, splat(_ZERO)
    )  # fmt: skip
    # In this order: each vector has twelve lanes, of which ten count.
    store12(slots, slot, a)
    store12(slots, slot + 10, b)


_moments_of_all = over_lists(2, SLOT, _read_colors, _no_moments, _add_moments, _store_moments)
"""Computes the moments of all intersections; takes rgb, alpha and the background."""


@inlined
def _quadratic(columns, sums, parameter, first, last):
    """Computes a^T M a for one parameter, a being its row of A; clamps it to 0 from below."""
    total = _ZERO
    for k in range(first, last):
        inner = _HALF * sums[_PLACES[k][k]] * columns[k, parameter]
        for j in range(first, k):
            inner += sums[_PLACES[k][j]] * columns[j, parameter]
        total += columns[k, parameter] * inner
    return _ZERO if total < _ZERO else total + total


@inlined
def _fill_columns(i, cloud, record, view, size, room, unit, g_view, g_sh, columns):
    """Writes A by center, scales and quaternion, [6, 10], and the gradient by the harmonics."""
    means, quats, log_scales, _, sh, _ = cloud
    center, slopes, covariance, shape = geometry_of(
        means[i], quats[i], log_scales[i], view, size, room
    )
    xx, xy, yy = covariance
    for k in range(5):
        for j in range(9):
            unit[j] = _ZERO
        unit[_NUMBERS[k]] = _ONE
        g_u, g_v, g_xx, g_xy, g_yy = conic_gradient(unit, xx, xy, yy)
        shape_gradient((g_xx, g_xy, g_yy), shape, room, columns[k, 3:6], columns[k, 6:10])
        g_x, g_y, g_z = center_gradient(g_u, g_v, center, slopes, view, room, g_view)
        for j in range(3):
            columns[k, j] = view[j] * g_x + view[3 + j] * g_y + view[6 + j] * g_z
    # The weight moves all three channels, 6 to 8, which are summed before they are squared.
    unit[6], unit[7], unit[8] = _ONE, _ONE, _ONE
    away = color_gradient(means[i], sh[i], view, record, unit[6:9], room, g_sh)
    columns[5, 0], columns[5, 1], columns[5, 2] = away


@kernel
def _squares_of_block(block, cloud, records, slots, view, size, squares):
    """Computes the squares of a block of Gaussians; 0 for those that were not drawn."""
    integers = records.view(np.int32)
    room, sums = np.empty(ROOM, np.float32), np.empty(MOMENTS, np.float32)
    unit, columns = np.empty(9, np.float32), np.empty((6, 10), np.float32)
    g_view, g_sh = np.zeros(19), np.empty(cloud[4].shape[1], np.float32)
    s_means, s_quats, s_scales, s_logits, s_sh = squares
    for i in range(block * at.BLOCK, min((block + 1) * at.BLOCK, records.shape[0])):
        count, start = integers[i, at.COUNT], integers[i, at.START]
        if count == 0 or not sum_slots(start, count, SLOT, MOMENTS, slots, sums):
            s_means[i], s_quats[i], s_scales[i] = _ZERO, _ZERO, _ZERO
            s_logits[i], s_sh[i] = _ZERO, _ZERO
            continue
        _fill_columns(i, cloud, records[i], view, size, room, unit, g_view, g_sh, columns)
        for k in range(3):
            s_means[i, k] = _quadratic(columns, sums, k, 0, 6)
            # Nothing but the covariance, numbers 2 to 4, depends on shapes.
            s_scales[i, k] = _quadratic(columns, sums, 3 + k, 2, 5)
        for k in range(4):
            s_quats[i, k] = _quadratic(columns, sums, 6 + k, 2, 5)
        slope = _ONE - sigmoid(cloud[3][i])
        s_logits[i] = slope * slope * sums[0]
        # A coefficient moves its own channel alone.
        for k in range(g_sh.shape[0]):
            s_sh[i, k] = g_sh[k] * g_sh[k] * sums[MOMENTS - 1]


@parallel_kernel
def _squares_of_cloud(cloud, records, slots, view, size, workers, squares):
    """Computes the squares by all parameters, block by block."""
    blocks = -(-records.shape[0] // at.BLOCK)
    next_block = np.zeros(1, np.int64)
    for _ in prange(workers):
        block = claim(next_block)
        while block < blocks:
            _squares_of_block(block, cloud, records, slots, view, size, squares)
            block = claim(next_block)


@kernel
def squares_pass(cloud, view, workers, images, records, lists, background, squares):
    """Sums over pixels of squared gradients; takes what the forward pass wrote.

    Args:
        cloud: as `forward_pass` takes it.
        view: see `VIEW_SIZE`.
        workers: threads to share the work.
        images: rgb [H, W, 3], depth [H, W], alpha [H, W].
        records: [n, 16].
        lists: ids, slots, rows [budget], starts [tiles + 1], ends [tiles].
        background: the sum of its three channels.
        squares: written; by means, quats, log_scales, opacity logits, harmonics.
    """
    tile_starts, alpha = lists[3], images[2]
    size = alpha.shape[1], alpha.shape[0]
    slots = np.empty(np.int64(tile_starts[-1]) * SLOT + SLOT, np.float32)
    expect_writes(slots)
    _moments_of_all(lists, records, (images[0], alpha, background), size, workers, slots)
    _squares_of_cloud(cloud, records, slots, view, size, workers, squares)


@inlined
def _read_values(left, top, inputs, state):
    """Lays out a tile: transmittance 1 in the image and 0 beside it, the value, what counts."""
    value, counts, _ = inputs
    clear_tile(left, top, value.shape[1], value.shape[0], state)
    for y in range(min(TILE, value.shape[0] - top)):
        for x in range(min(TILE, value.shape[1] - left)):
            k = TILE * y + x
            state[PIXELS + k] = value[top + y, left + x]
            state[2 * PIXELS + k] = counts[top + y, left + x]


@inlined
def _no_tallies():
    return splat(_ZERO), splat(_ZERO)


@inlined
def _add_tallies(record, pixels, inputs, state, sums):
    """Adds weight x value, and what counts, of pixels above both limits."""
    k, _, _, _, before, weight = pixels
    least = inputs[2]
    weight = keep_gt(keep_gt(weight, before, least[0]), weight, least[1])
    total = fma(weight, load(state, PIXELS + k), sums[0])
    return total, sums[1] + keep_gt(load(state, 2 * PIXELS + k), weight, _ZERO)


@inlined
def _store_tallies(sums, dx, slots, slot):
    zero = splat(_ZERO)
    both = sums_of_10(sums[0], sums[1], zero, zero, zero, zero, zero, zero, zero, zero)
    store12(slots, slot, both)


_tallies_of_all = over_lists(
    3, at.GRADIENT_SIZE, _read_values, _no_tallies, _add_tallies, _store_tallies
)
"""Computes the tallies of all intersections; takes the value, what counts and the limits."""


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
    size = value.shape[1], value.shape[0]
    _tallies_of_all(lists, records, (value, counts, least), size, workers, slots)
    integers = records.view(np.int32)
    for i in range(records.shape[0]):
        total, number = _ZERO, _ZERO
        start = integers[i, at.START]
        for slot in range(start, start + integers[i, at.COUNT]):
            total += slots[slot * at.GRADIENT_SIZE]
            number += slots[slot * at.GRADIENT_SIZE + 1]
        tallies[i, 0], tallies[i, 1] = total, number
