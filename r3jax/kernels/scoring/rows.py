"""The terms of R of every row of a map as points see them, hidden or not: `terms.score_voxels`."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import center_of_words
from r3jax.kernels.native.arithmetic import exp2
from r3jax.kernels.native.compiled import (
    claim,
    in_wide_vectors,
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
)
from r3jax.kernels.scoring.terms import (
    ANGLES,
    DELTAS,
    INSIDE,
    LOG_DELTAS,
    NEARLY_ONE,
    RANGE,
    SHARPNESS,
    TO_X,
    TO_Y,
    TO_Z,
    bias_of,
    log_noise,
    log_resolution,
    look_from,
    lowest_bit,
)
from r3jax.kernels.scoring.voxels import consistency, log2_or_never
from r3jax.kernels.visibility.views import CHUNK

KAPPA, BIAS, DELTA, NOISE, RESOLUTION, VALUE = 0, 1, 2, 3, 4, 5
"""Rows of what is written, in the order of the fields of `Renderability`."""

NUM_TERMS = 6

_BLOCK = 8 * CHUNK
"""Rows that a thread takes at a time."""

_ZERO, _ONE, _TWO, _LEAST = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(1e-6)
_NAN, _NO_BITS, _ONE_BIT = np.float32(np.nan), np.uint64(0), np.uint64(1)


@inlined
def _part(state, first, last):
    """Some rows of a map, but for their bins.

    Slices: LLVM does not know that `first + j` is no number from the end, and makes no vectors.
    """
    key, _, count, m2, resolution, voxel_size = state
    return (
        key[0][first:last], key[1][first:last], count[first:last], m2[first:last],
        resolution[first:last], voxel_size,
    )  # fmt: skip


@inlined_fused
def _gather_bins(words, first, last, bits):
    """Gathers the bins from which some rows were seen, 64 in a word."""
    in_wide_vectors()
    for word in range(words.shape[0]):
        own, to, shift = words[word][first:last], bits[word >> 1], np.uint64(32 * (word & 1))
        for j in range(last - first):
            lower = to[j] if word & 1 else _NO_BITS
            to[j] = lower | (np.uint64(own[j]) << shift)


@inlined_fused
def _is_any_known(part, bits):
    """Whether one of some rows holds something, or what is left of it."""
    in_wide_vectors()
    _, _, count, m2, _, _ = part
    is_any = False
    for j in range(count.shape[0]):
        is_any |= (count[j] > _ZERO) | (m2[j] > _ZERO)
    for word in range(bits.shape[0]):
        for j in range(count.shape[0]):
            is_any |= bits[word, j] != _NO_BITS
    return is_any


@inlined_fused
def _write_unknown(first, last, factor, is_always_one, terms):
    """Writes the terms of rows that hold nothing: never seen from anywhere."""
    for term in range(NUM_TERMS):
        value = factor * _ZERO
        if term == KAPPA:
            value = factor * (_ONE if is_always_one else _TWO)
        elif term == DELTA:
            value = factor
        own = terms[term][first:last]
        for j in range(last - first):
            own[j] = value


@inlined_fused
def _find_angles(point, part, is_pairwise, angles, present):
    """Finds unit vectors from rows to a point, distances and consistencies."""
    in_wide_vectors()
    low, high, counts, m2, resolution, voxel_size = part
    number = counts.shape[0]
    for j in range(number):
        x, y, z = center_of_words(low[j], high[j], voxel_size)
        dx, dy, dz = point[0] - x, point[1] - y, point[2] - z
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
        inverse = _ONE / distance
        angles[TO_X + j], angles[TO_Y + j] = dx * inverse, dy * inverse
        angles[TO_Z + j], angles[RANGE + j] = dz * inverse, distance
    for j in range(number):
        delta = consistency(counts[j], m2[j], is_pairwise)
        angles[DELTAS + j], angles[LOG_DELTAS + j] = delta, log2_or_never(delta)
        present[j] = _ONE if counts[j] > _ZERO else _ZERO
        angles[SHARPNESS + j] = resolution[j]


@inlined_fused
def _compare_directions(bits, number, is_always_one, lattice, angles, cosines):
    """Compares the direction to the point with those from which each row was seen.

    Nine of ten were seen from one direction only, in no order. So all are taken for such, without a
    branch, and those that are not, or look along it, are compared once more (`look_from`).
    """
    is_wide = bits.shape[0] > 1
    for j in range(number):
        word, x, y, z = bits[0, j], angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
        k = np.uint64(lowest_bit(max(word, _ONE_BIT)))
        cosine = lattice[k, 0] * x + lattice[k, 1] * y + lattice[k, 2] * z
        is_open = is_wide | (word & (word - _ONE_BIT) != _NO_BITS) | (not cosine < NEARLY_ONE)
        angles[INSIDE + j] = _ONE if is_open else _ZERO
        cosines[j] = max(cosine, _ZERO) if word != _NO_BITS else _ZERO
    for j in range(number):
        is_inside = False
        if angles[INSIDE + j] > _ZERO:
            to = angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
            cosines[j], is_inside = look_from(bits, j, lattice, to)
        angles[INSIDE + j] = np.float32(is_inside | is_always_one)


@inlined_fused
def _find_terms(focal, factor, number, angles, cosines, present, found):
    """Works the terms of some rows out; bias, noise, resolution and R are 0 where none is."""
    in_wide_vectors()
    for j in range(number):
        is_one, delta = angles[INSIDE + j] > _ZERO, angles[DELTAS + j]
        bias = bias_of(cosines[j], is_one)
        noise = exp2(log_noise(bias, is_one, angles[LOG_DELTAS + j]))
        resolution = exp2(
            log_resolution(bias, delta, angles[SHARPNESS + j], angles[RANGE + j], focal)
        )
        is_there = factor * present[j]
        found[KAPPA * CHUNK + j] = factor * (_ONE if is_one else _TWO)
        found[DELTA * CHUNK + j] = factor * delta
        found[BIAS * CHUNK + j], found[NOISE * CHUNK + j] = is_there * bias, is_there * noise
        found[RESOLUTION * CHUNK + j] = is_there * resolution
        found[VALUE * CHUNK + j] = is_there * bias * noise * resolution


@inlined_fused
def _write_terms(first, last, found, terms):
    for term in range(NUM_TERMS):
        own = terms[term][first:last]
        for j in range(last - first):
            own[j] = found[term * CHUNK + j]


@kernel
def _score_blocks(next_block, points, state, forms, directions, results):
    """Scores one block of rows after the other until none is left."""
    num, words = state[2].shape[0], state[1]
    per_point = (num + _BLOCK - 1) // _BLOCK
    bits = np.empty(((words.shape[0] + 1) // 2, CHUNK), np.uint64)
    angles, cosines = np.empty(ANGLES, np.float32), np.empty(CHUNK, np.float32)
    present, found = np.empty(CHUNK, np.float32), np.empty(NUM_TERMS * CHUNK, np.float32)
    i = claim(next_block)
    while i < points.shape[0] * per_point:
        at = i // per_point
        point = points[at]
        factor = _ONE if math.isfinite(point[0] + point[1] + point[2]) else _NAN
        terms = (
            results[0][at], results[1][at], results[2][at], results[3][at], results[4][at],
            results[5][at],
        )  # fmt: skip
        begin = i % per_point * _BLOCK
        for first in range(begin, min(begin + _BLOCK, num), CHUNK):
            last = min(first + CHUNK, num)
            part = _part(state, first, last)
            _gather_bins(words, first, last, bits)
            if _is_any_known(part, bits):
                _find_angles(point, part, forms[1], angles, present)
                _compare_directions(bits, last - first, forms[0], directions, angles, cosines)
                _find_terms(point[3], factor, last - first, angles, cosines, present, found)
                _write_terms(first, last, found, terms)
            else:
                _write_unknown(first, last, factor, forms[0], terms)
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
        points: positions [m] and focal lengths [px], [P, 4]; where a position is not finite, every
            term is NaN.
        forms: whether kappa is always 1, whether delta is that of pairs.
        directions: of the voxels' bins [b, 3].
        workers: threads.
        results: written, one array for each term [P, N].
    """
    _score_all(
        points, state[0], state[1], state[2], state[3], state[4], state[5], forms[0], forms[1],
        directions, workers, results[0], results[1], results[2], results[3], results[4], results[5],
    )  # fmt: skip
