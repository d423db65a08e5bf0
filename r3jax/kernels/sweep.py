"""Plane sweep: the depth of an image's pixels by comparing it with others, in machine code.

The formulas: `plane_scores` and `smooth_scores` of `captures.sweep`. A thread takes a band of rows
at a time through all planes. Of a source it samples one row after another; sums over the columns
of a window slide down with it, in memory that stays in the cache.

Shape symbols: s sources; h, w size of the reference; p planes; n rows of a band.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false
# pyright: reportUnknownVariableType=false, reportUnknownMemberType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels.constants import LEAST_DEVIATION, NO_SCORE, SWEEP_RADIUS
from r3jax.kernels.native.compiled import called_from_python, inlined_fast

_BAND = 32
"""Rows of a band."""

_SIDE = 2 * SWEEP_RADIUS + 1
"""Of a window [px]. A constant: the loops over it are unrolled."""


@inlined_fast
def _project(size, A, b, inverse, row, stride, at, part_x, part_y, is_in):
    """Projects a row of the reference into a source, as if all of it lay in one plane.

    Args:
        size: rows and columns of the source, [2], two each or more.
        A: projects a pixel of the reference at depth 1 into the source, [3, 3].
        b: what an inverse depth adds to it, [3].
        inverse: one over the plane's depth.
        row: of the reference.
        stride: from one row of the source to the next, in memory.
        at: takes the index of the source's pixel to the upper left, [w] uint32: an index without
            a sign need not be checked for counting from the end.
        part_x: takes the way from it to the next column, [w].
        part_y: takes the way from it to the next row, [w].
        is_in: takes 1 where a pixel lies in the source, else 0, [w].
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    least = np.float32(1e-6)
    bottom, right = np.float32(size[0]), np.float32(size[1])
    last_row, last_column = np.int32(size[0] - 2), np.int32(size[1] - 2)
    v = np.float32(row) + half
    x0 = A[0, 1] * v + A[0, 2] + inverse * b[0]
    y0 = A[1, 1] * v + A[1, 2] + inverse * b[1]
    z0 = A[2, 1] * v + A[2, 2] + inverse * b[2]
    per_x, per_y, per_z = A[0, 0], A[1, 0], A[2, 0]
    for j in range(at.shape[0]):
        u = np.float32(np.int32(j)) + half
        z = per_z * u + z0
        scale = one / max(z, least)
        x, y = (per_x * u + x0) * scale, (per_y * u + y0) * scale
        inside = (z > least) & (x >= zero) & (x <= right) & (y >= zero) & (y <= bottom)
        is_in[j] = one if inside else zero
        x = min(max(x - half, zero), right - one)
        y = min(max(y - half, zero), bottom - one)
        left, top = min(np.int32(x), last_column), min(np.int32(y), last_row)
        part_x[j], part_y[j] = x - np.float32(left), y - np.float32(top)
        at[j] = np.uint32(top * np.int32(stride) + left)


@inlined_fast
def _sample(source, stride, at, part_x, part_y, values):
    """Interpolates a source, flat in memory, at the places of `_project`."""
    beside, below = np.uint32(1), np.uint32(stride)
    for j in range(at.shape[0]):
        k = at[j]
        upper = source[k] + part_x[j] * (source[k + beside] - source[k])
        k += below
        lower = source[k] + part_x[j] * (source[k + beside] - source[k])
        values[j] = upper + part_y[j] * (lower - upper)


@inlined_fast
def _slide(values, reference, ring, columns):
    """Moves the windows down by a row.

    Args:
        values: the row that comes in, [w].
        reference: the same row of the reference, [w].
        ring: the row that goes out: values, their squares, their products with the reference,
            [3, w]; takes those of the row that comes in.
        columns: sums of each over the rows of a window, [3, w + 2 radius].
    """
    for j in range(values.shape[0]):
        value = values[j]
        squared, product = value * value, value * reference[j]
        columns[0, SWEEP_RADIUS + j] += value - ring[0, j]
        columns[1, SWEEP_RADIUS + j] += squared - ring[1, j]
        columns[2, SWEEP_RADIUS + j] += product - ring[2, j]
        ring[0, j], ring[1, j], ring[2, j] = value, squared, product


@inlined_fast
def _repeat_rim(columns, width):
    """Repeats the first and the last column where windows reach beyond the image."""
    for q in range(columns.shape[0]):
        for k in range(SWEEP_RADIUS):
            columns[q, k] = columns[q, SWEEP_RADIUS]
            columns[q, SWEEP_RADIUS + width + k] = columns[q, SWEEP_RADIUS + width - 1]


@inlined_fast
def _describe(columns, means, roots):
    """Computes means and inverse deviations of windows; the latter are 0 without texture, [w]."""
    zero, one = np.float32(0.0), np.float32(1.0)
    per = np.float32(1.0 / (_SIDE * _SIDE))
    for j in range(means.shape[0]):
        total, squares = zero, zero
        for k in range(_SIDE):
            total += columns[0, j + k]
            squares += columns[1, j + k]
        means[j] = total * per
        variance = squares * per - means[j] * means[j]
        textured = variance > np.float32(LEAST_DEVIATION * LEAST_DEVIATION)
        safe = variance if textured else one
        roots[j] = one / np.float32(math.sqrt(safe)) if textured else zero


