"""Which voxel each pixel of a view shows, and the mean of their R."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import center_of
from r3jax.kernels.native.arithmetic import key_of
from r3jax.kernels.native.compiled import (
    claim,
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
)
from r3jax.kernels.scoring.sums import FEW, sound_views
from r3jax.kernels.scoring.terms import look_from, product_of_terms
from r3jax.kernels.scoring.voxels import bins_of, consistency, log2_or_never
from r3jax.kernels.visibility.bricks import MOST, find_runs, sorted_slots
from r3jax.kernels.visibility.picture import (
    begin_of,
    push_down,
    pyramid_size,
    side_of,
    stride_of,
)
from r3jax.kernels.visibility.splat import SPARE, TARGETS, find_targets
from r3jax.kernels.visibility.views import (
    CHUNK,
    DISTANCE,
    FOCAL,
    PLACED,
    POSITION,
    place,
)

_NOTHING = np.int64(2**63 - 1)
_ROW = np.int64(2**32 - 1)
_ONE, _LEAST = np.float32(1.0), np.float32(1e-6)


@parallel_kernel
def gather_centers(slots, key, voxel_size, workers, centers, rows):
    """Gathers centers [3, n] [m] and rows [n] of voxels in the order of the bricks."""
    capacity = slots.shape[0]
    for share in prange(workers):
        for row in range(capacity * share // workers, capacity * (share + 1) // workers):
            slot = slots[row]
            if slot >= 0:
                x, y, z = center_of(key, row, voxel_size)
                centers[0, slot], centers[1, slot], centers[2, slot] = x, y, z
                rows[slot] = row


@inlined
def _keep_nearest(placed, targets, first, count, rows, keys):
    """Keeps the nearest voxel in every pixel that a chunk covers, of equals the first row."""
    for i in range(count):
        key = key_of(placed[DISTANCE + i], rows[first + i])
        for corner in range(4):
            at = np.uint32(targets[corner * CHUNK + i])
            keys[at] = min(keys[at], key)


@kernel
def nearest_rows(view, wraps, shape, voxel_size, runs, centers, rows, chunk, keys):
    """Finds the nearest voxel in every pixel: keys of distance and row, at the finest level."""
    placed, targets = chunk
    side = side_of(shape)
    keys[:] = _NOTHING
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, shape, wraps, centers[0], centers[1], centers[2], first, count, placed)
            find_targets(placed, count, voxel_size, side, targets)
            _keep_nearest(placed, targets, first, count, rows, keys)
    push_down(keys, side, shape, wraps)


@inlined_fused
def _value_of(row, view, state, forms, directions, bits):
    """R of the voxel in a row of the map, as a view sees it."""
    key, words, count, m2, resolution, voxel_size = state
    x, y, z = center_of(key, row, voxel_size)
    dx, dy, dz = view[POSITION] - x, view[POSITION + 1] - y, view[POSITION + 2] - z
    distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
    inverse = _ONE / distance
    for word in range(0, words.shape[0], 2):
        bits[word >> 1, 0] = bins_of(words, word, row)
    to = dx * inverse, dy * inverse, dz * inverse
    cosine, is_inside = look_from(bits, 0, directions, to)
    delta = consistency(count[row], m2[row], forms[1])
    return product_of_terms(
        cosine, is_inside | forms[0], distance, delta, log2_or_never(delta),
        resolution[row], view[FOCAL],
    )  # fmt: skip


@kernel
def _mean_of(keys, side, shape, view, state, forms, directions, bits):
    """Mean of R over the pixels; 0 where a pixel shows nothing. Neighbors often show the same."""
    total, last, value = 0.0, np.int64(-1), np.float32(0.0)
    for r in range(shape[0]):
        for c in range(shape[1]):
            key = keys[begin_of(0, side) + r * stride_of(side) + c]
            if key < _INFINITE_KEY:
                row = key & _ROW
                if row != last:
                    value = _value_of(row, view, state, forms, directions, bits)
                    last = row
                total += value
    return np.float32(total / (shape[0] * shape[1]))


_INFINITE_KEY = np.int64(0x7F800000) << np.int64(32)
"""Keys from here on are of voxels out of sight, or of none."""


@inlined
def _write_rows(keys, side, shape, num, image):
    """Writes the row in every pixel; `num` where there is none."""
    if image.shape[0] > 0:
        for r in range(shape[0]):
            for c in range(shape[1]):
                key = keys[begin_of(0, side) + r * stride_of(side) + c]
                image[r * shape[1] + c] = key & _ROW if key < _INFINITE_KEY else num


@kernel
def _look_share(next_view, views, is_sound, layout, state, index, forms, directions, results):
    """Looks from one view after the other until none is left."""
    wraps, shape = layout
    starts, spheres, rows, centers = index
    means, images = results
    voxel_size, side = state[5], side_of(shape)
    placed, targets = np.empty(PLACED, np.float32), np.empty(TARGETS, np.int32)
    keys = np.empty(pyramid_size(side) + SPARE, np.int64)
    runs = np.empty((spheres.shape[0], 2), np.int64)
    bits = np.empty(((state[1].shape[0] + 1) // 2, 1), np.uint64)
    i = claim(next_view)
    while i < views.shape[0]:
        means[i], images[i] = 0.0, state[2].shape[0]
        if is_sound[i]:
            view = views[i]
            num = find_runs(view, wraps, shape, voxel_size, starts, spheres, runs)
            nearest_rows(
                view, wraps, shape, voxel_size, runs[:num], centers, rows, (placed, targets), keys
            )
            if images.shape[1] > 0:
                _write_rows(keys, side, shape, state[2].shape[0], images[i])
            else:
                means[i] = _mean_of(keys, side, shape, view, state, forms, directions, bits)
        i = claim(next_view)


@parallel_kernel
def look_all(
    views, is_sound, wraps, height, width, key, words, count, m2, resolution, voxel_size,
    starts, spheres, rows, centers, is_always_one, is_pairwise, directions, workers, means, images,
):  # fmt: skip
    """Looks from all views, each by one thread. Numba's threads take no nested arguments."""
    next_view = np.zeros(1, np.int64)
    for _ in prange(workers):
        _look_share(
            next_view, views, is_sound, (wraps, (height, width)),
            (key, words, count, m2, resolution, voxel_size), (starts, spheres, rows, centers),
            (is_always_one, is_pairwise), directions, (means, images),
        )  # fmt: skip


