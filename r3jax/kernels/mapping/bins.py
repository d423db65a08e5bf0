"""Direction bins and resolutions of voxels seen from a camera."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np

from r3jax.kernels.native.arithmetic import end_of, floor, middle_of, signed_of, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, inlined_fused, kernel

_X, _Y, _Z, _SHARPNESS = 0, 1, 2, 3
"""Rows of a chunk's looks: direction and resolution [px/m]."""

_CHUNK = 256
"""Number of voxels processed together, in vectors that stay in the L1 cache."""

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LEAST, _TINY, _INFINITE = np.float32(1e-6), np.float32(1e-20), np.float32(np.inf)


class Camera(NamedTuple):
    """Position and focal length of the camera."""

    voxel_size: Any
    """[m]."""

    focal: Any
    """Focal length of resolutions [px]."""

    x: Any
    """Center [m]."""

    y: Any
    z: Any


@inlined
def camera_of(frame, voxel_size):
    """Returns the camera of a frame."""
    T = frame.T_world_camera
    return Camera(voxel_size, frame.focal, T[0, 3], T[1, 3], T[2, 3])


@inlined_fused
def fold(x, y, z, size):
    """Finds the octahedral cell of a direction (`geometry.sphere.octahedral_cell`)."""
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
def _cosine(x, y, z, bin, lattice):
    row = np.uint32(bin)
    return lattice[row, 0] * x + lattice[row, 1] * y + lattice[row, 2] * z


@inlined_fused
def nearest_bin(x, y, z, cell, table, lattice):
    """Finds the bin of a direction (`geometry.sphere.nearest_bin`).

    It is the best of the few candidates in the direction's cell.
    """
    cell, width = np.uint32(cell), table.shape[1]
    # The first two are compared without a branch: most cells have one or two, unpredictably.
    chosen, second = table[cell, 0], table[cell, min(width - 1, 1)]
    best, cosine = _cosine(x, y, z, chosen, lattice), _cosine(x, y, z, second, lattice)
    is_padded = width < 3 or table[cell, 2] == chosen
    chosen, best = second if cosine > best else chosen, max(best, cosine)
    if not is_padded:
        for k in range(2, width):
            cosine = _cosine(x, y, z, table[cell, k], lattice)
            is_better = cosine > best
            chosen, best = table[cell, k] if is_better else chosen, max(best, cosine)
    return chosen


@inlined
def center_of_words(low, high, voxel_size):
    """Computes the center [m] of the voxel whose key has these words (`geometry.voxels.unpack`)."""
    return (
        (signed_of(low) + _HALF) * voxel_size,
        (signed_of(middle_of(low, high)) + _HALF) * voxel_size,
        (signed_of(end_of(high)) + _HALF) * voxel_size,
    )


@inlined
def center_of(key, row, voxel_size):
    """Computes the center of the voxel in a row of the map [m]."""
    return center_of_words(key[0, row], key[1, row], voxel_size)


@inlined_fused
def _look(low, high, num, camera, size, looks, cells):
    """Computes directions to a camera, their octahedral cells, and resolutions of some voxels."""
    in_wide_vectors()
    for i in range(num):
        center = center_of_words(low[i], high[i], camera.voxel_size)
        x, y, z = camera.x - center[0], camera.y - center[1], camera.z - center[2]
        distance = max(math.sqrt(x * x + y * y + z * z), _LEAST)
        x, y, z = x / distance, y / distance, z / distance
        looks[_X, i], looks[_Y, i], looks[_Z, i] = x, y, z
        looks[_SHARPNESS, i] = camera.focal / distance
        cells[i] = fold(x, y, z, size)


@kernel
def mark_rows(key, visited, resolution, rows, num, camera, table, lattice):
    """Sets the bin of rows towards a camera, and raises their resolution (`seen.mark_rows`).

    Args:
        key: of the map [2, N].
        visited: words of bins, changed in place [W, N].
        resolution: best so far [px/m], changed in place [N].
        rows: which; all of them hold voxels.
        num: how many of them.
        camera: which.
        table: candidates of each octahedral cell [S^2, K].
        lattice: directions of the bins [B, 3].
    """
    size = np.float32(math.sqrt(table.shape[0]))
    low, high = np.empty(_CHUNK, np.uint32), np.empty(_CHUNK, np.uint32)
    looks, cells = np.empty((4, _CHUNK), np.float32), np.empty(_CHUNK, np.int32)
    for first in range(0, num, _CHUNK):
        count = min(_CHUNK, num - first)
        for i in range(count):
            row = np.int64(rows[first + i])
            low[i], high[i] = key[0, row], key[1, row]
        _look(low, high, count, camera, size, looks, cells)
        for i in range(count):
            row = np.int64(rows[first + i])
            x, y, z = looks[_X, i], looks[_Y, i], looks[_Z, i]
            chosen = nearest_bin(x, y, z, cells[i], table, lattice)
            visited[chosen >> 5, row] |= np.uint32(1) << np.uint32(chosen & 31)
            resolution[row] = max(resolution[row], looks[_SHARPNESS, i])


@inlined
def is_valid(camera):
    """Checks if a camera and a voxel size are valid; otherwise nothing is seen."""
    total = camera.voxel_size + camera.focal + camera.x + camera.y + camera.z
    return (camera.voxel_size > _ZERO) & (abs(total) < _INFINITE)
