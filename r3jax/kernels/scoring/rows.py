"""The terms of R of every row of a map as points see them, hidden or not."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import center_of
from r3jax.kernels.native.arithmetic import exp2
from r3jax.kernels.native.compiled import inlined_fused, kernel, parallel_kernel
from r3jax.kernels.scoring.terms import (
    bias_of,
    consistency,
    log2_or_never,
    log_noise,
    log_resolution,
    look_from,
)
from r3jax.kernels.scoring.voxels import bins_of

_SHARE = 1 << 12
"""Rows that a thread takes at a time."""

_ZERO, _ONE, _TWO, _LEAST = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(1e-6)
_NAN = np.float32(np.nan)


class Terms(NamedTuple):
    """What is written [P, N], in the order of the fields of `scoring.terms.Renderability`."""

    kappa: Any
    bias: Any
    delta: Any
    noise: Any
    resolution: Any
    value: Any


@inlined_fused
def _score(rows, row, position, focal, forms, lattice, bits):
    """Computes the terms of one row, except for R."""
    x, y, z = center_of(rows.key, row, rows.voxel_size)
    dx, dy, dz = position[0] - x, position[1] - y, position[2] - z
    distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
    inverse = _ONE / distance
    for word in range(0, rows.visited.shape[0], 2):
        bits[word >> 1, 0] = bins_of(rows.visited, word, row)
    cosine, is_inside = look_from(bits, 0, lattice, (dx * inverse, dy * inverse, dz * inverse))
    is_one = is_inside | forms.is_kappa_one
    delta = consistency(rows.counts[row], rows.m2[row], forms.is_pairwise)
    bias = bias_of(cosine, is_one)
    noise = exp2(log_noise(bias, is_one, log2_or_never(delta)))
    sharpness = rows.resolution[row]
    resolution = exp2(log_resolution(bias, delta, sharpness, distance, focal))
    return _ONE if is_one else _TWO, bias, delta, noise, resolution


@kernel
def _score_share(rows, first, last, i, position, focal, forms, lattice, results):
    """Scores some rows for the i-th point; bias, noise, resolution and R are 0 where none is."""
    bits = np.empty(((rows.visited.shape[0] + 1) // 2, 1), np.uint64)
    factor = _ONE if math.isfinite(position[0] + position[1] + position[2]) else _NAN
    for row in range(first, last):
        kappa, bias, delta, noise, best = _score(rows, row, position, focal, forms, lattice, bits)
        is_there = factor if rows.counts[row] > _ZERO else factor * _ZERO
        results.kappa[i, row], results.delta[i, row] = factor * kappa, factor * delta
        results.bias[i, row], results.noise[i, row] = is_there * bias, is_there * noise
        results.resolution[i, row] = is_there * best
        results.value[i, row] = is_there * bias * noise * best


@parallel_kernel
def terms(rows, positions, focals, forms, lattice, workers, results):
    """Computes the terms of all rows of a map.

    Args:
        rows: of the map, `calls.MapRows`.
        positions: of cameras [P, 3] [m]; where one is not finite, every term is NaN.
        focals: focal lengths [P] [px].
        forms: `Choices` of R.
        lattice: directions of the voxels' bins [b, 3].
        workers: threads.
        results: written, `Terms`.
    """
    num = rows.counts.shape[0]
    shares = (num + _SHARE - 1) // _SHARE
    for worker in prange(workers):
        for share in range(worker, shares, workers):
            first, last = share * _SHARE, min((share + 1) * _SHARE, num)
            for i in range(positions.shape[0]):
                position = positions[i, 0], positions[i, 1], positions[i, 2]
                _score_share(
                    rows, first, last, np.int64(i), position, focals[i], forms, lattice, results
                )
