"""What is known of the voxels near a few views, in the order of the map."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import center_of, center_of_words
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, kernel, parallel_kernel
from r3jax.kernels.scoring.voxels import (
    DELTA,
    LOG_DELTA,
    RESOLUTION,
    X,
    Y,
    Z,
    bins_of,
    consistency,
    log2_or_never,
)
from r3jax.kernels.visibility.bricks import bounds_of, may_see
from r3jax.kernels.visibility.views import CHUNK

MARGIN = np.float32(4.0)
"""A voxel so far outside of a view covers none of its pixels: nearer ones appear larger than they
are (`footprint.NEAR`) [voxels]."""

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@kernel
def _mark_near(bounds, low, high, count, voxel_size, is_near):
    """Marks the rows whose voxel may appear in a view."""
    in_wide_vectors()
    margin = MARGIN * voxel_size
    for i in range(count.shape[0]):
        x, y, z = center_of_words(low[i], high[i], voxel_size)
        is_seen = may_see(bounds, x, y, z, margin, voxel_size) & (count[i] > _ZERO)
        is_near[i] = _ONE if is_seen else is_near[i]


@kernel
def _find_near(views, is_sound, wraps, shape, low, high, count, voxel_size, is_near):
    """Marks the rows whose voxel may appear in some view."""
    is_near[:] = _ZERO
    for i in range(views.shape[0]):
        if is_sound[i]:
            bounds = bounds_of(views[i], wraps, shape)
            _mark_near(bounds, low, high, count, voxel_size, is_near)


@inlined
def choose_marked(marks, first, count, chosen):
    """Writes the rows that are marked; returns how many they are."""
    num = 0
    for i in range(count):
        chosen[num] = first + i
        num += marks[i] > _ZERO
    return num


@inlined
def gather(
    key, words, count, m2, resolution, voxel_size, num, chosen, begin, voxels, visited, rows
):
    """Gathers what is known of chosen rows to where they belong."""
    for j in range(num):
        row, to = np.int64(chosen[j]), begin + j
        voxels[X, to], voxels[Y, to], voxels[Z, to] = center_of(key, row, voxel_size)
        rows[to] = row
    # One array after the other: more misses of the cache are then under way at a time.
    for j in range(num):
        voxels[DELTA, begin + j] = count[np.int64(chosen[j])]
    for j in range(num):
        voxels[LOG_DELTA, begin + j] = m2[np.int64(chosen[j])]
    for j in range(num):
        voxels[RESOLUTION, begin + j] = resolution[np.int64(chosen[j])]
    for word in range(0, words.shape[0], 2):
        for j in range(num):
            visited[word >> 1, begin + j] = bins_of(words, word, np.int64(chosen[j]))


@kernel
def find_consistency(counts, spreads, is_pairwise):
    """Replaces counts by delta, and spreads of colors by its logarithm."""
    in_wide_vectors()
    for i in range(counts.shape[0]):
        delta = consistency(counts[i], spreads[i], is_pairwise)
        counts[i], spreads[i] = delta, log2_or_never(delta)


@parallel_kernel
def gather_near(
    views, is_sound, wraps, height, width, key, words, count, m2, resolution, voxel_size,
    is_pairwise, workers, voxels, visited, rows, runs,
):  # fmt: skip
    """Gathers what is known of the voxels that some view may see.

    Args:
        views: one a row.
        is_sound: False for views that see nothing.
        wraps: True for octahedral maps.
        height: of the images [px].
        width: of the images [px].
        key: of the map, like the next five.
        words: its visited bins, 32 in a word.
        count: observations; 0 where there is no voxel.
        m2: spread of the colors.
        resolution: best resolution [px/m].
        voxel_size: edge [m].
        is_pairwise: form of delta.
        workers: threads; each writes from where its share of the rows begins.
        voxels: written, [SIZE, N].
        visited: written, the visited bins, 64 in a word [ceil(W / 2), N].
        rows: written, the rows of the map [N].
        runs: written, where the voxels of each share begin and end [workers, 2].
    """
    capacity = count.shape[0]
    for share in prange(workers):
        # Whole bytes of the rows' bits: no two threads write into one.
        begin = capacity // 8 * share // workers * 8
        end = capacity // 8 * (share + 1) // workers * 8 if share + 1 < workers else capacity
        is_near, chosen = np.empty(CHUNK, np.float32), np.empty(CHUNK + 1, np.int32)
        to = begin
        for first in range(begin, end, CHUNK):
            last = min(first + CHUNK, end)
            _find_near(
                views, is_sound, wraps, (height, width), key[0][first:last], key[1][first:last],
                count[first:last], voxel_size, is_near,
            )  # fmt: skip
            num = choose_marked(is_near, first, last - first, chosen)
            gather(
                key, words, count, m2, resolution, voxel_size, num, chosen, to, voxels, visited,
                rows,
            )  # fmt: skip
            find_consistency(
                voxels[DELTA, to : to + num], voxels[LOG_DELTA, to : to + num], is_pairwise
            )
            to += num
        runs[share, 0], runs[share, 1] = begin, to
