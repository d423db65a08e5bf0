"""R of the voxels that a view sees: the formulas of `renderability` and `directions`.

    R = cos^kappa  delta^(kappa (1 - b))  min(1, rho_max / rho)^(1 - delta b)

Of the direction bins only those that are set are looked at, one to three of 64 as a rule.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from llvmlite import ir
from numba import types

from r3jax.native.arithmetic import exp2
from r3jax.native.compiled import inlined_fused, intrinsic
from r3jax.scoring import directions
from r3jax.scoring.backends.numba.voxels import log2_or_never
from r3jax.visibility.backends.numba.views import CHUNK

TO_X, TO_Y, TO_Z = 0 * CHUNK, 1 * CHUNK, 2 * CHUNK
"""Where the parts of a chunk's angles begin: unit vectors from the camera to the points,"""

RANGE, INSIDE = 3 * CHUNK, 4 * CHUNK
"""distance [m], and 1 where the camera lies in the box of the directions from which a voxel was
seen."""

DELTAS, LOG_DELTAS, SHARPNESS = 5 * CHUNK, 6 * CHUNK, 7 * CHUNK
"""What is known of the voxels, see `voxels`: the last is the best resolution."""

ANGLES = 8 * CHUNK
"""Floats that all this of a chunk takes."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_INFINITE, _POLE, _LEAST = np.float32(np.inf), np.float32(1e-12), np.float32(1e-6)
_EDGE = np.float32(directions.ON_EDGE)
_NO_BITS, _ONE_BIT = np.uint64(0), np.uint64(1)


@intrinsic
def lowest_bit(typingctx, word):
    """Number of the lowest bit that is set in a word that is not 0."""

    def codegen(context, builder, sig, args):
        number = builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))
        return number

    return types.int64(types.uint64), codegen


@inlined_fused
def look_from(visited, at, lattice, direction):
    """Compares one direction with the bins from which a voxel was seen (`seen_directions`).

    Args:
        visited: words of 64 visited bins [W, n].
        at: which voxel.
        lattice: directions of the bins [B, 3].
        direction: unit vector from the voxel to the camera.

    Returns:
        The cosine, in [0, 1], and whether the direction lies in the box.
    """
    x, y, z = direction
    is_pole = x * x + y * y < _POLE
    a_x, a_y = (_ONE if is_pole else -y), (_ZERO if is_pole else x)
    b_x, b_y, b_z = -z * a_y, z * a_x, x * a_y - y * a_x
    best = _ZERO
    a_low, b_low, a_high, b_high = _INFINITE, _INFINITE, -_INFINITE, -_INFINITE
    for w in range(visited.shape[0]):
        word = visited[w, at]
        while word != _NO_BITS:
            k = np.uint64(64 * w + lowest_bit(word))
            word = word & (word - _ONE_BIT)
            q_x, q_y, q_z = lattice[k, 0], lattice[k, 1], lattice[k, 2]
            cosine = q_x * x + q_y * y + q_z * z
            best = max(best, cosine)
            is_ahead = cosine > _ZERO
            a = q_x * a_x + q_y * a_y
            b = q_x * b_x + q_y * b_y + q_z * b_z
            a_low = min(a_low, a if is_ahead else _INFINITE)
            b_low = min(b_low, b if is_ahead else _INFINITE)
            a_high = max(a_high, a if is_ahead else -_INFINITE)
            b_high = max(b_high, b if is_ahead else -_INFINITE)
    is_inside = (a_low <= _EDGE) & (a_high >= -_EDGE) & (b_low <= _EDGE) & (b_high >= -_EDGE)
    return min(best, _ONE), is_inside


@inlined_fused
def product_of_terms(cosine, is_one, distance, delta, log_delta, resolution, focal):
    """R of one voxel from its angle and what is known of it."""
    kappa = _ONE if is_one else _TWO
    bias = cosine if is_one else cosine * cosine
    ratio = log2_or_never(min(resolution * distance / focal, _ONE))
    return bias * exp2(kappa * (_ONE - bias) * log_delta + (_ONE - delta * bias) * ratio)