@kernel
def pixels_pass(state, views, layout, forms, directions, workers, results):
    """Finds what each pixel of many views shows.

    Args:
        state: as in `sums_of_many`.
        views: [P, VIEW_SIZE].
        layout: whether views wrap, and height and width of their buffers [px].
        forms: whether kappa is always 1, whether delta is that of pairs.
        directions: of the voxels' bins [b, 3].
        workers: threads.
        results: written; means of R [P], and the rows of the map [P, h w]. With room for rows
            [P, 0] there are none, without it the means are 0.
    """
    voxel_size = state[5]
    is_sound = sound_views(views, voxel_size)
    most = 1 if views.shape[0] <= FEW else MOST
    slots, starts, spheres = sorted_slots(
        state[0], state[2], views, is_sound, voxel_size, most, workers
    )
    num = starts[starts.shape[0] - 1]
    centers, rows = np.empty((3, num), np.float32), np.empty(num, np.int32)
    gather_centers(slots, state[0], voxel_size, workers, centers, rows)
    look_all(
        views, is_sound, layout[0], layout[1][0], layout[1][1], state[0], state[1], state[2],
        state[3], state[4], voxel_size, starts, spheres, rows, centers, forms[0], forms[1],
        directions, workers, results[0], results[1],
    )  # fmt: skip
