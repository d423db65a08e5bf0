"""What one view would show that renders badly, and what is unexplored, summed by direction."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels.mapping.bins import fold, nearest_bin
from r3jax.kernels.native.compiled import (
    in_wide_vectors,
    inlined,
    inlined_fused,
    kernel,
)
from r3jax.kernels.scoring.terms import (
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
)
from r3jax.kernels.visibility.limit import surface_limit
from r3jax.kernels.visibility.picture import (
    begin_of,
    fill_ring,
    push_down,
    side_of,
    stride_of,
)
from r3jax.kernels.visibility.seen import test_corners, test_points
from r3jax.kernels.visibility.splat import find_targets
from r3jax.kernels.visibility.views import (
    CHUNK,
    DISTANCE,
    FOCAL,
    PIXEL_ANGLE,
    POSITION,
    TOLERANCE,
    place,
)

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LEAST = np.float32(1e-6)
_INFINITE = np.float32(np.inf)


@inlined
def splat_chunk(placed, targets, count, pixels):
    """Keeps the nearest distance in every pixel that a chunk's voxels cover."""
    for i in range(count):
        distance = placed[DISTANCE + i]
        for corner in range(4):
            at = np.uint32(targets[corner * CHUNK + i])
            pixels[at] = min(pixels[at], distance)


@kernel
def splat(view, wraps, shape, voxel_size, runs, voxels, chunk, pixels):
    """Keeps the nearest distance in every pixel that voxels cover, each at its level [m].

    Args:
        view: one row.
        wraps: True for an octahedral map.
        shape: height and width [px].
        voxel_size: edge [m].
        runs: of voxels that may be seen, see `find_runs`.
        voxels: see `gather_voxels`.
        chunk: scratch: placement and targets.
        pixels: written; a pyramid (`picture`), not yet pushed down.
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


@kernel
def finish_buffer(view, wraps, shape, voxel_size, pixels, scratch, limit):
    """Completes a splatted pyramid to a depth buffer, and finds how far behind it counts as seen.

    Args:
        view: one row.
        wraps: True for an octahedral map.
        shape: height and width [px].
        voxel_size: edge [m].
        pixels: changed; its finest level becomes the buffer [m].
        scratch: of `surface_limit`.
        limit: written, with its ring [m].
    """
    padded, slopes = scratch
    side = side_of(shape)
    push_down(pixels, side, shape, wraps)
    allowance = view[TOLERANCE] * voxel_size
    surface_limit(pixels, side, shape, view[PIXEL_ANGLE], allowance, padded, slopes, limit)
    fill_ring(limit, begin_of(0, side), stride_of(side), shape, wraps)


@inlined
def _compact(is_seen, count, chosen):
    """Writes the numbers of what is seen; returns how many they are."""
    num = 0
    for i in range(count):
        chosen[num] = i
        num += is_seen[i]
    return num


@inlined_fused
def find_directions(position, points, first, chosen, num, size, angles, cells):
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
def add_by_direction(angles, cells, weights, num, table, lattice, sums):
    """Adds weights to the bins in which directions lie."""
    if sums.shape[0] == 1:
        for j in range(num):
            sums[0] += weights[j]
        return
    for j in range(num):
        x, y, z = angles[TO_X + j], angles[TO_Y + j], angles[TO_Z + j]
        sums[np.uint32(nearest_bin(x, y, z, cells[j], table, lattice))] += weights[j]


@inlined_fused
def find_deficits(known, first, chosen, num, settings, directions, angles, weights):
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
            find_directions(position, voxels, first, chosen, num, size, angles, bins)
            _mark(rows, first, chosen, num, bits)
            find_deficits(
                (voxels, visited), first, chosen, num, settings, directions, angles, weights
            )
            add_by_direction(angles, bins, weights, num, table, lattice, sums)


@kernel
def clear(sums, counts, seen_bits, cell_bits):
    """Sets to 0 what a view's sums and bits are added to.

    In loops, as elsewhere in kernels: a slice that is assigned to takes Numba long to compile.
    """
    for bin in range(sums.shape[0]):
        sums[bin], counts[bin] = 0.0, 0
    for byte in range(seen_bits.shape[0]):
        seen_bits[byte] = 0
    for byte in range(cell_bits.shape[0]):
        cell_bits[byte] = 0


@kernel
def count_seen_cells(view, wraps, shape, empty, runs, nearest, chunk, tables, counts, bits):
    """Counts the unexplored cells of some runs whose center a view sees, one sum for each bin."""
    cells, numbers = empty
    placed, is_seen, chosen, angles, bins, weights = chunk
    _, table, lattice = tables
    side, size = side_of(shape), np.float32(math.sqrt(table.shape[0]))
    position = view[POSITION], view[POSITION + 1], view[POSITION + 2]
    weights[:] = _ONE
    for begin, end in runs:
        for first in range(begin, end, CHUNK):
            count = min(CHUNK, end - first)
            place(view, shape, wraps, cells[X], cells[Y], cells[Z], first, count, placed)
            test_points(placed, count, nearest, side, shape, is_seen)
            num = _compact(is_seen, count, chosen)
            _mark(numbers, first, chosen, num, bits)
            find_directions(position, cells, first, chosen, num, size, angles, bins)
            add_by_direction(angles, bins, weights, num, table, lattice, counts)
