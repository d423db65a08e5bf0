"""Sums of a few views, one after the other, each by all threads.

Every thread splats its share of the voxels into a buffer of its own; the least of all is the
view's, in which every thread then tests and scores its share of those of the sample.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.native.compiled import inlined, kernel, parallel_kernel
from r3jax.kernels.scoring.shown import (
    add_seen_voxels,
    clear,
    count_seen_cells,
    finish_buffer,
    splat,
)
from r3jax.kernels.scoring.terms import ANGLES
from r3jax.kernels.visibility.limit import padded_size
from r3jax.kernels.visibility.picture import picture_size, pyramid_size, side_of
from r3jax.kernels.visibility.splat import SPARE, TARGETS
from r3jax.kernels.visibility.views import CHUNK, PLACED

_ZERO = np.float32(0.0)


@kernel
def _splat_share(view, wraps, shape, voxel_size, runs, voxels, pixels):
    chunk = np.empty(PLACED, np.float32), np.empty(TARGETS, np.int32)
    splat(view, wraps, shape, voxel_size, runs, voxels, chunk, pixels)


@kernel
def _keep_least(pixels, share):
    """Leaves the least over all threads' buffers in the first, in one share of the places."""
    workers, num = pixels.shape
    begin, end = num * share // workers, num * (share + 1) // workers
    least = pixels[0, begin:end]
    for other in range(1, workers):
        own = pixels[other, begin:end]
        for i in range(end - begin):
            least[i] = min(least[i], own[i])


@inlined
def _first_cell(numbers, share, workers):
    """Where a share of the cells begins; cells whose bits lie in one byte stay together."""
    at = numbers.shape[0] * share // workers
    while 0 < at < numbers.shape[0] and numbers[at] >> 3 == numbers[at - 1] >> 3:
        at += 1
    return at


@kernel
def _add_share(
    view, wraps, shape, voxel_size, runs, known, empty, buffer, options, part, sums, counts,
    seen_bits, cell_bits,
):  # fmt: skip
    """Adds up what a view sees of one share of the voxels and cells."""
    nearest, limit = buffer
    _, numbers = empty
    share, workers = part
    placed, pixels = np.empty(PLACED, np.float32), np.empty(TARGETS, np.int32)
    is_seen, chosen = np.empty(CHUNK, np.int32), np.empty(CHUNK + 1, np.int32)
    angles, bins = np.empty(ANGLES, np.float32), np.zeros(CHUNK, np.int32)
    weights = np.empty(CHUNK, np.float32)
    for bin in range(sums.shape[0]):
        sums[bin], counts[bin] = 0.0, _ZERO
    add_seen_voxels(
        view, wraps, shape, voxel_size, runs, known, limit,
        (placed, pixels, is_seen, chosen, angles, bins, weights), options, sums, seen_bits,
    )  # fmt: skip
    own = np.empty((1, 2), np.int64)
    own[0, 0], own[0, 1] = (
        _first_cell(numbers, share, workers), _first_cell(numbers, share + 1, workers),
    )  # fmt: skip
    count_seen_cells(
        view, wraps, shape, empty, own, nearest,
        (placed, is_seen, chosen, angles, bins, weights), options[1], counts, cell_bits,
    )  # fmt: skip


@kernel
def _add_up(sums, found, lacks, counts):
    """Adds up what the threads have found [workers, B]."""
    for bin in range(lacks.shape[0]):
        lack, count = 0.0, _ZERO
        for worker in range(sums.shape[0]):
            lack += sums[worker, bin]
            count += found[worker, bin]
        lacks[bin], counts[bin] = lack, count


# Array expressions stand in kernels of their own: here they would become loops of all threads.
@parallel_kernel
def score_few(
    views, is_sound, wraps, height, width, voxel_size, runs, voxels, own_runs, own_voxels, visited,
    rows, cells, numbers, is_always_one, directions, table, lattice, workers, lacks, counts,
    seen_bits, cell_bits,
):  # fmt: skip
    """Scores views, each by all threads. Flat arguments: Numba's threads take no nested ones."""
    side, num_bins = side_of((height, width)), lacks.shape[1]
    pixels = np.empty((workers, pyramid_size(side) + SPARE), np.float32)
    limit = np.empty(picture_size(side), np.float32)
    padded, slopes = np.empty(padded_size((height, width)), np.float32), np.empty(width, np.float32)
    sums, found = (
        np.empty((workers, num_bins), np.float64),
        np.empty((workers, num_bins), np.float32),
    )
    # Shares as int64: Numba would compile what takes them once more for the loops' own type.
    for i in range(views.shape[0]):
        clear(lacks[i], counts[i], seen_bits[i], cell_bits[i])
        if is_sound[i]:
            for share in prange(workers):
                _splat_share(
                    views[i], wraps, (height, width), voxel_size, runs[share : share + 1], voxels,
                    pixels[share],
                )  # fmt: skip
            for share in prange(workers):
                _keep_least(pixels, np.int64(share))
            finish_buffer(
                views[i], wraps, (height, width), voxel_size, pixels[0], (padded, slopes), limit
            )
            for share in prange(workers):
                _add_share(
                    views[i], wraps, (height, width), voxel_size, own_runs[share : share + 1],
                    (own_voxels, visited, rows), (cells, numbers), (pixels[0], limit),
                    (is_always_one, (directions, table, lattice)), (np.int64(share), workers),
                    sums[share], found[share], seen_bits[i], cell_bits[i],
                )  # fmt: skip
            _add_up(sums, found, lacks[i], counts[i])
