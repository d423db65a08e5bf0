"""The terms of R of every row of a map as points see them, hidden or not: `terms.score_voxels`."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.mapping.backends.numba.bins import center_of
from r3jax.native.arithmetic import exp2
from r3jax.native.compiled import claim, in_wide_vectors, inlined_fused, kernel, parallel_kernel
from r3jax.scoring.backends.numba.near import choose_marked
from r3jax.scoring.backends.numba.terms import (
    ANGLES,
    DELTAS,
    INSIDE,
    LOG_DELTAS,
    RANGE,
    SHARPNESS,
    TO_X,
    TO_Y,
    TO_Z,
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
def _write_unknown(first, number, forms, terms):
    """Writes the terms of rows that hold nothing: never seen from anywhere."""
    last = first + number
    terms[KAPPA][first:last], terms[DELTA][first:last] = _ONE if forms[0] else _TWO, _ONE
    terms[BIAS][first:last], terms[NOISE][first:last] = _ZERO, _ZERO
    terms[RESOLUTION][first:last], terms[VALUE][first:last] = _ZERO, _ZERO


@inlined_fused
def _mark_known(first, number, state, is_known):
    """Marks the rows that hold something, or what is left of it."""
    in_wide_vectors()
    words, count, m2 = state[1], state[2], state[3]
    for j in range(number):
        is_known[j] = _ONE if (count[first + j] > _ZERO) | (m2[first + j] > _ZERO) else _ZERO
    for word in range(words.shape[0]):
        for j in range(number):
            is_known[j] = _ONE if words[word, first + j] > 0 else is_known[j]


@inlined_fused
def _gather(point, chosen, number, state, angles):
    """Gathers what is known of some rows, and how a point lies to each."""
    key, _, count, m2, resolution, voxel_size = state
    for j in range(number):
        row = np.int64(chosen[j])
        x, y, z = center_of(key, row, voxel_size)
        angles[TO_X + j], angles[TO_Y + j] = point[0] - x, point[1] - y
        angles[TO_Z + j], angles[SHARPNESS + j] = point[2] - z, resolution[row]
        angles[DELTAS + j], angles[LOG_DELTAS + j] = count[row], m2[row]


@inlined_fused
def _find_angles(number, is_pairwise, angles, present):
    """Finds unit vectors to the point, distances and consistencies, in place."""
    in_wide_vectors()
    for j in range(number):
        dx, dy, dz = angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
        inverse = _ONE / distance
        angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j] = (
            dx * inverse, dy * inverse, dz * inverse,
        )  # fmt: skip
        count = angles[DELTAS + j]
        delta = consistency(count, angles[LOG_DELTAS + j], is_pairwise)
        present[j] = _ONE if count > _ZERO else _ZERO
        angles[RANGE + j] = distance
        angles[DELTAS + j], angles[LOG_DELTAS + j] = delta, log2_or_never(delta)


@inlined_fused
def _compare_directions(chosen, number, words, is_always_one, directions, bits, angles, cosines):
    """Compares the direction to the point with those from which each row was seen."""
    for j in range(number):
        for word in range(0, words.shape[0], 2):
            bits[word >> 1, 0] = bins_of(words, word, np.int64(chosen[j]))
        to = angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
        cosines[j], is_inside = look_from(bits, 0, directions, to)
        angles[INSIDE + j] = np.float32(is_inside | is_always_one)


@inlined_fused
def _find_terms(focal, number, angles, cosines, present, found):
    """Works the terms of some rows out; bias, noise, resolution and R are 0 where none is."""
    in_wide_vectors()
    for j in range(number):
        is_one, delta = angles[INSIDE + j] > _ZERO, angles[DELTAS + j]
        bias = bias_of(cosines[j], is_one)
        noise = exp2(log_noise(bias, is_one, angles[LOG_DELTAS + j]))
        resolution = exp2(
            log_resolution(bias, delta, angles[SHARPNESS + j], angles[RANGE + j], focal)
        )
        is_there = present[j]
        found[KAPPA * CHUNK + j], found[DELTA * CHUNK + j] = _ONE if is_one else _TWO, delta
        found[BIAS * CHUNK + j], found[NOISE * CHUNK + j] = is_there * bias, is_there * noise
        found[RESOLUTION * CHUNK + j] = is_there * resolution
        found[VALUE * CHUNK + j] = is_there * bias * noise * resolution


@inlined_fused
def _write_terms(chosen, number, found, terms):
    for term in range(NUM_TERMS):
        own = terms[term]
        for j in range(number):
            own[np.int64(chosen[j])] = found[term * CHUNK + j]


@kernel
def _score_blocks(next_block, points, state, forms, directions, results):
    """Scores one block of rows after the other until none is left."""
    num = state[2].shape[0]
    per_point = (num + _BLOCK - 1) // _BLOCK
    bits = np.empty(((state[1].shape[0] + 1) // 2, 1), np.uint64)
    angles, cosines = np.empty(ANGLES, np.float32), np.empty(CHUNK, np.float32)
    chosen, present = np.empty(CHUNK + 1, np.int32), np.empty(CHUNK, np.float32)
    found = np.empty(NUM_TERMS * CHUNK, np.float32)
    i = claim(next_block)
    while i < points.shape[0] * per_point:
        at = i // per_point
        point = points[at]
        terms = (
            results[0][at], results[1][at], results[2][at], results[3][at], results[4][at],
            results[5][at],
        )  # fmt: skip
        begin = i % per_point * _BLOCK
        for first in range(begin, min(begin + _BLOCK, num), CHUNK):
            number = min(CHUNK, num - first)
            _write_unknown(first, number, forms, terms)
            _mark_known(first, number, state, present)
            number = choose_marked(present, first, number, chosen)
            _gather(point, chosen, number, state, angles)
            _find_angles(number, forms[1], angles, present)
            _compare_directions(
                chosen, number, state[1], forms[0], directions, bits, angles, cosines
            )
            _find_terms(point[3], number, angles, cosines, present, found)
            _write_terms(chosen, number, found, terms)
        i = claim(next_block)


@parallel_kernel
def _score_all(
    points, key, words, count, m2, resolution, voxel_size, is_always_one, is_pairwise, directions,
    workers, kappa, bias, delta, noise, best, value,
):  # fmt: skip
    """Scores all rows for all points. Numba's threads take no nested arguments."""
    next_block = np.zeros(1, np.int64)
    for _ in prange(workers):
        _score_blocks(
            next_block, points, (key, words, count, m2, resolution, voxel_size),
            (is_always_one, is_pairwise), directions, (kappa, bias, delta, noise, best, value),
        )  # fmt: skip


@kernel
def rows_pass(state, points, forms, directions, workers, results):
    """Works out the terms of all rows of a map.

    Args:
        state: as in `sums_of_many`.
        points: positions [m] and focal lengths [px], [P, 4].
        forms: whether kappa is always 1, whether delta is that of pairs.
        directions: of the voxels' bins [b, 3].
        workers: threads.
        results: written, one array for each term [P, N].
    """
    _score_all(
        points, state[0], state[1], state[2], state[3], state[4], state[5], forms[0], forms[1],
        directions, workers, results[0], results[1], results[2], results[3], results[4], results[5],
    )  # fmt: skip
