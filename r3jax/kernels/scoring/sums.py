"""Sums the deficit and the unexplored cells that views would show, by direction."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import fold, nearest_bin
from r3jax.kernels.native.compiled import (
    claim,
    in_wide_vectors,
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
)
from r3jax.kernels.scoring.terms import (
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
from r3jax.kernels.scoring.voxels import (
    DELTA,
    LOG_DELTA,
    RESOLUTION,
    X,
    Y,
    Z,
    near_voxels,
    sorted_voxels,
)
from r3jax.kernels.visibility.bricks import (
    MAX_VIEWS,
    bricks_of_shares,
    compact,
    find_runs,
    mark_near,
    sorted_points,
)
from r3jax.kernels.visibility.picture import (
    SPARE,
    TARGETS,
    begin_of,
    fill_ring,
    find_targets,
    picture_size,
    push_down,
    pyramid_size,
    side_of,
    stride_of,
)
from r3jax.kernels.visibility.seen import padded_size, surface_limit, test_corners, test_points
from r3jax.kernels.visibility.views import CHUNK, DISTANCE, PLACED, place, sound_views, view_at

_ZERO, _ONE, _LEAST = np.float32(0.0), np.float32(1.0), np.float32(1e-6)
_INFINITE = np.float32(np.inf)


class Tables(NamedTuple):
    """Directions and how to find them."""

    directions: Any
    """Of a voxel's bins [b, 3]."""

    table: Any
    """Candidates of each octahedral cell [S^2, K], of the panorama's bins."""

    lattice: Any
    """Directions of the panorama's bins [B, 3]."""


class Sums(NamedTuple):
    """Results of each view."""

    deficits: Any
    """Sums of 1 - R [P, B]."""

    unexplored: Any
    """Numbers of unexplored cells [P, B]."""

    row_bits: Any
    """A bit for each row of the map that is seen [P, N / 8], or [P, 0]."""

    cell_bits: Any
    """A bit for each cell that is seen [P, c / 8], or [P, 0]."""


class Empty(NamedTuple):
    """The unexplored cells, in bricks."""

    centers: Any
    """[3, k] [m]."""

    numbers: Any
    """Of the cells [k]."""


class Scratch(NamedTuple):
    """What a chunk needs while it is worked on."""

    placed: Any
    pixels: Any
    is_seen: Any
    chosen: Any
    angles: Any
    bins: Any
    weights: Any


class Buffer(NamedTuple):
    """A depth buffer, and what it takes to make it."""

    nearest: Any
    """A pyramid (`picture`), whose finest level is the buffer [m]."""

    limit: Any
    """How far voxels are seen in each pixel, with its ring [m]."""

    padded: Any
    slopes: Any


@kernel
def new_scratch():
    """Allocates scratch memory for a chunk."""
    return Scratch(
        np.empty(PLACED, np.float32), np.empty(TARGETS, np.int32), np.empty(CHUNK, np.int32),
        np.empty(CHUNK + 1, np.int32), np.empty(ANGLES, np.float32), np.zeros(CHUNK, np.int32),
        np.empty(CHUNK, np.float32),
    )  # fmt: skip


@kernel
def _new_buffer(layout):
    shape = layout.height, layout.width
    side = side_of(shape)
    return Buffer(
        np.empty(pyramid_size(side) + SPARE, np.float32), np.empty(picture_size(side), np.float32),
        np.empty(padded_size(shape), np.float32), np.empty(layout.width, np.float32),
    )  # fmt: skip


@inlined
def _keep_nearest(placed, targets, count, pixels):
    """Keeps the nearest distance in every pixel that a chunk's voxels cover."""
    for i in range(count):
        distance = placed[DISTANCE + i]
        for corner in range(4):
            at = np.uint32(targets[corner * CHUNK + i])
            pixels[at] = min(pixels[at], distance)


@kernel
def _draw(view, layout, voxel_size, runs, points, scratch, buffer):
    """Draws the depth buffer of a view, and finds how far behind it counts as seen.

    Args:
        view: which.
        layout: of it.
        voxel_size: edge [m].
        runs: of voxels that may be seen, see `find_runs`.
        points: their centers, [3, n] at least [m].
        scratch: of a chunk.
        buffer: written.
    """
    shape = layout.height, layout.width
    side, nearest = side_of(shape), buffer.nearest
    nearest[:] = _INFINITE
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, layout, points, first, count, scratch.placed)
            find_targets(scratch.placed, count, voxel_size, side, scratch.pixels)
            _keep_nearest(scratch.placed, scratch.pixels, count, nearest)
    push_down(nearest, side, shape, layout.wraps)
    surface_limit(
        nearest, side, shape, view.pixel_angle, view.tolerance * voxel_size, buffer.padded,
        buffer.slopes, buffer.limit,
    )  # fmt: skip
    fill_ring(buffer.limit, begin_of(0, side), stride_of(side), shape, layout.wraps)


