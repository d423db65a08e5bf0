"""What views would show that renders badly, and what is unexplored, summed by direction."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.mapping.backends.numba.bins import fold, nearest_bin
from r3jax.native.compiled import (
    claim,
    in_wide_vectors,
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
)
from r3jax.scoring.backends.numba.terms import (
    ANGLES,
    DELTAS,
    INSIDE,
    LOG_DELTAS,
    RANGE,
    SHARPNESS,
    TO_X,
    TO_Y,
    TO_Z,
    look_from,
    product_of_terms,
)
from r3jax.scoring.backends.numba.voxels import (
    DELTA,
    LOG_DELTA,
    RESOLUTION,
    SIZE,
    X,
    Y,
    Z,
    gather_voxels,
)
from r3jax.visibility.backends.numba.bricks import MOST, find_runs, sorted_slots
from r3jax.visibility.backends.numba.limit import padded_size, surface_limit
from r3jax.visibility.backends.numba.picture import (
    begin_of,
    fill_ring,
    picture_size,
    push_down,
    pyramid_size,
    side_of,
    stride_of,
)
from r3jax.visibility.backends.numba.seen import test_corners, test_points
from r3jax.visibility.backends.numba.splat import SPARE, TARGETS, find_targets
from r3jax.visibility.backends.numba.views import (
    CHUNK,
    DISTANCE,
    FOCAL,
    PIXEL_ANGLE,
    PLACED,
    POSITION,
    TOLERANCE,
    place,
)

FEW = 4
"""So few views do not pay for bricks: the voxels near them stay in the order of the map."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LEAST, _TINY = np.float32(1e-6), np.float32(1e-20)
_INFINITE = np.float32(np.inf)


@kernel
def sound_views(views, voxel_size):
    """False for views with anything that is not finite, which see nothing."""
    is_sound = np.empty(views.shape[0], np.bool_)
    for i in range(views.shape[0]):
        is_sound[i] = np.isfinite(views[i]).all() and voxel_size > 0.0 and np.isfinite(voxel_size)
    return is_sound


@inlined
def splat_chunk(placed, targets, count, pixels):
    """Keeps the nearest distance in every pixel that a chunk's voxels cover."""
    for i in range(count):
        distance = placed[DISTANCE + i]
        for corner in range(4):
            at = np.uint32(targets[corner * CHUNK + i])
            pixels[at] = min(pixels[at], distance)


@kernel
def nearest_distance(view, wraps, shape, voxel_size, runs, voxels, chunk, pixels):
    """Finds the distance of the nearest voxel in every pixel [m].

    Args:
        view: one row.
        wraps: True for an octahedral map.
        shape: height and width [px].
        voxel_size: edge [m].
        runs: of voxels that may be seen, see `find_runs`.
        voxels: see `gather_voxels`.
        chunk: scratch: placement and targets.
        pixels: written; a pyramid (`picture`), whose finest level is the answer.
    """
    placed, targets = chunk
    side = side_of(shape)
    pixels[:] = _INFINITE
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, shape, wraps, voxels[X], voxels[Y], voxels[Z], first, count, placed)
            find_targets(placed, count, voxel_size, side, targets)
            splat_chunk(placed, targets, count, pixels)
    push_down(pixels, side, shape, wraps)


@inlined
def _compact(is_seen, count, chosen):
    """Writes the numbers of what is seen; returns how many they are."""
    num = 0
    for i in range(count):
        chosen[num] = i
        num += is_seen[i]
    return num


@inlined_fused
def _find_directions(position, points, first, chosen, num, size, angles, cells):
    """Finds unit vectors from a position to chosen points, distances, and octahedral cells."""
    in_wide_vectors()
    x, y, z = position
    # Gathered by themselves, so that LLVM vectorizes the arithmetic.
    for j in range(num):
        at = first + np.int64(chosen[j])
        angles[TO_X + j], angles[TO_Y + j] = points[X, at], points[Y, at]
        angles[TO_Z + j] = points[Z, at]
    for j in range(num):
        dx, dy, dz = angles[TO_X + j] - x, angles[TO_Y + j] - y, angles[TO_Z + j] - z
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
        inverse = _ONE / distance
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j] = dx, dy, dz
        angles[RANGE + j] = distance
        cells[j] = fold(dx, dy, dz, size)


