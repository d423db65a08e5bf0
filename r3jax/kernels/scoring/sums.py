"""What views would show that renders badly, and what is unexplored, summed by direction."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels.native.compiled import claim, kernel, parallel_kernel
from r3jax.kernels.scoring.few import score_few
from r3jax.kernels.scoring.near import gather_near
from r3jax.kernels.scoring.shown import (
    add_seen_voxels,
    clear,
    count_seen_cells,
    finish_buffer,
    splat,
)
from r3jax.kernels.scoring.terms import ANGLES
from r3jax.kernels.scoring.voxels import SIZE, gather_voxels
from r3jax.kernels.visibility.bricks import (
    MOST,
    are_finite,
    find_runs,
    sorted_points,
    sorted_slots,
    voxel_of,
)
from r3jax.kernels.visibility.limit import padded_size
from r3jax.kernels.visibility.picture import (
    picture_size,
    pyramid_size,
    side_of,
)
from r3jax.kernels.visibility.splat import SPARE, TARGETS
from r3jax.kernels.visibility.views import (
    CHUNK,
    PLACED,
)

FEW = 4
"""So few views do not pay for bricks: the voxels near them stay in the order of the map."""


@kernel
def sound_views(views, voxel_size):
    """False for views with anything that is not finite, which see nothing."""
    is_sound = np.empty(views.shape[0], np.bool_)
    for i in range(views.shape[0]):
        is_sound[i] = (
            are_finite(views[i : i + 1]) and voxel_size > 0.0 and math.isfinite(voxel_size)
        )
    return is_sound


@kernel
def unexplored_of(cells, unexplored):
    """Gathers the centers of the unexplored cells, [3, k], and their numbers, [k]."""
    num = 0
    for i in range(unexplored.shape[0]):
        num += unexplored[i] != 0
    found, numbers = np.empty((3, num), np.float32), np.empty(num, np.int32)
    num = 0
    for i in range(unexplored.shape[0]):
        if unexplored[i] != 0:
            for axis in range(3):
                found[axis, num] = cells[axis][i]
            numbers[num] = i
            num += 1
    return found, numbers


@kernel
def _score_share(
    next_view, views, is_sound, layout, voxel_size, hiding, scored, empty, options, results
):
    """Scores views until none is left; what is claimed by one thread is left out by the others.

    `hiding`, `scored` and `empty` are bricks of all voxels, of those of the sample, and of cells.
    """
    wraps, shape = layout
    starts, spheres, voxels = hiding
    own_starts, own_spheres, known = scored
    cells, cell_starts, cell_spheres = empty
    lacks, counts, seen_bits, cell_bits = results
    side = side_of(shape)
    placed, targets = np.empty(PLACED, np.float32), np.empty(TARGETS, np.int32)
    is_seen, chosen = np.empty(CHUNK, np.int32), np.empty(CHUNK + 1, np.int32)
    angles, bins = np.empty(ANGLES, np.float32), np.zeros(CHUNK, np.int32)
    weights = np.empty(CHUNK, np.float32)
    nearest, limit = (
        np.empty(pyramid_size(side) + SPARE, np.float32), np.empty(picture_size(side), np.float32),
    )  # fmt: skip
    padded, slopes = np.empty(padded_size(shape), np.float32), np.empty(shape[1], np.float32)
    sums = np.empty(lacks.shape[1], np.float64)
    runs = np.empty((max(spheres.shape[0], cell_spheres.shape[0]), 2), np.int64)
    i = claim(next_view)
    while i < views.shape[0]:
        view = views[i]
        clear(sums, counts[i], seen_bits[i], cell_bits[i])
        if is_sound[i]:
            num = find_runs(view, wraps, shape, voxel_size, starts, spheres, runs)
            splat(view, wraps, shape, voxel_size, runs[:num], voxels, (placed, targets), nearest)
            finish_buffer(view, wraps, shape, voxel_size, nearest, (padded, slopes), limit)
            num = find_runs(view, wraps, shape, voxel_size, own_starts, own_spheres, runs)
            add_seen_voxels(
                view, wraps, shape, voxel_size, runs[:num], known, limit,
                (placed, targets, is_seen, chosen, angles, bins, weights), options, sums,
                seen_bits[i],
            )  # fmt: skip
            num = find_runs(view, wraps, shape, voxel_size, cell_starts, cell_spheres, runs)
            count_seen_cells(
                view, wraps, shape, cells, runs[:num], nearest,
                (placed, is_seen, chosen, angles, bins, weights), options[1], counts[i],
                cell_bits[i],
            )  # fmt: skip
        for bin in range(sums.shape[0]):
            lacks[i, bin] = sums[bin]
        i = claim(next_view)


@parallel_kernel
def score_all(
    views, is_sound, wraps, height, width, voxel_size, starts, spheres, voxels, own_starts,
    own_spheres, own_voxels, visited, rows, cell_starts, cell_spheres, cells, numbers,
    is_always_one, directions, table, lattice, workers, lacks, counts, seen_bits, cell_bits,
):  # fmt: skip
    """Scores views, each by one thread. Flat arguments: Numba's threads take no nested ones."""
    next_view = np.zeros(1, np.int64)
    for _ in prange(workers):
        _score_share(
            next_view, views, is_sound, (wraps, (height, width)), voxel_size,
            (starts, spheres, voxels), (own_starts, own_spheres, (own_voxels, visited, rows)),
            ((cells, numbers), cell_starts, cell_spheres),
            (is_always_one, (directions, table, lattice)), (lacks, counts, seen_bits, cell_bits),
        )  # fmt: skip