@inlined_fused
def find_directions(position, points, first, num, size, scratch):
    """Finds unit vectors from a position to chosen points, distances, and octahedral cells."""
    in_wide_vectors()
    x, y, z = position
    angles, chosen, cells = scratch.angles, scratch.chosen, scratch.bins
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
def add_by_direction(scratch, num, tables, sums):
    """Adds weights to the bins in which directions lie."""
    angles, weights = scratch.angles, scratch.weights
    if sums.shape[0] == 1:
        for j in range(num):
            sums[0] += weights[j]
        return
    for j in range(num):
        x, y, z = angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
        bin = nearest_bin(x, y, z, scratch.bins[j], tables.table, tables.lattice)
        sums[np.uint32(bin)] += weights[j]


@inlined_fused
def find_deficits(voxels, first, num, is_kappa_one, focal, directions, scratch, deficits):
    """Finds 1 - R of chosen voxels."""
    in_wide_vectors()
    known, angles = voxels.known, scratch.angles
    for j in range(num):
        at = first + np.int64(scratch.chosen[j])
        from_voxel = -angles[TO_X + j], -angles[TO_Y + j], -angles[TO_Z + j]
        cosine, is_inside = look_from(voxels.visited, at, directions, from_voxel)
        deficits[j], angles[INSIDE + j] = cosine, np.float32(is_inside | is_kappa_one)
        angles[DELTAS + j], angles[LOG_DELTAS + j] = known[DELTA, at], known[LOG_DELTA, at]
        angles[SHARPNESS + j] = known[RESOLUTION, at]
    for j in range(num):
        deficits[j] = _ONE - product_of_terms(
            deficits[j], angles[INSIDE + j] > _ZERO, angles[RANGE + j], angles[DELTAS + j],
            angles[LOG_DELTAS + j], angles[SHARPNESS + j], focal,
        )  # fmt: skip


@inlined
def _mark(items, first, chosen, num, bits):
    """Sets the bits of chosen items, the first of eight highest; no room: none is wanted."""
    if bits.shape[0] > 0:
        for j in range(num):
            item = np.int64(items[first + np.int64(chosen[j])])
            bits[item >> 3] |= np.uint8(128 >> (item & 7))


@kernel
def _add_voxels(
    view, layout, voxel_size, runs, voxels, limit, is_kappa_one, tables, scratch, sums, bits
):
    """Adds up 1 - R of the voxels of some runs that a view sees, and sets their rows' bits."""
    shape = layout.height, layout.width
    side, size = side_of(shape), np.float32(math.sqrt(tables.table.shape[0]))
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, layout, voxels.known, first, count, scratch.placed)
            test_corners(
                scratch.placed, count, voxel_size, limit, side, shape, scratch.pixels,
                scratch.is_seen,
            )  # fmt: skip
            num = compact(scratch.is_seen, count, scratch.chosen)
            find_directions(view.position, voxels.known, first, num, size, scratch)
            _mark(voxels.rows, first, scratch.chosen, num, bits)
            find_deficits(
                voxels, first, num, is_kappa_one, view.focal, tables.directions, scratch,
                scratch.weights,
            )  # fmt: skip
            add_by_direction(scratch, num, tables, sums)


@kernel
def _count_cells(view, layout, runs, empty, nearest, tables, scratch, counts, bits):
    """Counts the unexplored cells of some runs whose centers a view sees, and sets their bits."""
    shape = layout.height, layout.width
    side, size = side_of(shape), np.float32(math.sqrt(tables.table.shape[0]))
    scratch.weights[:] = _ONE
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, layout, empty.centers, first, count, scratch.placed)
            test_points(scratch.placed, count, nearest, side, shape, scratch.is_seen)
            num = compact(scratch.is_seen, count, scratch.chosen)
            _mark(empty.numbers, first, scratch.chosen, num, bits)
            find_directions(view.position, empty.centers, first, num, size, scratch)
            add_by_direction(scratch, num, tables, counts)


@kernel
def _clear(view_sums, counts, row_bits, cell_bits):
    """Sets to 0 what a view's sums and bits are added to.

    In loops, as elsewhere in kernels: a slice that is assigned to takes Numba long to compile.
    """
    for bin in range(view_sums.shape[0]):
        view_sums[bin], counts[bin] = 0.0, 0
    for byte in range(row_bits.shape[0]):
        row_bits[byte] = 0
    for byte in range(cell_bits.shape[0]):
        cell_bits[byte] = 0


@kernel
def unexplored_of(cells):
    """Gathers the unexplored cells."""
    num = 0
    for i in range(cells.unexplored.shape[0]):
        num += cells.unexplored[i] != 0
    centers, numbers = np.empty((3, num), np.float32), np.empty(num, np.int32)
    num = 0
    for i in range(cells.unexplored.shape[0]):
        if cells.unexplored[i] != 0:
            centers[X, num], centers[Y, num] = cells.x[i], cells.y[i]
            centers[Z, num], numbers[num] = cells.z[i], i
            num += 1
    return Empty(centers, numbers)