@inlined_fused
def _add_by_direction(angles, cells, weights, num, table, lattice, sums):
    """Adds weights to the bins in which directions lie."""
    if sums.shape[0] == 1:
        for j in range(num):
            sums[0] += weights[j]
        return
    for j in range(num):
        x, y, z = angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
        sums[np.uint32(nearest_bin(x, y, z, cells[j], table, lattice))] += weights[j]


@inlined_fused
def _find_deficits(known, first, chosen, num, settings, directions, angles, weights):
    """Finds 1 - R of chosen voxels."""
    in_wide_vectors()
    voxels, visited = known
    is_always_one, focal = settings
    for j in range(num):
        at = first + np.int64(chosen[j])
        from_voxel = -angles[TO_X + j], -angles[TO_Y + j], -angles[TO_Z + j]
        cosine, is_inside = look_from(visited, at, directions, from_voxel)
        weights[j], angles[INSIDE + j] = cosine, np.float32(is_inside | is_always_one)
        angles[DELTAS + j], angles[LOG_DELTAS + j] = voxels[DELTA, at], voxels[LOG_DELTA, at]
        angles[SHARPNESS + j] = voxels[RESOLUTION, at]
    for j in range(num):
        weights[j] = _ONE - product_of_terms(
            weights[j], angles[INSIDE + j] > _ZERO, angles[RANGE + j], angles[DELTAS + j],
            angles[LOG_DELTAS + j], angles[SHARPNESS + j], focal,
        )  # fmt: skip


@inlined
def _mark(items, first, chosen, num, bits):
    """Sets the bits of chosen items, the first of eight highest; no room: none is asked for."""
    if bits.shape[0] > 0:
        for j in range(num):
            item = np.int64(items[first + np.int64(chosen[j])])
            bits[item >> 3] |= np.uint8(128 >> (item & 7))


@kernel
def add_seen_voxels(view, wraps, shape, voxel_size, runs, known, limit, chunk, options, sums, bits):
    """Adds up 1 - R of the voxels that a view sees.

    Args:
        view: one row.
        wraps: True for an octahedral map.
        shape: height and width [px].
        voxel_size: edge [m].
        runs: of voxels that may be seen, see `find_runs`.
        known: voxels and visited, see `gather_voxels`, and the voxels' rows in the map.
        limit: of the view [m].
        chunk: scratch.
        options: whether kappa is always 1, then the tables of directions.
        sums: added to, one for each bin.
        bits: set for the rows of the map that are seen.
    """
    voxels, visited, rows = known
    placed, pixels, is_seen, chosen, angles, bins, weights = chunk
    directions, table, lattice = options[1]
    side, size = side_of(shape), np.float32(math.sqrt(table.shape[0]))
    settings = options[0], view[FOCAL]
    position = view[POSITION], view[POSITION + 1], view[POSITION + 2]
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, shape, wraps, voxels[X], voxels[Y], voxels[Z], first, count, placed)
            test_corners(placed, count, voxel_size, limit, side, shape, pixels, is_seen)
            num = _compact(is_seen, count, chosen)
            _find_directions(position, voxels, first, chosen, num, size, angles, bins)
            _mark(rows, first, chosen, num, bits)
            _find_deficits(
                (voxels, visited), first, chosen, num, settings, directions, angles, weights
            )
            _add_by_direction(angles, bins, weights, num, table, lattice, sums)


