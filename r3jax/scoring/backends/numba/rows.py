"""The terms of R of every row of a map as points see them, hidden or not: `terms.score_voxels`."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.mapping.backends.numba.bins import center_of
from r3jax.native.arithmetic import exp2
from r3jax.native.compiled import claim, inlined_fused, kernel, parallel_kernel
from r3jax.scoring.backends.numba.terms import (
    ANGLES,
    DELTAS,
    INSIDE,
    LOG_DELTAS,
    RANGE,
    bias_of,
    log_noise,
    log_resolution,
    look_from,
)
from r3jax.scoring.backends.numba.voxels import bins_of, consistency, log2_or_never
from r3jax.visibility.backends.numba.views import CHUNK

KAPPA, BIAS, DELTA, NOISE, RESOLUTION, VALUE = 0, 1, 2, 3, 4, 5
"""Rows of what is written, in the order of the fields of `Renderability`."""

NUM_TERMS = 6

_BLOCK = 8 * CHUNK
"""Rows that a thread takes at a time."""

_ZERO, _ONE, _TWO, _LEAST = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(1e-6)


@inlined_fused
def _compare_directions(point, first, number, state, forms, directions, bits, angles, cosines):
    """Compares the direction to a point with those from which each row was seen."""
    key, words, count, m2, _, voxel_size = state
    for j in range(number):
        row = first + j
        x, y, z = center_of(key, row, voxel_size)
        dx, dy, dz = point[0] - x, point[1] - y, point[2] - z
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
        inverse = _ONE / distance
        for word in range(0, words.shape[0], 2):
            bits[word >> 1, 0] = bins_of(words, word, row)
        to = dx * inverse, dy * inverse, dz * inverse
        cosines[j], is_inside = look_from(bits, 0, directions, to)
        delta = consistency(count[row], m2[row], forms[1])
        angles[INSIDE + j], angles[RANGE + j] = np.float32(is_inside | forms[0]), distance
        angles[DELTAS + j], angles[LOG_DELTAS + j] = delta, log2_or_never(delta)


@inlined_fused
def _write_terms(focal, first, number, state, angles, cosines, terms):
    """Works the terms of some rows out; bias, noise, resolution and R are 0 where none is."""
    count, best = state[2], state[4]
    for j in range(number):
        row = first + j
        is_one, delta = angles[INSIDE + j] > _ZERO, angles[DELTAS + j]
        bias = bias_of(cosines[j], is_one)
        noise = exp2(log_noise(bias, is_one, angles[LOG_DELTAS + j]))
        resolution = exp2(log_resolution(bias, delta, best[row], angles[RANGE + j], focal))
        is_there = _ONE if count[row] > _ZERO else _ZERO
        terms[KAPPA, row], terms[DELTA, row] = _ONE if is_one else _TWO, delta
        terms[BIAS, row], terms[NOISE, row] = is_there * bias, is_there * noise
        terms[RESOLUTION, row] = is_there * resolution
        terms[VALUE, row] = is_there * bias * noise * resolution


@kernel
def _score_blocks(next_block, points, state, forms, directions, results):
    """Scores one block of rows after the other until none is left."""
    num = state[2].shape[0]
    per_point = (num + _BLOCK - 1) // _BLOCK
    bits = np.empty(((state[1].shape[0] + 1) // 2, 1), np.uint64)
    angles, cosines = np.empty(ANGLES, np.float32), np.empty(CHUNK, np.float32)
    i = claim(next_block)
    while i < points.shape[0] * per_point:
        point, terms = points[i // per_point], results[i // per_point]
        begin = i % per_point * _BLOCK
        for first in range(begin, min(begin + _BLOCK, num), CHUNK):
            number = min(CHUNK, num - first)
            _compare_directions(
                point, first, number, state, forms, directions, bits, angles, cosines
            )
            _write_terms(point[3], first, number, state, angles, cosines, terms)
        i = claim(next_block)


@parallel_kernel
def _score_all(
    points, key, words, count, m2, resolution, voxel_size, is_always_one, is_pairwise, directions,
    workers, results,
):  # fmt: skip
    """Scores all rows for all points. Numba's threads take no nested arguments."""
    next_block = np.zeros(1, np.int64)
    for _ in prange(workers):
        _score_blocks(
            next_block, points, (key, words, count, m2, resolution, voxel_size),
            (is_always_one, is_pairwise), directions, results,
        )  # fmt: skip


@kernel
def rows_pass(state, points, forms, directions, workers, results):
    """Works out the terms of all rows of a map.

    Args:
        state: as in `sums_pass`.
        points: positions [m] and focal lengths [px], [P, 4].
        forms: whether kappa is always 1, whether delta is that of pairs.
        directions: of the voxels' bins [b, 3].
        workers: threads.
        results: written, [P, NUM_TERMS, N].
    """
    _score_all(
        points, state[0], state[1], state[2], state[3], state[4], state[5], forms[0], forms[1],
        directions, workers, results,
    )  # fmt: skip