@kernel
def sampled(key, count, sample):
    """Observations of the voxels of a sample, 0 of the others (`reference.is_sampled`)."""
    kept = np.empty(count.shape[0], np.float32)
    for row in range(count.shape[0]):
        x, y, z = voxel_of(key, row)
        kept[row] = count[row] if (x + 3 * y + 2 * z) % sample == 0 else 0.0
    return kept


@kernel
def _sorted_voxels(state, count, views, is_sound, is_pairwise, workers):
    """Bricks of the voxels near some views: where they begin, spheres, voxels, visited, rows."""
    key, words, _, m2, resolution, voxel_size = state
    slots, starts, spheres = sorted_slots(key, count, views, is_sound, voxel_size, MOST, workers)
    num = starts[starts.shape[0] - 1]
    voxels, rows = np.empty((SIZE, num), np.float32), np.empty(num, np.int32)
    visited = np.empty(((words.shape[0] + 1) // 2, num), np.uint64)
    gather_voxels(
        slots, starts, key, words, count, m2, resolution, voxel_size, is_pairwise, workers,
        voxels, visited, rows,
    )  # fmt: skip
    return starts, spheres, voxels, visited, rows


@kernel
def _sorted_cells(cells):
    """Bricks of the unexplored cells: centers [3, k], numbers [k], where they begin, spheres."""
    centers, places = unexplored_of(cells[:3], cells[3])
    order, starts, spheres = sorted_points(centers, MOST)
    empty, numbers = np.empty_like(centers), np.empty_like(places)
    for k in range(order.shape[0]):
        numbers[k] = places[order[k]]
        for axis in range(3):
            empty[axis, k] = centers[axis, order[k]]
    return empty, numbers, starts, spheres


@kernel
def sums_of_many(state, cells, views, layout, forms, tables, workers, results):
    """Sums what many views of one map would show; they share an index.

    Args:
        state: key [2, N], visited [W, N], count [N], m2 [N], resolution [N], voxel size [m].
        cells: x, y, z [m] and unexplored [c].
        views: [P, VIEW_SIZE].
        layout: whether views wrap, and height and width of their buffers [px].
        forms: whether kappa is always 1, whether delta is that of pairs, and one of how many
            voxels is scored.
        tables: directions of the voxels' bins [b, 3]; candidates of each octahedral cell
            [S^2, K] and directions of the panorama's bins [B, 3].
        workers: threads.
        results: written; sums of 1 - R [P, B] of the sample, numbers of unexplored cells [P, B],
            and a bit for each row of the sample and each cell that a view sees [P, N / 8],
            [P, c / 8], or [P, 0].
    """
    is_sound, voxel_size = sound_views(views, state[5]), state[5]
    hiding = scored = _sorted_voxels(state, state[2], views, is_sound, forms[1], workers)
    if forms[2] > 1:
        some = sampled(state[0], state[2], forms[2])
        scored = _sorted_voxels(state, some, views, is_sound, forms[1], workers)
    starts, spheres, voxels, _, _ = hiding
    own_starts, own_spheres, own_voxels, visited, rows = scored
    empty, numbers, cell_starts, cell_spheres = _sorted_cells(cells)
    score_all(
        views, is_sound, layout[0], layout[1][0], layout[1][1], voxel_size, starts, spheres,
        voxels, own_starts, own_spheres, own_voxels, visited, rows, cell_starts, cell_spheres,
        empty, numbers, forms[0], tables[0], tables[1], tables[2], workers,
        results[0], results[1], results[2], results[3],
    )  # fmt: skip


@kernel
def _near_voxels(state, count, views, is_sound, layout, is_pairwise, workers):
    """Voxels near some views in the order of the map: runs, voxels, visited, rows."""
    key, words, _, m2, resolution, voxel_size = state
    capacity = count.shape[0]
    # Never filled: the system gives only the pages that are written.
    voxels, rows = np.empty((SIZE, capacity), np.float32), np.empty(capacity, np.int32)
    visited = np.empty(((words.shape[0] + 1) // 2, capacity), np.uint64)
    runs = np.empty((workers, 2), np.int64)
    gather_near(
        views, is_sound, layout[0], layout[1][0], layout[1][1], key, words, count, m2, resolution,
        voxel_size, is_pairwise, workers, voxels, visited, rows, runs,
    )  # fmt: skip
    return runs, voxels, visited, rows


@kernel
def sums_of_few(state, cells, views, layout, forms, tables, workers, results):
    """`sums_of_many` for views that do not pay for an index."""
    is_sound, voxel_size = sound_views(views, state[5]), state[5]
    hiding = scored = _near_voxels(state, state[2], views, is_sound, layout, forms[1], workers)
    if forms[2] > 1:
        some = sampled(state[0], state[2], forms[2])
        scored = _near_voxels(state, some, views, is_sound, layout, forms[1], workers)
    runs, voxels, _, _ = hiding
    own_runs, own_voxels, visited, rows = scored
    empty, numbers = unexplored_of(cells[:3], cells[3])
    score_few(
        views, is_sound, layout[0], layout[1][0], layout[1][1], voxel_size, runs, voxels, own_runs,
        own_voxels, visited, rows, empty, numbers, forms[0], tables[0], tables[1], tables[2],
        workers, results[0], results[1], results[2], results[3],
    )  # fmt: skip
