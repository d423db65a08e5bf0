"""What is known of the voxels near some views, sorted into bricks, with what R needs of each."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.native.arithmetic import log2
from r3jax.native.compiled import inlined, parallel_kernel
from r3jax.visibility.backends.numba.bricks import voxel_of

X, Y, Z, DELTA, LOG_DELTA, RESOLUTION = 0, 1, 2, 3, 4, 5
"""Rows of the array that `gather_voxels` writes: center [m], color consistency and log2 of it,
best resolution [px/m]."""

SIZE = 6

NEVER = np.float32(-1e30)
"""Stands for log2 of 0: any power of it but the zeroth is 0, and the zeroth is 1."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_TWO_THIRDS_OF_TWO = np.float32(2.0 / 1.5)


@inlined
def log2_or_never(x):
    """log2 x; `NEVER` where x is 0."""
    return log2(x) if x > _ZERO else NEVER


@inlined
def consistency(count, m2, is_pairwise):
    """Delta of a voxel, in [0, 1] (`renderability.consistency`)."""
    variance = m2 / max(count - _ONE, _ONE)
    spread = _TWO * variance if is_pairwise else math.sqrt(_TWO_THIRDS_OF_TWO * variance)
    return min(max(_ONE - spread, _ZERO), _ONE) if count > _ONE else _ONE


@inlined
def bins_of(words, word, row):
    """Two words of 32 bins as one of 64; the second may not be there."""
    bits = np.uint64(words[word, row])
    if word + 1 < words.shape[0]:
        bits |= np.uint64(words[word + 1, row]) << np.uint64(32)
    return bits


@parallel_kernel
def gather_voxels(slots, key, words, count, m2, resolution, voxel_size, is_pairwise, workers,
                  voxels, visited, rows):  # fmt: skip
    """Gathers what is known of voxels in the order of the bricks.

    Args:
        slots: of every row of the map, -1: none [N].
        key: of the map, like the next five.
        words: its visited bins, 32 in a word.
        count: observations.
        m2: spread of the colors.
        resolution: best resolution [px/m].
        voxel_size: edge [m].
        is_pairwise: form of delta.
        workers: threads.
        voxels: written, [SIZE, n].
        visited: written, the visited bins, 64 in a word [ceil(W / 2), n].
        rows: written, the rows of the map [n].
    """
    num, capacity = rows.shape[0], slots.shape[0]
    records = np.empty((num, SIZE), np.float32)
    for share in prange(workers):
        for row in range(capacity * share // workers, capacity * (share + 1) // workers):
            slot = slots[row]
            if slot >= 0:
                # One record, so that a voxel costs one miss of the cache and not six.
                record = records[slot]
                x, y, z = voxel_of(key, row)
                record[X] = (np.float32(x) + _HALF) * voxel_size
                record[Y] = (np.float32(y) + _HALF) * voxel_size
                record[Z] = (np.float32(z) + _HALF) * voxel_size
                delta = consistency(count[row], m2[row], is_pairwise)
                record[DELTA], record[LOG_DELTA] = delta, log2_or_never(delta)
                record[RESOLUTION] = resolution[row]
                rows[slot] = row
                for word in range(0, words.shape[0], 2):
                    visited[word >> 1, slot] = bins_of(words, word, row)
    for share in prange(workers):
        for i in range(num * share // workers, num * (share + 1) // workers):
            for part in range(SIZE):
                voxels[part, i] = records[i, part]
