"""R of a voxel: the formulas of `scoring.terms`.

    R = cos^kappa  delta^(kappa (1 - b))  min(1, rho_max / rho)^(1 - delta b)

Of the direction bins only those that are set are looked at, one to three of 64 as a rule.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types

from r3jax.kernels.constants import ON_EDGE
from r3jax.kernels.native.arithmetic import exp2, log2
from r3jax.kernels.native.compiled import inlined, inlined_fused, intrinsic
from r3jax.kernels.visibility.views import CHUNK


class Choices(NamedTuple):
    """Forms of the terms (`calls.Forms`)."""

    is_kappa_one: Any
    """Whether kappa is always 1."""

    is_pairwise: Any
    """Whether delta is that of pairs."""


TO_X, TO_Y, TO_Z = 0 * CHUNK, 1 * CHUNK, 2 * CHUNK
"""Where the parts of a chunk's angles begin: unit vectors from the camera to the points,"""

RANGE, INSIDE = 3 * CHUNK, 4 * CHUNK
"""distance [m], and 1 where the camera lies in the box of the directions from which a voxel was
seen."""

DELTAS, LOG_DELTAS, SHARPNESS = 5 * CHUNK, 6 * CHUNK, 7 * CHUNK
"""Columns of the voxels, see `voxels`; the last is the best resolution."""

ANGLES = 8 * CHUNK
"""Floats that all this of a chunk takes."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_INFINITE, _POLE, _LEAST = np.float32(np.inf), np.float32(1e-12), np.float32(1e-6)
_EDGE = np.float32(ON_EDGE)
_TWO_THIRDS_OF_TWO = np.float32(2.0 / 1.5)
NEVER = np.float32(-1e30)
"""Stands for log2 of 0: any power of it but the zeroth is 0, and the zeroth is 1."""

_NO_BITS, _ONE_BIT = np.uint64(0), np.uint64(1)
NEARLY_ONE = np.float32(0.999)
"""Cosine of 2.6 degrees: far outside of a box as large as `_EDGE`."""


@inlined
def log2_or_never(x):
    """Computes log2 x; `NEVER` where x is 0."""
    return log2(x) if x > _ZERO else NEVER


@inlined
def consistency(count, m2, is_pairwise):
    """Computes delta of a voxel, in [0, 1] (`scoring.terms.consistency`)."""
    variance = m2 / max(count - _ONE, _ONE)
    spread = _TWO * variance if is_pairwise else math.sqrt(_TWO_THIRDS_OF_TWO * variance)
    return min(max(_ONE - spread, _ZERO), _ONE) if count > _ONE else _ONE


@intrinsic
def lowest_bit(typingctx, word):
    """Finds the lowest bit that is set in a word that is not 0."""

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
    word = visited[0, at]
    if visited.shape[0] == 1 and word & (word - _ONE_BIT) == _NO_BITS:
        if word == _NO_BITS:
            return _ZERO, False
        # A box of one direction is a point, in which only that very direction lies.
        k = np.uint64(lowest_bit(word))
        cosine = lattice[k, 0] * x + lattice[k, 1] * y + lattice[k, 2] * z
        if cosine < NEARLY_ONE:
            return max(cosine, _ZERO), False
    is_pole = x * x + y * y < _POLE
    a_x, a_y = (_ONE if is_pole else -y), (_ZERO if is_pole else x)
    b_x, b_y, b_z = -z * a_y, z * a_x, x * a_y - y * a_x
    best = _ZERO
    a_low, b_low, minus_a_high, minus_b_high = _INFINITE, _INFINITE, _INFINITE, _INFINITE
    for w in range(visited.shape[0]):
        word = visited[w, at]
        while word != _NO_BITS:
            k = np.uint64(64 * w + lowest_bit(word))
            word = word & (word - _ONE_BIT)
            q_x, q_y, q_z = lattice[k, 0], lattice[k, 1], lattice[k, 2]
            cosine = q_x * x + q_y * y + q_z * z
            best = max(best, cosine)
            # Added, without a branch: corners that are not ahead do not bound the box.
            apart = _ZERO if cosine > _ZERO else _INFINITE
            a = q_x * a_x + q_y * a_y
            b = q_x * b_x + q_y * b_y + q_z * b_z
            a_low, minus_a_high = min(a_low, apart + a), min(minus_a_high, apart - a)
            b_low, minus_b_high = min(b_low, apart + b), min(minus_b_high, apart - b)
    low, minus_high = max(a_low, b_low), max(minus_a_high, minus_b_high)
    is_inside = (low <= _EDGE) & (minus_high <= _EDGE)
    return min(best, _ONE), is_inside


@inlined_fused
def bias_of(cosine, is_one):
    """Computes B = cos^kappa, with kappa 1 or 2."""
    return cosine if is_one else cosine * cosine


@inlined_fused
def log_noise(bias, is_one, log_delta):
    """Computes log2 of delta^(kappa (1 - b))."""
    kappa = _ONE if is_one else _TWO
    return kappa * (_ONE - bias) * log_delta


@inlined_fused
def log_resolution(bias, delta, best, distance, focal):
    """Computes log2 of min(1, rho_max / rho)^(1 - delta b), with rho = focal / distance."""
    return (_ONE - delta * bias) * log2_or_never(min(best * distance / focal, _ONE))


@inlined_fused
def product_of_terms(cosine, is_one, distance, delta, log_delta, best, focal):
    """Computes R of a voxel from its angle and its observations, by one power instead of two."""
    bias = bias_of(cosine, is_one)
    power = log_noise(bias, is_one, log_delta) + log_resolution(bias, delta, best, distance, focal)
    return bias * exp2(power)
