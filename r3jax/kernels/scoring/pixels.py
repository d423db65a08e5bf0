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
from r3jax.kernels.scoring.terms import (
    consistency,
    log2_or_never,
    look_from,
    product_of_terms,
)
from r3jax.kernels.scoring.voxels import bins_of
from r3jax.kernels.visibility.bricks import find_runs, sorted_slots
from r3jax.kernels.visibility.picture import (
    SPARE,
    TARGETS,
    begin_of,
    find_targets,
    push_down,
    pyramid_size,
    side_of,
    stride_of,
)
from r3jax.kernels.visibility.views import CHUNK, DISTANCE, PLACED, place, sound_views, view_at

_NOTHING = np.int64(2**63 - 1)
_ROW = np.int64(2**32 - 1)
_ONE, _LEAST = np.float32(1.0), np.float32(1e-6)

_INFINITE_KEY = np.int64(0x7F800000) << np.int64(32)
"""Keys from here on are of voxels out of sight, or of none."""


@parallel_kernel
def _gather_centers(slots, rows, workers, centers, numbers):
    """Gathers centers [3, n] [m] and rows [n] of voxels in the order of the bricks."""
    capacity = slots.shape[0]
    for share in prange(workers):
        for row in range(capacity * share // workers, capacity * (share + 1) // workers):
            slot = slots[row]
            if slot >= 0:
                x, y, z = center_of(rows.key, row, rows.voxel_size)
                centers[0, slot], centers[1, slot], centers[2, slot] = x, y, z
                numbers[slot] = row


@inlined
def _keep_nearest(placed, targets, first, count, numbers, keys):
    """Keeps the nearest voxel in every pixel that a chunk covers, of equals the first row."""
    for i in range(count):
        key = key_of(placed[DISTANCE + i], numbers[first + i])
        for corner in range(4):
            at = np.uint32(targets[corner * CHUNK + i])
            keys[at] = min(keys[at], key)


@kernel
def _draw(view, layout, voxel_size, runs, centers, numbers, placed, targets, keys):
    """Finds the nearest voxel in every pixel: keys of distance and row, at the finest level."""
    shape = layout.height, layout.width
    side = side_of(shape)
    keys[:] = _NOTHING
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, layout, centers, first, count, placed)
            find_targets(placed, count, voxel_size, side, targets)
            _keep_nearest(placed, targets, first, count, numbers, keys)
    push_down(keys, side, shape, layout.wraps)


@inlined_fused
def _value_of(row, view, rows, forms, lattice, bits):
    """Computes R of the voxel in a row of the map, as a view sees it."""
    x, y, z = center_of(rows.key, row, rows.voxel_size)
    dx, dy, dz = view.position[0] - x, view.position[1] - y, view.position[2] - z
    distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
    inverse = _ONE / distance
    for word in range(0, rows.visited.shape[0], 2):
        bits[word >> 1, 0] = bins_of(rows.visited, word, row)
    cosine, is_inside = look_from(bits, 0, lattice, (dx * inverse, dy * inverse, dz * inverse))
    delta = consistency(rows.counts[row], rows.m2[row], forms.is_pairwise)
    return product_of_terms(
        cosine, is_inside | forms.is_kappa_one, distance, delta, log2_or_never(delta),
        rows.resolution[row], view.focal,
    )  # fmt: skip


@kernel
def _mean_of(keys, layout, view, rows, forms, lattice, bits):
    """Computes the mean of R over the pixels.

    Empty pixels count as 0. Neighbors often show the same voxel.
    """
    total, last, value = 0.0, np.int64(-1), np.float32(0.0)
    side = side_of((layout.height, layout.width))
    for r in range(layout.height):
        for c in range(layout.width):
            key = keys[begin_of(0, side) + r * stride_of(side) + c]
            if key < _INFINITE_KEY:
                row = key & _ROW
                if row != last:
                    value = _value_of(row, view, rows, forms, lattice, bits)
                    last = row
                total += value
    return np.float32(total / (layout.height * layout.width))


@inlined
def _write_rows(keys, layout, none, image):
    """Writes the row in every pixel; `none` where there is none."""
    side = side_of((layout.height, layout.width))
    for r in range(layout.height):
        for c in range(layout.width):
            key = keys[begin_of(0, side) + r * stride_of(side) + c]
            image[r * layout.width + c] = key & _ROW if key < _INFINITE_KEY else none


@kernel
def _look_share(
    next_view, views, is_valid, layout, rows, bricks, centers, numbers, forms, lattice, means,
    images,
):  # fmt: skip
    """Looks from one view after the other until none is left to claim."""
    side, none = side_of((layout.height, layout.width)), rows.counts.shape[0]
    placed, targets = np.empty(PLACED, np.float32), np.empty(TARGETS, np.int32)
    keys = np.empty(pyramid_size(side) + SPARE, np.int64)
    runs = np.empty((bricks.spheres.shape[0], 2), np.int64)
    bits = np.empty(((rows.visited.shape[0] + 1) // 2, 1), np.uint64)
    i = claim(next_view)
    while i < is_valid.shape[0]:
        means[i], images[i] = 0.0, none
        if is_valid[i]:
            view = view_at(views, i)
            num = find_runs(view, layout, rows.voxel_size, bricks, runs)
            _draw(
                view, layout, rows.voxel_size, runs[:num], centers, numbers, placed, targets, keys
            )
            if images.shape[1] > 0:
                _write_rows(keys, layout, none, images[i])
            else:
                means[i] = _mean_of(keys, layout, view, rows, forms, lattice, bits)
        i = claim(next_view)


@parallel_kernel
def _look_all(
    views,
    is_valid,
    layout,
    rows,
    bricks,
    centers,
    numbers,
    forms,
    lattice,
    workers,
    means,
    images,
):
    next_view = np.zeros(1, np.int64)
    for _ in prange(workers):
        _look_share(
            next_view, views, is_valid, layout, rows, bricks, centers, numbers, forms, lattice,
            means, images,
        )  # fmt: skip


@kernel
def pixels(rows, views, layout, forms, lattice, workers, means, images):
    """Finds what each pixel of many views shows.

    Args:
        rows: of the map, `calls.MapRows`.
        views: `calls.Views`.
        layout: `calls.Layout`.
        forms: `Choices` of R.
        lattice: directions of the voxels' bins [b, 3].
        workers: threads; each takes one view after the other.
        means: written; of R [P], or 0 if there is room for rows.
        images: written; the rows of the map [P, h w], or without room [P, 0] none.
    """
    is_valid = sound_views(views, rows.voxel_size)
    slots, bricks = sorted_slots(rows, views, is_valid, workers)
    num = bricks.starts[bricks.starts.shape[0] - 1]
    centers, numbers = np.empty((3, num), np.float32), np.empty(num, np.int32)
    _gather_centers(slots, rows, workers, centers, numbers)
    _look_all(
        views, is_valid, layout, rows, bricks, centers, numbers, forms, lattice, workers, means,
        images,
    )  # fmt: skip