@kernel
def count_seen_cells(view, wraps, shape, empty, nearest, chunk, tables, counts, bits):
    """Counts the unexplored cells whose center a view sees, one sum for each bin."""
    cells, numbers = empty
    placed, is_seen, chosen, angles, bins, weights = chunk
    _, table, lattice = tables
    side, size = side_of(shape), np.float32(math.sqrt(table.shape[0]))
    position = view[POSITION], view[POSITION + 1], view[POSITION + 2]
    weights[:] = _ONE
    for first in range(0, cells.shape[1], CHUNK):
        count = min(CHUNK, cells.shape[1] - first)
        place(view, shape, wraps, cells[X], cells[Y], cells[Z], first, count, placed)
        test_points(placed, count, nearest, side, shape, is_seen)
        num = _compact(is_seen, count, chosen)
        _mark(numbers, first, chosen, num, bits)
        _find_directions(position, cells, first, chosen, num, size, angles, bins)
        _add_by_direction(angles, bins, weights, num, table, lattice, counts)


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
    next_view, views, is_sound, layout, voxel_size, index, known, empty, options, results
):
    """Scores views until none is left; what is claimed by one thread is left out by the others."""
    wraps, shape = layout
    starts, spheres = index
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
    sums, runs = np.empty(lacks.shape[1], np.float64), np.empty((spheres.shape[0], 2), np.int64)
    i = claim(next_view)
    while i < views.shape[0]:
        view = views[i]
        sums[:], counts[i], seen_bits[i], cell_bits[i] = 0.0, 0.0, 0, 0
        if is_sound[i]:
            num = find_runs(view, wraps, shape, voxel_size, starts, spheres, runs)
            nearest_distance(
                view, wraps, shape, voxel_size, runs[:num], known[0], (placed, targets), nearest
            )
            allowance = view[TOLERANCE] * voxel_size
            surface_limit(nearest, side, shape, view[PIXEL_ANGLE], allowance, padded, slopes, limit)
            fill_ring(limit, begin_of(0, side), stride_of(side), shape, wraps)
            add_seen_voxels(
                view, wraps, shape, voxel_size, runs[:num], known, limit,
                (placed, targets, is_seen, chosen, angles, bins, weights), options, sums,
                seen_bits[i],
            )  # fmt: skip
            count_seen_cells(
                view, wraps, shape, empty, nearest,
                (placed, is_seen, chosen, angles, bins, weights), options[1], counts[i],
                cell_bits[i],
            )  # fmt: skip
        lacks[i] = sums
        i = claim(next_view)


@parallel_kernel
def score_all(
    views, is_sound, wraps, height, width, voxel_size, starts, spheres, voxels, visited, rows,
    cells, numbers, is_always_one, directions, table, lattice, workers, lacks, counts, seen_bits,
    cell_bits,
):  # fmt: skip
    """Scores views, each by one thread. Flat arguments: Numba's threads take no nested ones."""
    next_view = np.zeros(1, np.int64)
    for _ in prange(workers):
        _score_share(
            next_view, views, is_sound, (wraps, (height, width)), voxel_size, (starts, spheres),
            (voxels, visited, rows), (cells, numbers),
            (is_always_one, (directions, table, lattice)), (lacks, counts, seen_bits, cell_bits),
        )  # fmt: skip


@kernel
def sums_pass(state, cells, views, layout, forms, tables, workers, results):
    """Sums what many views of one map would show.

    Args:
        state: key [2, N], visited [W, N], count [N], m2 [N], resolution [N], voxel size [m].
        cells: x, y, z [m] and unexplored [c].
        views: [P, VIEW_SIZE].
        layout: whether views wrap, and height and width of their buffers [px].
        forms: whether kappa is always 1, whether delta is that of pairs.
        tables: directions of the voxels' bins [b, 3]; candidates of each octahedral cell
            [S^2, K] and directions of the panorama's bins [B, 3].
        workers: threads.
        results: written; sums of 1 - R [P, B], numbers of unexplored cells [P, B], and a bit for
            each row of the map and each cell that a view sees [P, N / 8], [P, c / 8], or [P, 0].
    """
    key, words, count, m2, resolution, voxel_size = state
    is_sound = sound_views(views, voxel_size)
    most = 1 if views.shape[0] <= FEW else MOST
    slots, starts, spheres = sorted_slots(key, count, views, is_sound, voxel_size, most, workers)
    num = starts[starts.shape[0] - 1]
    voxels, rows = np.empty((SIZE, num), np.float32), np.empty(num, np.int32)
    visited = np.empty(((words.shape[0] + 1) // 2, num), np.uint64)
    gather_voxels(
        slots, starts, key, words, count, m2, resolution, voxel_size, forms[1], workers,
        voxels, visited, rows,
    )  # fmt: skip
    empty, numbers = unexplored_of(cells[:3], cells[3])
    score_all(
        views, is_sound, layout[0], layout[1][0], layout[1][1], voxel_size, starts, spheres,
        voxels, visited, rows, empty, numbers, forms[0], tables[0], tables[1], tables[2], workers,
        results[0], results[1], results[2], results[3],
    )  # fmt: skip
