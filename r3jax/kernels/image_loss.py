"""The loss of an image and its gradient in machine code: `training.train_step`, row by row.

With means m_x, m_y, variances and covariance under the Gaussian window, SSIM at a pixel is

    l c,  l = (2 m_x m_y + C1) / p,  p = m_x^2 + m_y^2 + C1,
          c = (2 (w_xy - m_x m_y) + C2) / q,  q = w_xx - m_x^2 + w_yy - m_y^2 + C2,

where w_ab is the window's mean of a b. By m_x, w_xx and w_xy it has the derivatives

    A = 2 c (m_y - l m_x) / p + 2 l (c m_x - m_y) / q,    B = -l c / q,    C = 2 l / q,

and since the window is symmetric, the sum over the image has by x the derivative
blur(A) + 2 x blur(B) + y blur(C).

A row of an image with its channels is one axis: its taps are three floats apart. Rows have zeros
before and behind them, so that no tap asks where the image ends.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels import constants
from r3jax.kernels.native.compiled import claim, flush_denormals, inlined, kernel, parallel_kernel
from r3jax.kernels.splatting.lanes import (
    fma,
    keep_gt,
    larger,
    load,
    quotient,
    smaller,
    splat,
    store,
)

BORDER = 16
"""Zeros before and behind a row of floats: a vector, of which the window needs 15."""

BAND = 32
"""Rows that one thread takes at a time; sums are per band, so that they do not depend on the
number of threads."""

_RADIUS, _WIDTH = constants.WINDOW_RADIUS, 2 * constants.WINDOW_RADIUS + 1
_TAPS = np.array(constants.TAPS, np.float32)
_C1, _C2 = np.float32(constants.SSIM_C1), np.float32(constants.SSIM_C2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


@inlined
def _padded(length):
    """Computes the floats of a row with its borders, in whole vectors."""
    return BORDER + -(-length // 16) * 16 + BORDER


@inlined
def _read_row(image, y, row):
    """Copies a row of an image between the borders; zeros above and below the image."""
    inside = 0 <= y < image.shape[0]
    for k in range(image.shape[1]):
        row[BORDER + k] = image[y, k] if inside else _ZERO


@kernel
def _blur_products(x, y, means):
    """Filters a row of x, y, x x, y y and x y with the window [5, padded]."""
    for k in range(BORDER, x.shape[0] - BORDER, 16):
        mx, my, xx, yy, xy = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
        for tap in range(_WIDTH):
            a, b = load(x, k + 3 * (tap - _RADIUS)), load(y, k + 3 * (tap - _RADIUS))
            wa, wb = a * _TAPS[tap], b * _TAPS[tap]
            mx, my = mx + wa, my + wb
            xx, yy, xy = fma(wa, a, xx), fma(wb, b, yy), fma(wa, b, xy)
        store(means[0], k, mx)
        store(means[1], k, my)
        store(means[2], k, xx)
        store(means[3], k, yy)
        store(means[4], k, xy)


@kernel
def _blur_slopes(slopes, y, blurred):
    """Filters row y of three maps [3, H, padded] with the window, to [3, padded]."""
    for k in range(BORDER, slopes.shape[2] - BORDER, 16):
        for which in range(3):
            row, total = slopes[which, y], splat(_ZERO)
            for tap in range(_WIDTH):
                total = fma(load(row, k + 3 * (tap - _RADIUS)), _TAPS[tap], total)
            store(blurred[which], k, total)


@inlined
def _down(ring, order, which, k):
    """Applies the window down a ring of rows, whose places from top to bottom are given."""
    total = splat(_ZERO)
    for tap in range(_WIDTH):
        total = fma(load(ring[order[tap], which], k), _TAPS[tap], total)
    return total


@inlined
def _set_order(y, order):
    """Writes the places in a ring of the rows round the y-th."""
    for tap in range(_WIDTH):
        order[tap] = (y - _RADIUS + tap) % _WIDTH


@inlined
def _sum_of(vector, room):
    """Sums the lanes, first to last."""
    store(room, 0, vector)
    total = 0.0
    for lane in range(16):
        total += room[lane]
    return total


@kernel
def _slopes_of_row(y, ring, order, inside, slopes, room):
    """Writes A, B and C of a row; returns the row's sum of SSIM."""
    total = splat(_ZERO)
    for k in range(BORDER, inside.shape[0] - BORDER, 16):
        mx, my = _down(ring, order, 0, k), _down(ring, order, 1, k)
        square_x, square_y, product = mx * mx, my * my, mx * my
        xx, yy = _down(ring, order, 2, k) - square_x, _down(ring, order, 3, k) - square_y
        by_p = quotient(splat(_ONE), square_x + square_y + _C1)
        by_q = quotient(splat(_ONE), xx + yy + _C2)
        light = (product * _TWO + _C1) * by_p
        structure = ((_down(ring, order, 4, k) - product) * _TWO + _C2) * by_q
        # Nothing behind the end of the row counts.
        light = light * load(inside, k)
        twice = light * by_q * _TWO
        total = fma(light, structure, total)
        a = structure * by_p * _TWO * (my * load(inside, k) - light * mx)
        store(slopes[0, y], k, fma(twice, structure * mx - my, a))
        store(slopes[1, y], k, light * structure * by_q * -_ONE)
        store(slopes[2, y], k, twice)
    return _sum_of(total, room)