@inlined_fast
def _join(columns, means, roots, is_in, best):
    """Turns sums over windows into correlations, and keeps the three best of each pixel.

    Args:
        columns: as in `_slide`.
        means: of the reference's windows, [w].
        roots: their inverse deviations, [w].
        is_in: 1 where a pixel lies in the source, else 0, [w].
        best: the three best correlations and the number of sources that show a pixel, [4, w].
    """
    zero, one, none = np.float32(0.0), np.float32(1.0), np.float32(NO_SCORE)
    per = np.float32(1.0 / (_SIDE * _SIDE))
    least = np.float32(LEAST_DEVIATION * LEAST_DEVIATION)
    for j in range(means.shape[0]):
        total, squares, products = zero, zero, zero
        for k in range(_SIDE):
            total += columns[0, j + k]
            squares += columns[1, j + k]
            products += columns[2, j + k]
        mean = total * per
        variance = squares * per - mean * mean
        covariance = products * per - mean * means[j]
        is_valid = (is_in[j] > zero) & (variance > least)
        safe = variance if is_valid else one
        score = covariance * roots[j] / np.float32(math.sqrt(safe))
        score = score if is_valid else none
        first, second, third = best[0, j], best[1, j], best[2, j]
        low = min(first, score)
        best[0, j] = max(first, score)
        best[1, j] = max(second, low)
        best[2, j] = max(third, min(second, low))
        best[3, j] += one if is_valid else zero


@inlined_fast
def _mean(best, roots, scores, plane):
    """Writes the mean of the three best correlations, or of two, [w, p]."""
    for j in range(roots.shape[0]):
        two = best[0, j] + best[1, j]
        three = (two + best[2, j]) / np.float32(3.0)
        score = three if best[3, j] >= np.float32(3.0) else np.float32(0.5) * two
        is_known = (roots[j] > np.float32(0.0)) & (best[3, j] >= np.float32(2.0))
        scores[j, plane] = score if is_known else np.float32(NO_SCORE)


@called_from_python(parallel=True)
def plane_scores(reference, sources, sizes, A, b, inverses):
    """Compares each pixel with the sources on each plane, by windows of `SWEEP_RADIUS`.

    Args:
        reference: brightness of the image, [h, w] float32.
        sources: of the others, [s, H, W] float32.
        sizes: rows and columns of each, [s, 2] int64; they may be smaller than [H, W]. Sources of
            one row or column do not count.
        A: [s, 3, 3] float32, as in `_project`.
        b: [s, 3] float32.
        inverses: one over the planes' depths, [p] float32.

    Returns:
        Mean correlation with the best three sources, [h, w, p] float32; `NO_SCORE` where fewer than
        two of them show the pixel or its window has no texture.
    """
    height, width = reference.shape
    stride = sources.shape[2]
    scores = np.empty((height, width, inverses.shape[0]), np.float32)
    zero, none = np.float32(0.0), np.float32(NO_SCORE)
    for band in prange(-(-height // _BAND)):
        first = band * _BAND
        n = min(_BAND, height - first)
        at = np.empty(width, np.uint32)
        part_x, part_y = np.empty(width, np.float32), np.empty(width, np.float32)
        values = np.empty(width, np.float32)
        ring = np.zeros((_SIDE, 3, width), np.float32)
        is_in = np.empty((_SIDE, width), np.float32)
        columns = np.zeros((3, width + 2 * SWEEP_RADIUS), np.float32)
        means, roots = np.empty((n, width), np.float32), np.empty((n, width), np.float32)
        best = np.empty((n, 4, width), np.float32)
        for i in range(n + 2 * SWEEP_RADIUS):
            row = min(max(first - SWEEP_RADIUS + i, 0), height - 1)
            _slide(reference[row], reference[row], ring[i % _SIDE], columns)
            if i >= 2 * SWEEP_RADIUS:
                _repeat_rim(columns, width)
                _describe(columns, means[i - 2 * SWEEP_RADIUS], roots[i - 2 * SWEEP_RADIUS])
        for plane in range(inverses.shape[0]):
            best[:, :3] = none
            best[:, 3] = zero
            for s in range(sources.shape[0]):
                if sizes[s, 0] < 2 or sizes[s, 1] < 2:
                    continue
                ring[:] = zero
                columns[:] = zero
                for i in range(n + 2 * SWEEP_RADIUS):
                    row = min(max(first - SWEEP_RADIUS + i, 0), height - 1)
                    _project(
                        sizes[s], A[s], b[s], inverses[plane], row, stride,
                        at, part_x, part_y, is_in[i % _SIDE],
                    )  # fmt: skip
                    _sample(sources[s].reshape(-1), stride, at, part_x, part_y, values)
                    _slide(values, reference[row], ring[i % _SIDE], columns)
                    if i >= 2 * SWEEP_RADIUS:
                        _repeat_rim(columns, width)
                        out, middle = i - 2 * SWEEP_RADIUS, (i - SWEEP_RADIUS) % _SIDE
                        _join(columns, means[out], roots[out], is_in[middle], best[out])
            for i in range(n):
                _mean(best[i], roots[i], scores[first + i], plane)
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