@kernel
def _sorted_cells(cells):
    """Sorts the unexplored cells into bricks."""
    found = unexplored_of(cells)
    order, bricks = sorted_points(found.centers)
    empty = Empty(np.empty_like(found.centers), np.empty_like(found.numbers))
    for k in range(order.shape[0]):
        empty.numbers[k] = found.numbers[order[k]]
        for axis in range(3):
            empty.centers[axis, k] = found.centers[axis, order[k]]
    return bricks, empty


@kernel
def _near_cells(cells, views, is_valid, layout, voxel_size):
    """Gathers the unexplored cells that some of a few views may show, in order, in one brick."""
    num = cells.unexplored.shape[0]
    empty = Empty(np.empty((3, num), np.float32), np.empty(num, np.int32))
    is_near, chosen, to = np.empty(CHUNK, np.int32), np.empty(CHUNK + 1, np.int32), 0
    for first in range(0, num, CHUNK):
        end = min(first + CHUNK, num)
        x, y, z = cells.x[first:end], cells.y[first:end], cells.z[first:end]
        mark_near(views, is_valid, layout, voxel_size, x, y, z, is_near)
        for i in range(end - first):
            is_near[i] &= np.int32(cells.unexplored[first + i] != 0)
        for j in range(compact(is_near, end - first, chosen)):
            i = np.int64(chosen[j])
            empty.centers[X, to], empty.centers[Y, to], empty.centers[Z, to] = x[i], y[i], z[i]
            empty.numbers[to] = first + i
            to += 1
    begins, ends = np.zeros(1, np.int64), np.full(1, to, np.int64)
    return bricks_of_shares(begins, ends, num), empty


@kernel
def _sum_share(
    next_view, views, is_valid, layout, voxel_size, bricks, voxels, cell_bricks, empty,
    is_kappa_one, tables, results,
):  # fmt: skip
    """Sums over one view after the other until none is left to claim."""
    scratch, buffer = new_scratch(), _new_buffer(layout)
    sums = np.empty(results.deficits.shape[1], np.float64)
    most = max(bricks.spheres.shape[0], cell_bricks.spheres.shape[0])
    runs = np.empty((most, 2), np.int64)
    i = claim(next_view)
    while i < is_valid.shape[0]:
        counts, row_bits = results.unexplored[i], results.row_bits[i]
        cell_bits = results.cell_bits[i]
        _clear(sums, counts, row_bits, cell_bits)
        if is_valid[i]:
            view = view_at(views, i)
            num = find_runs(view, layout, voxel_size, bricks, runs)
            _draw(view, layout, voxel_size, runs[:num], voxels.known, scratch, buffer)
            _add_voxels(
                view, layout, voxel_size, runs[:num], voxels, buffer.limit, is_kappa_one, tables,
                scratch, sums, row_bits,
            )  # fmt: skip
            num = find_runs(view, layout, voxel_size, cell_bricks, runs)
            _count_cells(
                view, layout, runs[:num], empty, buffer.nearest, tables, scratch, counts, cell_bits
            )
        for bin in range(sums.shape[0]):
            results.deficits[i, bin] = sums[bin]
        i = claim(next_view)


@parallel_kernel
def _sum_all(
    views, is_valid, layout, voxel_size, bricks, voxels, cell_bricks, empty, is_kappa_one, tables,
    workers, results,
):  # fmt: skip
    next_view = np.zeros(1, np.int64)
    for _ in prange(workers):
        _sum_share(
            next_view, views, is_valid, layout, voxel_size, bricks, voxels, cell_bricks, empty,
            is_kappa_one, tables, results,
        )  # fmt: skip


@kernel
def sums(rows, cells, views, layout, forms, tables, workers, results):
    """Sums what views of one map would show; many share an index, few need none.

    Args:
        rows: of the map, `calls.MapRows`.
        cells: of the grid, `calls.Cells`.
        views: `calls.Views`.
        layout: `calls.Layout`.
        forms: `Choices` of R.
        tables: of the voxels' and the panorama's bins.
        workers: threads; each takes one view after the other.
        results: written, `Sums`.
    """
    is_valid = sound_views(views, rows.voxel_size)
    if is_valid.shape[0] <= MAX_VIEWS:
        bricks, voxels = near_voxels(rows, views, is_valid, layout, forms, workers)
        cell_bricks, empty = _near_cells(cells, views, is_valid, layout, rows.voxel_size)
    else:
        bricks, voxels = sorted_voxels(rows, views, is_valid, forms, workers)
        cell_bricks, empty = _sorted_cells(cells)
    _sum_all(
        views, is_valid, layout, rows.voxel_size, bricks, voxels, cell_bricks, empty,
        forms.is_kappa_one, tables, workers, results,
    )  # fmt: skip