@kernel
def _ssim_of_band(first, last, rgb, target, inside, slopes):
    """Writes A, B and C of a band of rows; returns its sum of SSIM."""
    padded = inside.shape[0]
    x, y = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    ring, room = np.zeros((_WIDTH, 5, padded), np.float32), np.empty(16, np.float32)
    order = np.empty(_WIDTH, np.int64)
    total = 0.0
    for row in range(first - _RADIUS, last + _RADIUS):
        _read_row(rgb, row, x)
        _read_row(target, row, y)
        _blur_products(x, y, ring[row % _WIDTH])
        here = row - _RADIUS
        if here >= first:
            _set_order(here, order)
            total += _slopes_of_row(here, ring, order, inside, slopes, room)
    return total


@kernel
def _gradient_of_row(ring, order, x, y, weights, row, room):
    """Writes the gradient of a row; returns its sums of |x - y| and of (clipped x - y)^2."""
    by_l1, by_ssim = weights
    l1, squares = splat(_ZERO), splat(_ZERO)
    for k in range(BORDER, x.shape[0] - BORDER, 16):
        a, b = load(x, k), load(y, k)
        difference = a - b
        sign = keep_gt(splat(_ONE), difference, _ZERO) - keep_gt(splat(_ONE), _ZERO, difference)
        l1 = fma(sign, difference, l1)
        clipped = smaller(larger(a, splat(_ZERO)), splat(_ONE)) - b
        squares = fma(clipped, clipped, squares)
        slope = fma(a * _TWO, _down(ring, order, 1, k), _down(ring, order, 0, k))
        slope = fma(b, _down(ring, order, 2, k), slope)
        store(row, k, fma(slope, by_ssim, sign * by_l1))
    return _sum_of(l1, room), _sum_of(squares, room)


@kernel
def _gradient_of_band(first, last, rgb, target, weights, slopes, gradient):
    """Writes the gradient of a band of rows; returns its sums."""
    height, padded = slopes.shape[1], slopes.shape[2]
    x, y = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    row, room = np.empty(padded, np.float32), np.empty(16, np.float32)
    ring, order = np.zeros((_WIDTH, 3, padded), np.float32), np.empty(_WIDTH, np.int64)
    l1, squares = 0.0, 0.0
    for ahead in range(first - _RADIUS, last + _RADIUS):
        latest = ring[ahead % _WIDTH]
        if 0 <= ahead < height:
            _blur_slopes(slopes, ahead, latest)
        else:
            latest[:] = _ZERO
        here = ahead - _RADIUS
        if here >= first:
            _read_row(rgb, here, x)
            _read_row(target, here, y)
            _set_order(here, order)
            sums = _gradient_of_row(ring, order, x, y, weights, row, room)
            l1, squares = l1 + sums[0], squares + sums[1]
            for k in range(gradient.shape[1]):
                gradient[here, k] = row[BORDER + k]
    return l1, squares


@parallel_kernel
def loss_pass(rgb, target, weight, workers, results, gradient):
    """Computes the loss, the mean squared error of the clipped image, and the gradient.

    Args:
        rgb: [H, W * 3].
        target: [H, W * 3].
        weight: of 1 - SSIM.
        workers: threads to share the work.
        results: written; loss and error.
        gradient: written; by `rgb`.
    """
    height, length = rgb.shape
    bands, padded, count = -(-height // BAND), _padded(length), np.float32(height * length)
    inside = np.zeros(padded, np.float32)
    inside[BORDER : BORDER + length] = _ONE
    slopes, shares = np.zeros((3, height, padded), np.float32), np.zeros((bands, 3))
    weights = (_ONE - weight) / count, -weight / count
    next_band = np.zeros(2, np.int64)
    for _ in prange(workers):
        flush_denormals()
        band = claim(next_band[:1])
        while band < bands:
            first, last = band * BAND, min((band + 1) * BAND, height)
            shares[band, 0] = _ssim_of_band(first, last, rgb, target, inside, slopes)
            band = claim(next_band[:1])
    for _ in prange(workers):
        band = claim(next_band[1:])
        while band < bands:
            first, last = band * BAND, min((band + 1) * BAND, height)
            sums = _gradient_of_band(first, last, rgb, target, weights, slopes, gradient)
            shares[band, 1], shares[band, 2] = sums
            band = claim(next_band[1:])
    ssim, l1, squares = 0.0, 0.0, 0.0
    for band in range(bands):
        ssim, l1, squares = ssim + shares[band, 0], l1 + shares[band, 1], squares + shares[band, 2]
    results[0] = (_ONE - weight) * (l1 / count) + weight * (_ONE - ssim / count)
    results[1] = squares / count
