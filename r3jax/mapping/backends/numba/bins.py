"""The direction bin and the resolution of a look at a voxel."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.native.arithmetic import floor, whole
from r3jax.native.compiled import inlined, inlined_fused
from r3jax.visibility.backends.numba.bricks import voxel_of

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LEAST, _TINY = np.float32(1e-6), np.float32(1e-20)


@inlined_fused
def fold(x, y, z, size):
    """Octahedral cell of a direction, row * size + column (`geometry.sphere.octahedral_cell`)."""
    inverse = _ONE / max(abs(x) + abs(y) + abs(z), _TINY)
    u, v = x * inverse, y * inverse
    is_lower = z < _ZERO
    a = (_ONE - abs(v)) * (_ONE if u >= _ZERO else -_ONE) if is_lower else u
    b = (_ONE - abs(u)) * (_ONE if v >= _ZERO else -_ONE) if is_lower else v
    last = size - _ONE
    column = min(max(floor((a * _HALF + _HALF) * size), _ZERO), last)
    row = min(max(floor((b * _HALF + _HALF) * size), _ZERO), last)
    return whole(row * size + column)


@inlined_fused
def nearest_bin(x, y, z, cell, table, lattice):
    """Bin of a direction (`geometry.sphere.nearest_bin`): the best of the few in its cell."""
    chosen, best = np.int32(0), -_TWO
    for k in range(table.shape[1]):
        at = table[np.uint32(cell), k]
        row = np.uint32(at)
        cosine = lattice[row, 0] * x + lattice[row, 1] * y + lattice[row, 2] * z
        is_better = cosine > best
        chosen, best = at if is_better else chosen, cosine if is_better else best
    return chosen


@inlined
def center_of(key, row, voxel_size):
    """Center of the voxel in a row of the map [m]."""
    x, y, z = voxel_of(key, row)
    return (
        (np.float32(x) + _HALF) * voxel_size,
        (np.float32(y) + _HALF) * voxel_size,
        (np.float32(z) + _HALF) * voxel_size,
    )


@inlined_fused
def evidence(key, row, camera, table, lattice):
    """Bin towards a camera and resolution [px/m] of the voxel in a row (`seen.evidence_of_view`).

    Args:
        key: of the map [2, N].
        row: which.
        camera: voxel size, focal length and position.
        table: candidates of each octahedral cell [S^2, K].
        lattice: directions of the bins [B, 3].
    """
    center = center_of(key, row, camera[0])
    x, y, z = camera[2] - center[0], camera[3] - center[1], camera[4] - center[2]
    distance = max(math.sqrt(x * x + y * y + z * z), _LEAST)
    x, y, z = x / distance, y / distance, z / distance
    cell = fold(x, y, z, np.float32(math.sqrt(table.shape[0])))
    return nearest_bin(x, y, z, cell, table, lattice), camera[1] / distance


@inlined
def is_sound(camera):
    """False if a number of a camera cannot be: nothing is seen from there."""
    return np.isfinite(camera).all() and camera[0] > _ZERO
