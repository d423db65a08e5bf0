"""Voxels and points, sorted into bricks: those that a view cannot see are skipped by the brick.

The index is rebuilt in every call, by counting: a share of the time of one panorama. For a few
views there is none: points are culled one by one, in the order in which they lie.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from r3jax.geometry.voxels import INDEX_LIMIT
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, kernel, parallel_kernel
from r3jax.kernels.visibility.views import view_at

MAX_VIEWS = 6
"""Up to this many views, building the index costs more than it saves."""

_MARGIN = np.float32(4.0)
"""A voxel so far outside of a view covers none of its pixels; nearer ones appear larger than they
are (`constants.NEAR`) [voxels]."""


EDGE = 3
"""log2 of the voxels along a brick, unless that makes too many bricks."""

MOST = 1 << 19
"""Bricks at most."""

POINTS_EDGE = 0.8
"""Edge of a brick of points [m], unless that makes too many bricks."""


class Bricks(NamedTuple):
    """Items that lie close together stand together."""

    starts: Any
    """Where each brick begins among the items, and their number [b + 1]."""

    spheres: Any
    """Middle and radius of a sphere round each brick [b, 4] [m]."""


_LIMIT = np.int64(INDEX_LIMIT)
_LOW = np.int64((1 << 21) - 1)
_ONE = np.float32(1.0)


@inlined
def voxel_of(key, row):
    """Unpacks the index of the voxel in a row of the map (`geometry.voxels.unpack`)."""
    low, high = np.int64(key[0, row]), np.int64(key[1, row])
    y = (low >> 21) | ((high & 1023) << 11)
    return (low & _LOW) - _LIMIT, y - _LIMIT, ((high >> 10) & _LOW) - _LIMIT


@inlined
def _clipped(value):
    return np.int64(min(max(value, -np.float64(INDEX_LIMIT)), np.float64(INDEX_LIMIT)))


@kernel
def box_of(views, is_valid, voxel_size):
    """Finds the box of voxel indices that the views may see, [2, 3].

    The upper indices are included.
    """
    box = np.empty((2, 3), np.int64)
    box[0], box[1] = _LIMIT, -_LIMIT
    for view in range(is_valid.shape[0]):
        if is_valid[view]:
            for axis in range(3):
                middle, far = np.float64(views.position[view, axis]), views.max_range[view]
                low = _clipped(math.floor((middle - far) / voxel_size) - 1.0)
                high = _clipped(math.floor((middle + far) / voxel_size) + 1.0)
                box[0, axis], box[1, axis] = min(box[0, axis], low), max(box[1, axis], high)
    return box


@inlined
def _brick_of(key, row, box, shift, dims):
    """Finds the brick of a row; -1 outside the box."""
    x, y, z = voxel_of(key, row)
    is_in = (x >= box[0, 0]) & (x <= box[1, 0]) & (y >= box[0, 1]) & (y <= box[1, 1])
    is_in = is_in & (z >= box[0, 2]) & (z <= box[1, 2])
    i, j, k = (x - box[0, 0]) >> shift, (y - box[0, 1]) >> shift, (z - box[0, 2]) >> shift
    return (i * dims[1] + j) * dims[2] + k if is_in else np.int64(-1)


@kernel
def divide(box):
    """Chooses the edge of the bricks (its log2); their number along each axis follows."""
    shift = EDGE
    dims = np.zeros(3, np.int64)
    while True:
        for axis in range(3):
            dims[axis] = max((box[1, axis] - box[0, axis] + (1 << shift)) >> shift, 0)
        if np.float64(dims[0]) * dims[1] * dims[2] <= MOST:
            return shift, dims
        shift += 1


@parallel_kernel
def count_rows(key, count, box, shift, dims, bricks, counts):
    """Finds the brick of every row, -1: none, and counts them, for each share of the rows apart."""
    shares, num = counts.shape[0], count.shape[0]
    for share in prange(shares):
        own = counts[share]
        own[:] = 0
        for row in range(num * share // shares, num * (share + 1) // shares):
            brick = _brick_of(key, row, box, shift, dims) if count[row] > 0.0 else np.int64(-1)
            bricks[row] = brick
            if brick >= 0:
                own[brick] += 1


@kernel
def begin_bricks(counts, starts, bricks):
    """Computes where bricks begin, and where each share of the rows writes.

    Empty bricks are left out.

    Returns:
        The number of bricks that hold something; `bricks` has their numbers.
    """
    total, used = 0, 0
    for brick in range(counts.shape[1]):
        begin = total
        for share in range(counts.shape[0]):
            own = counts[share, brick]
            counts[share, brick] = total
            total += own
        if total > begin:
            starts[used], bricks[used] = begin, brick
            used += 1
    starts[used] = total
    return used


@parallel_kernel
def number_slots(counts, slots):
    """Replaces the brick of every row by its slot, in the order of the map within a brick.

    Slots by row, not rows by slot: rows are then read in memory order.
    """
    shares, num = counts.shape[0], slots.shape[0]
    for share in prange(shares):
        own = counts[share]
        for row in range(num * share // shares, num * (share + 1) // shares):
            brick = slots[row]
            if brick >= 0:
                slots[row] = own[brick]
                own[brick] += 1


@kernel
def spheres_round(bricks, dims, low, edge):
    """Finds spheres round bricks: middle and radius [b, 4] [m].

    Args:
        bricks: their numbers [b].
        dims: bricks along each axis.
        low: where the first one begins along each axis [m].
        edge: of a brick [m].
    """
    spheres = np.empty((bricks.shape[0], 4), np.float32)
    for b in range(bricks.shape[0]):
        i, rest = bricks[b] // (dims[1] * dims[2]), bricks[b] % (dims[1] * dims[2])
        cell = (i, rest // dims[2], rest % dims[2])
        for axis in range(3):
            spheres[b, axis] = low[axis] + (cell[axis] + 0.5) * edge
        # More than half the diagonal: rounding may put a point just outside of its brick.
        spheres[b, 3] = 0.9 * edge
    return spheres


@kernel
def sorted_slots(rows, views, is_valid, workers):
    """Sorts the rows that some view may see into bricks.

    Args:
        rows: of the map.
        views: which.
        is_valid: False for views that see nothing.
        workers: threads.

    Returns:
        The slot of every row [N], -1 for those out of range, and the bricks that share the slots.
    """
    box = box_of(views, is_valid, rows.voxel_size)
    shift, dims = divide(box)
    num_bricks = dims[0] * dims[1] * dims[2]
    counts = np.empty((workers, num_bricks), np.int32)
    slots = np.empty(rows.counts.shape[0], np.int32)
    count_rows(rows.key, rows.counts, box, shift, dims, slots, counts)
    starts, bricks = np.empty(num_bricks + 1, np.int64), np.empty(num_bricks, np.int64)
    used = begin_bricks(counts, starts, bricks)
    number_slots(counts, slots)
    size = np.float64(rows.voxel_size)
    low, edge = size * box[0].astype(np.float64), size * (1 << shift)
    return slots, Bricks(starts[: used + 1], spheres_round(bricks[:used], dims, low, edge))


@kernel
def divide_points(points):
    """Chooses bricks for points [3, n], all of them finite: lower corner, edge [m], numbers."""
    low, high, dims, edge = np.empty(3), np.empty(3), np.empty(3), POINTS_EDGE
    for axis in range(3):
        low[axis] = high[axis] = points[axis, 0]
        for i in range(1, points.shape[1]):
            low[axis] = min(low[axis], points[axis, i])
            high[axis] = max(high[axis], points[axis, i])
    while True:
        for axis in range(3):
            dims[axis] = math.floor((high[axis] - low[axis]) / edge) + 1.0
        if dims[0] * dims[1] * dims[2] <= MOST:
            return low, edge, dims.astype(np.int64)
        edge *= 2.0


@kernel
def are_finite(numbers):
    """Checks whether all numbers [a, b] are finite."""
    found = True
    for i in range(numbers.shape[0]):
        for j in range(numbers.shape[1]):
            found = found and math.isfinite(numbers[i, j])
    return found


@kernel
def sorted_points(points):
    """Sorts points into bricks.

    Args:
        points: x, y and z [3, n] [m].

    Returns:
        The order of the points [n], by brick, as they stand within a brick, and the bricks.
    """
    num = points.shape[1]
    order, slots = np.empty(num, np.int32), np.empty(num, np.int64)
    if num == 0 or not are_finite(points):
        # One brick, that any view may see.
        starts, spheres = np.empty(2, np.int64), np.empty((1, 4), np.float32)
        starts[0], starts[1] = 0, num
        for axis in range(3):
            spheres[0, axis] = 0.0
        spheres[0, 3] = np.inf
        for i in range(num):
            order[i] = i
        return order, Bricks(starts, spheres)
    low, edge, dims = divide_points(points)
    counts = np.zeros((1, dims[0] * dims[1] * dims[2]), np.int32)
    for i in range(num):
        brick = np.int64(0)
        for axis in range(3):
            brick = brick * dims[axis] + np.int64((points[axis, i] - low[axis]) / edge)
        slots[i] = brick
        counts[0, brick] += 1
    starts = np.empty(counts.shape[1] + 1, np.int64)
    bricks = np.empty(counts.shape[1], np.int64)
    used = begin_bricks(counts, starts, bricks)
    for i in range(num):
        order[counts[0, slots[i]]] = i
        counts[0, slots[i]] += 1
    return order, Bricks(starts[: used + 1], spheres_round(bricks[:used], dims, low, edge))


@inlined
def bounds_of(view, layout):
    """Computes the range of a view [m] and the planes that bound it, as `may_see` takes them.

    Each plane by its slope, `along = slope z`, and by how far along a margin reaches.
    """
    left, right = -view.cx / view.fx, (np.float32(layout.width) - view.cx) / view.fx
    top, bottom = -view.cy / view.fy, (np.float32(layout.height) - view.cy) / view.fy
    r = view.rotation
    return (
        layout.wraps, view.max_range, view.position,
        (r[0], r[3], r[6]), (r[1], r[4], r[7]), (r[2], r[5], r[8]), (left, right, top, bottom),
        (_slant(left), _slant(right), _slant(top), _slant(bottom)),
    )  # fmt: skip


@inlined
def _slant(slope):
    return math.sqrt(_ONE + slope * slope)


@inlined
def may_see(bounds, x, y, z, radius, margin):
    """Returns False only if no voxel whose center lies in a sphere can appear in a view.

    Args:
        bounds: of the view.
        x: of the sphere's middle, like the next two [m].
        y: see x.
        z: see x.
        radius: of the sphere [m].
        margin: how far outside of an image a voxel appears in it at that distance [m].
    """
    wraps, far, position, along_x, along_y, along_z, slopes, slants = bounds
    dx, dy, dz = x - position[0], y - position[1], z - position[2]
    reach, wide = far + radius, radius + margin
    is_in_range = dx * dx + dy * dy + dz * dz <= reach * reach
    right = along_x[0] * dx + along_x[1] * dy + along_x[2] * dz
    down = along_y[0] * dx + along_y[1] * dy + along_y[2] * dz
    ahead = along_z[0] * dx + along_z[1] * dy + along_z[2] * dz
    is_between = (right - slopes[0] * ahead >= -wide * slants[0]) & (
        slopes[1] * ahead - right >= -wide * slants[1]
    )
    is_between = is_between & (down - slopes[2] * ahead >= -wide * slants[2])
    is_between = is_between & (slopes[3] * ahead - down >= -wide * slants[3])
    # No branch: loops over voxels become vectors.
    return is_in_range & (wraps | (is_between & (ahead > -wide)))


@kernel
def find_runs(view, layout, voxel_size, bricks, runs):
    """Finds the runs of sorted voxels that may appear in a view; neighbors in memory join.

    Args:
        view: which.
        layout: of it.
        voxel_size: edge [m].
        bricks: of the voxels.
        runs: written; the first voxel and the one after the last of each run [b, 2].

    Returns:
        How many runs there are.
    """
    num, bounds, starts = 0, bounds_of(view, layout), bricks.starts
    for brick in range(bricks.spheres.shape[0]):
        x, y, z, radius = bricks.spheres[brick]
        if may_see(bounds, x, y, z, radius, voxel_size):
            if num > 0 and runs[num - 1, 1] == starts[brick]:
                runs[num - 1, 1] = starts[brick + 1]
            else:
                runs[num, 0], runs[num, 1] = starts[brick], starts[brick + 1]
                num += 1
    return num


@kernel
def _mark_in_view(bounds, voxel_size, x, y, z, is_near):
    """Marks points that may appear in one view."""
    in_wide_vectors()
    margin = _MARGIN * voxel_size
    for i in range(x.shape[0]):
        is_near[i] = np.int32(may_see(bounds, x[i], y[i], z[i], margin, voxel_size)) | is_near[i]


@kernel
def mark_near(views, is_valid, layout, voxel_size, x, y, z, is_near):
    """Marks points [m] that may appear in some view: 1, else 0."""
    for i in range(x.shape[0]):
        is_near[i] = 0
    for view in range(is_valid.shape[0]):
        if is_valid[view]:
            bounds = bounds_of(view_at(views, view), layout)
            _mark_in_view(bounds, voxel_size, x, y, z, is_near)


@inlined
def compact(marks, count, chosen):
    """Writes the indices of all elements that are 1; returns their count."""
    num = 0
    for i in range(count):
        chosen[num] = i
        num += marks[i]
    return num


@kernel
def bricks_of_shares(begins, ends, num):
    """Makes a brick of each range, `begins` to `ends`, that a share has filled.

    Any view may see these bricks. After each of them there is one of the rows that its share did
    not fill, which no view sees.
    """
    num_bricks = 2 * begins.shape[0]
    starts, spheres = np.empty(num_bricks + 1, np.int64), np.zeros((num_bricks, 4), np.float32)
    for share in range(begins.shape[0]):
        starts[2 * share], starts[2 * share + 1] = begins[share], ends[share]
        spheres[2 * share, 3], spheres[2 * share + 1, 3] = np.inf, np.nan
    starts[num_bricks] = num
    return Bricks(starts, spheres)
