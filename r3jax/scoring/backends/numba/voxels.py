"""What is known of the voxels near some views, sorted into bricks, with what R needs of each."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.native.arithmetic import log2
from r3jax.native.compiled import inlined, parallel_kernel
from r3jax.visibility.backends.numba.bricks import voxel_of

X, Y, Z, DELTA, LOG_DELTA, LOG_RESOLUTION = 0, 1, 2, 3, 4, 5
"""Rows of the array that `gather_voxels` writes: center [m], color consistency, log2 of it and of
the best resolution [px/m]."""

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


@parallel_kernel
def gather_voxels(rows, state, is_pairwise, workers, voxels, visited):
    """Gathers rows of the map in the order of the bricks.

    Args:
        rows: which [n].
        state: key, visited, count, m2, resolution and voxel size of the map.
        is_pairwise: form of delta.
        workers: threads.
        voxels: written, [SIZE, n].
        visited: written, the visited bins, 64 in a word [ceil(W / 2), n].
    """
    key, words, count, m2, resolution, voxel_size = state
    num = rows.shape[0]
    for share in prange(workers):
        for i in range(num * share // workers, num * (share + 1) // workers):
            row = np.int64(rows[i])
            x, y, z = voxel_of(key, row)
            voxels[X, i] = (np.float32(x) + _HALF) * voxel_size
            voxels[Y, i] = (np.float32(y) + _HALF) * voxel_size
            voxels[Z, i] = (np.float32(z) + _HALF) * voxel_size
            delta = consistency(count[row], m2[row], is_pairwise)
            voxels[DELTA, i], voxels[LOG_DELTA, i] = delta, log2_or_never(delta)
            voxels[LOG_RESOLUTION, i] = log2_or_never(resolution[row])
            for word in range(0, words.shape[0], 2):
                bits = np.uint64(words[word, row])
                if word + 1 < words.shape[0]:
                    bits |= np.uint64(words[word + 1, row]) << np.uint64(32)
                visited[word >> 1, i] = bits
