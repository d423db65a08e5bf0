"""Plane sweep: the depth of an image's pixels by comparing it with others, in machine code.

The formulas: `plane_scores` and `smooth_scores` of `captures.sweep`. An image is cut into bands of
rows; a thread sweeps one band at a time through all planes, so that its scratch memory stays in the
cache.

Shape symbols: s sources; h, w size of the reference; p planes; b rows of a band with its margin.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false
# pyright: reportUnknownVariableType=false, reportUnknownMemberType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels.constants import LEAST_DEVIATION, NO_SCORE
from r3jax.kernels.native.compiled import called_from_python, inlined_fast

_BAND = 16
"""Rows of a band."""


@inlined_fast
def _warp(source, size, A, b, inverse, first, value, squared, product, reference, is_in):
    """Samples a source at the pixels of a band, as if all lay in one plane.

    Args:
        source: [H, W] float32; its upper left part of `size` counts.
        size: rows and columns of the source, [2].
        A: projects a pixel of the reference at depth 1 into the source, [3, 3].
        b: what an inverse depth adds to it, [3].
        inverse: one over the plane's depth.
        first: row of the reference that the band begins with; may be negative.
        value: takes the samples, [b, w].
        squared: takes their squares, [b, w].
        product: takes their products with the reference, [b, w].
        reference: [h, w].
        is_in: takes whether a pixel lies in the source, [b, w].
    """
    height, width = reference.shape
    rows, columns = size[0], size[1]
    half = np.float32(0.5)
    for i in range(value.shape[0]):
        row = min(max(first + i, 0), height - 1)
        v = np.float32(row) + half
        x0 = A[0, 1] * v + A[0, 2] + inverse * b[0]
        y0 = A[1, 1] * v + A[1, 2] + inverse * b[1]
        z0 = A[2, 1] * v + A[2, 2] + inverse * b[2]
        for j in range(width):
            u = np.float32(j) + half
            z = A[2, 0] * u + z0
            inside = z > np.float32(1e-6)
            per_z = np.float32(1.0) / z if inside else np.float32(0.0)
            x = (A[0, 0] * u + x0) * per_z - half
            y = (A[1, 0] * u + y0) * per_z - half
            inside &= (x >= -half) & (x <= np.float32(columns) - half)
            inside &= (y >= -half) & (y <= np.float32(rows) - half)
            x = min(max(x, np.float32(0.0)), np.float32(columns - 1))
            y = min(max(y, np.float32(0.0)), np.float32(rows - 1))
            left, top = int(x), int(y)
            right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
            fx, fy = x - np.float32(left), y - np.float32(top)
            upper = source[top, left] + fx * (source[top, right] - source[top, left])
            lower = source[bottom, left] + fx * (source[bottom, right] - source[bottom, left])
            sample = upper + fy * (lower - upper)
            value[i, j] = sample
            squared[i, j] = sample * sample
            product[i, j] = sample * reference[row, j]
            is_in[i, j] = inside


@inlined_fast
def _box(values, radius, line, out):
    """Sums over windows of 2 radius + 1: rows shrink by the margin, columns repeat at the rim.

    Args:
        values: [b, w].
        radius: of the window.
        line: scratch, [w + 2 radius].
        out: takes the sums, [b - 2 radius, w].
    """
    width = values.shape[1]
    # Columns in the inner loops: these are vectorized.
    for i in range(out.shape[0]):
        for j in range(width):
            line[radius + j] = values[i, j]
        for k in range(1, 2 * radius + 1):
            for j in range(width):
                line[radius + j] += values[i + k, j]
        for k in range(radius):
            line[k] = line[radius]
            line[radius + width + k] = line[radius + width - 1]
        for j in range(width):
            out[i, j] = line[j]
        for k in range(1, 2 * radius + 1):
            for j in range(width):
                out[i, j] += line[j + k]


@inlined_fast
def _join(sums, of_reference, is_in, radius, best, second, third, count):
    """Turns sums over windows into correlations, and keeps the three best of each pixel.

    Args:
        sums: of the samples, their squares, their products with the reference, [3, n, w].
        of_reference: sum and inverse root of the variance of the reference, [2, n, w]; the latter
            is 0 where the window has no texture.
        is_in: whether a pixel lies in the source, [b, w].
        radius: of the window.
        best: [n, w].
        second: [n, w].
        third: [n, w].
        count: number of sources that show a pixel, [n, w].
    """
    side = np.float32(2 * radius + 1)
    per = np.float32(1.0) / (side * side)
    least = np.float32(LEAST_DEVIATION * LEAST_DEVIATION)
    none = np.float32(NO_SCORE)
    for i in range(best.shape[0]):
        for j in range(best.shape[1]):
            mean = sums[0, i, j] * per
            variance = sums[1, i, j] * per - mean * mean
            covariance = sums[2, i, j] * per - mean * (of_reference[0, i, j] * per)
            is_valid = is_in[i + radius, j] & (variance > least)
            safe = variance if is_valid else np.float32(1.0)
            score = covariance * of_reference[1, i, j] / np.float32(math.sqrt(safe))
            score = score if is_valid else none
            a, b, c = best[i, j], second[i, j], third[i, j]
            low = min(a, score)
            best[i, j] = max(a, score)
            low, second[i, j] = min(b, low), max(b, low)
            third[i, j] = max(c, low)
            count[i, j] += np.float32(1.0) if is_valid else np.float32(0.0)


@called_from_python(parallel=True)
def plane_scores(reference, sources, sizes, A, b, inverses, radius):
    """Compares each pixel with the sources on each plane.

    Args:
        reference: brightness of the image, [h, w] float32.
        sources: of the others, [s, H, W] float32.
        sizes: rows and columns of each, [s, 2] int64; they may be smaller than [H, W].
        A: [s, 3, 3] float32, as in `_warp`.
        b: [s, 3] float32.
        inverses: one over the planes' depths, [p] float32.
        radius: of the window [px].

    Returns:
        Mean correlation with the best three sources, [h, w, p] float32; `NO_SCORE` where fewer than
        two of them show the pixel or its window has no texture.
    """
    height, width = reference.shape
    planes, num = inverses.shape[0], sources.shape[0]
    scores = np.empty((height, width, planes), np.float32)
    bands = -(-height // _BAND)
    none = np.float32(NO_SCORE)
    side = np.float32(2 * radius + 1)
    per = np.float32(1.0) / (side * side)
    for band in prange(bands):
        top = band * _BAND
        n = min(_BAND, height - top)
        m = n + 2 * radius
        warped = np.empty((3, m, width), np.float32)
        is_in = np.empty((m, width), np.bool_)
        line = np.empty(width + 2 * radius, np.float32)
        sums = np.empty((3, n, width), np.float32)
        of_reference = np.empty((2, n, width), np.float32)
        for i in range(m):
            row = min(max(top - radius + i, 0), height - 1)
            for j in range(width):
                warped[0, i, j] = reference[row, j]
                warped[1, i, j] = reference[row, j] * reference[row, j]
        _box(warped[0], radius, line, of_reference[0])
        _box(warped[1], radius, line, of_reference[1])
        for i in range(n):
            for j in range(width):
                mean = of_reference[0, i, j] * per
                variance = of_reference[1, i, j] * per - mean * mean
                textured = variance > np.float32(LEAST_DEVIATION * LEAST_DEVIATION)
                safe = variance if textured else np.float32(1.0)
                root = np.float32(1.0) / np.float32(math.sqrt(safe))
                of_reference[1, i, j] = root if textured else np.float32(0.0)
        best = np.empty((n, width), np.float32)
        second = np.empty((n, width), np.float32)
        third = np.empty((n, width), np.float32)
        count = np.empty((n, width), np.float32)
        for plane in range(planes):
            best[:], second[:], third[:], count[:] = none, none, none, np.float32(0.0)
            for s in range(num):
                _warp(
                    sources[s], sizes[s], A[s], b[s], inverses[plane], top - radius,
                    warped[0], warped[1], warped[2], reference, is_in,
                )  # fmt: skip
                _box(warped[0], radius, line, sums[0])
                _box(warped[1], radius, line, sums[1])
                _box(warped[2], radius, line, sums[2])
                _join(sums, of_reference, is_in, radius, best, second, third, count)
            for i in range(n):
                for j in range(width):
                    score = none
                    if of_reference[1, i, j] > 0.0 and count[i, j] >= 2:
                        score = best[i, j] + second[i, j]
                        if count[i, j] >= 3:
                            score = (score + third[i, j]) / np.float32(3.0)
                        else:
                            score = score / np.float32(2.0)
                    scores[top + i, j, plane] = score
    return scores


@inlined_fast
def _step(scores, before, after, total, small, large):
    """Takes one pixel's step of the recursion of `smooth_scores`.

    Args:
        scores: of the pixel, [p].
        before: the recursion's values at the pixel before, [p].
        after: takes them at this one, [p].
        total: they are added to these, [p].
        small: what a step to the next plane costs.
        large: what any step costs.
    """
    planes = scores.shape[0]
    top = before[0]
    for k in range(1, planes):
        top = max(top, before[k])
    for k in range(planes):
        stay = max(before[k], top - large)
        if k > 0:
            stay = max(stay, before[k - 1] - small)
        if k + 1 < planes:
            stay = max(stay, before[k + 1] - small)
        after[k] = max(scores[k], np.float32(0.0)) + stay - top
        total[k] += after[k]


@called_from_python(parallel=True)
def smooth_scores(scores, small, large):
    """Adds up along rows and columns what neighbors say of a pixel's plane (semi-global matching).

    Args:
        scores: [h, w, p] float32; below 0 counts as 0: nothing is known.
        small: what a step to the next plane costs, float32.
        large: what any step costs, float32.

    Returns:
        [h, w, p] float32: sums over four directions.
    """
    height, width, planes = scores.shape
    total = np.zeros((height, width, planes), np.float32)
    for i in prange(height):
        before, after = np.zeros(planes, np.float32), np.zeros(planes, np.float32)
        for j in range(width):
            _step(scores[i, j], before, after, total[i, j], small, large)
            before, after = after, before
        before[:] = np.float32(0.0)
        for j in range(width - 1, -1, -1):
            _step(scores[i, j], before, after, total[i, j], small, large)
            before, after = after, before
    for j in prange(width):
        before, after = np.zeros(planes, np.float32), np.zeros(planes, np.float32)
        for i in range(height):
            _step(scores[i, j], before, after, total[i, j], small, large)
            before, after = after, before
        before[:] = np.float32(0.0)
        for i in range(height - 1, -1, -1):
            _step(scores[i, j], before, after, total[i, j], small, large)
            before, after = after, before
    return total
