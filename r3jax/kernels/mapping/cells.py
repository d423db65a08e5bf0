"""A depth image updates the coarse grid in machine code: `mapping.occupancy.integrate_depth`.

Only cells of the box round the camera's view are looked at, however large the grid is.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.native.arithmetic import floor, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, inlined_fused, kernel

_ZERO, _QUARTER, _HALF = np.float32(0.0), np.float32(0.25), np.float32(0.5)
_ONE, _NEAREST, _INFINITE = np.float32(1.0), np.float32(1e-3), np.float32(np.inf)
_STEP, _DECAY = np.float32(constants.STEP), np.float32(constants.STEP_DECAY)
_LIMIT = np.float32(constants.LOG_ODDS_LIMIT)


@inlined
def _add_row(depth, least, most):
    """Takes the least and the greatest depth of each column, without holes."""
    in_wide_vectors()
    for j in range(depth.shape[0]):
        value = depth[j]
        least[j] = min(least[j], value if value > _ZERO else _INFINITE)
        most[j] = max(most[j], value)


@kernel
def _nearest_by_block(depth, block, rows, columns):
    """Finds the least depth of each block of pixels; 0 where nothing was measured.

    Nothing is before one more at the end.
    """
    height, width = depth.shape
    nearest = np.empty(rows * columns + 1, np.float32)
    nearest[rows * columns] = -_INFINITE
    least, most = np.empty(width, np.float32), np.empty(width, np.float32)
    for i in range(rows):
        for j in range(width):
            least[j], most[j] = _INFINITE, _ZERO
        for row in range(i * block, min((i + 1) * block, height)):
            _add_row(depth[row], least, most)
        for j in range(columns):
            near, far = _INFINITE, _ZERO
            for column in range(j * block, min((j + 1) * block, width)):
                near, far = min(near, least[column]), max(far, most[column])
            nearest[i * columns + j] = near if far > _ZERO else _ZERO
    return nearest


@inlined
def _bounds(frame, origin, size, shape):
    """Finds the first cell of the view's box along each axis, and the first beyond it, [3, 2].

    The view is a pyramid; what it shows lies within its box, widened by a cell for rounding.
    """
    bounds = np.empty((3, 2), np.int64)
    height, width = frame.depth.shape
    T, reach = frame.T_world_camera, np.float64(frame.max_range)
    for axis in range(3):
        low = high = 0.0
        for u in (0, width):
            for v in (0, height):
                x, y = (u - frame.cx) / frame.fx, (v - frame.cy) / frame.fy
                step = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]
                low, high = min(low, step), max(high, step)
        # What is in range is no farther along an axis either. An infinite range times 0 is NaN.
        low = -reach if low < -1.0 else (low * reach if low < 0.0 else 0.0)
        high = reach if high > 1.0 else (high * reach if high > 0.0 else 0.0)
        start = np.float64(T[axis, 3]) - origin[axis]
        first = math.floor((start + low) / size) - 1.0
        last = math.floor((start + high) / size) + 2.0
        bounds[axis, 0] = np.int64(min(max(first, 0.0), shape[axis]))
        bounds[axis, 1] = np.int64(min(max(last, 0.0), shape[axis]))
    return bounds


@inlined_fused
def _cell_along(T, x, y, z, origin, size, first):
    """Finds the cell of a pixel's point along one axis, counted from the first one, as a float."""
    point = (T[0] * x + T[1] * y + T[2]) * z + T[3]
    return floor((point - origin) / size) - first


@inlined_fused
def _hits_of_row(depth, columns, y, frame, origin, size, bounds, none, places):
    """Finds the cell of each pixel of a row, as its place in the box; `none` if it is in none.

    There is no branch, so that LLVM turns the loop into vectors.
    """
    in_wide_vectors()
    T, reach = frame.T_world_camera, frame.max_range * frame.max_range
    T_x = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    T_y = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    T_z = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    at_x, at_y, at_z = np.float32(bounds[0, 0]), np.float32(bounds[1, 0]), np.float32(bounds[2, 0])
    num_x = np.float32(bounds[0, 1] - bounds[0, 0])
    num_y = np.float32(bounds[1, 1] - bounds[1, 0])
    num_z = np.float32(bounds[2, 1] - bounds[2, 0])
    low_x, low_y, low_z, down = origin[0], origin[1], origin[2], np.int32(num_y)
    along, none = np.int32(num_z), np.int32(none)
    for k in range(depth.shape[0]):
        is_measured = (depth[k] > _ZERO) & (depth[k] < _INFINITE)
        # Replaced before the arithmetic: inf times a slope of 0 is NaN.
        x, z = columns[k], depth[k] if is_measured else _ONE
        # Range is straight from the camera's center, depth along its axis.
        is_in = is_measured & (z * z * (x * x + y * y + _ONE) <= reach)
        a = _cell_along(T_x, x, y, z, low_x, size, at_x)
        b = _cell_along(T_y, x, y, z, low_y, size, at_y)
        c = _cell_along(T_z, x, y, z, low_z, size, at_z)
        is_in &= (a >= _ZERO) & (a < num_x) & (b >= _ZERO) & (b < num_y)
        is_in &= (c >= _ZERO) & (c < num_z)
        # Whole only where they are in the box: elsewhere they may be anything.
        a, b, c = a if is_in else _ZERO, b if is_in else _ZERO, c if is_in else _ZERO
        place = np.int32(np.int32(whole(a) * down) + whole(b))
        place = np.int32(np.int32(place * along) + whole(c))
        places[k] = place if is_in else none


@kernel
def _mark_hits(frame, origin, size, bounds):
    """Marks the cells of the box that contain a measured point within range, [n + 1] uint8."""
    depth, none = frame.depth, 1
    height, width = depth.shape
    for axis in range(3):
        none *= bounds[axis, 1] - bounds[axis, 0]
    is_hit = np.zeros(none + 1, np.uint8)
    columns, places = np.empty(width, np.float32), np.empty(width, np.int32)
    for j in range(width):
        columns[j] = (np.float32(j) + _HALF - frame.cx) / frame.fx
    for row in range(height):
        y = (np.float32(row) + _HALF - frame.cy) / frame.fy
        _hits_of_row(depth[row], columns, y, frame, origin, size, bounds, none, places)
        for j in range(width):
            is_hit[np.uint32(places[j])] = 1
    return is_hit


@inlined
def _center(origin, index, offset, size):
    return origin + (np.float32(index) + _HALF + offset) * size


@inlined_fused
def _fill_plane(T, origin, first, offset, size, plane):
    """Computes the part of y and z in the camera's coordinates of some octants' centers.

    Args:
        T: `T_camera_world`.
        origin: lower corner of the grid [m].
        first: first cell of the box.
        offset: of the octant from the cell's center along y and z [cells].
        size: edge of a cell [m].
        plane: filled, [3, Y, Z].
    """
    for j in range(plane.shape[1]):
        y = _center(origin[1], first[1] + j, offset[0], size)
        for k in range(plane.shape[2]):
            z = _center(origin[2], first[2] + k, offset[1], size)
            for axis in range(3):
                plane[axis, j, k] = T[axis, 1] * y + (T[axis, 2] * z + T[axis, 3])


@inlined_fused
def _project_octants(frame, x, plane, shape, block, places, depths):
    """Projects an octant's center of each cell of a plane across x on to a block of pixels.

    There is no branch, so that LLVM turns the loop into vectors.

    Args:
        frame: the image.
        x: coordinate of the octants' centers [m].
        plane: of `_fill_plane`, [3, n].
        shape: blocks along the image's columns and rows.
        block: edge of a block [px].
        places: written: number of the block; one more than there are if not in view or range [n].
        depths: written: z-depth [n].
    """
    in_wide_vectors()
    height, width = frame.depth.shape
    reach, T = frame.max_range * frame.max_range, frame.T_camera_world
    a, b, c = T[0, 0] * x, T[1, 0] * x, T[2, 0] * x
    fx, fy, cx, cy = frame.fx / block, frame.fy / block, frame.cx / block, frame.cy / block
    across, down = np.float32(width) / block, np.float32(height) / block
    last_row, last_column = np.float32(shape[0] - 1), np.float32(shape[1] - 1)
    columns, none = np.int32(shape[1]), np.int32(shape[0] * shape[1])
    for k in range(places.shape[0]):
        x, y, z = a + plane[0, k], b + plane[1, k], c + plane[2, k]
        per_z = _ONE / max(z, _NEAREST)
        u, v = fx * x * per_z + cx, fy * y * per_z + cy
        is_in = (z > _ZERO) & (u >= _ZERO) & (u < across) & (v >= _ZERO) & (v < down)
        is_in &= x * x + y * y + z * z <= reach
        # Into the image before they become whole, whatever they are: masked where they are not in.
        row, column = whole(min(max(v, _ZERO), last_row)), whole(min(max(u, _ZERO), last_column))
        places[k] = np.int32(np.int32(row * columns) + column) if is_in else none
        depths[k] = z


@kernel
def _octants_seen_through(frame, origin, size, first, shape):
    """Counts the octants of each cell of a box whose center was seen through, [X, Y, Z] uint8."""
    block, num = max(1, frame.depth.shape[1] // constants.BLOCKS_ACROSS), shape[1] * shape[2]
    height, width = frame.depth.shape
    blocks = (height + block - 1) // block, (width + block - 1) // block
    walls = _nearest_by_block(frame.depth, block, blocks[0], blocks[1])
    places, depths = np.empty(num, np.int32), np.empty(num, np.float32)
    counts, plane = (
        np.zeros((shape[0], num), np.uint8),
        np.empty((3, shape[1], shape[2]), np.float32),
    )
    for octant in range(4):
        offset = (
            _QUARTER * np.float32((octant & 1) * 2 - 1),
            _QUARTER * np.float32((octant & 2) - 1),
        )
        _fill_plane(frame.T_camera_world, origin, first, offset, size, plane)
        flat = plane.reshape(3, num)
        for i in range(shape[0]):
            for side in (-_QUARTER, _QUARTER):
                x = _center(origin[0], first[0] + i, side, size)
                _project_octants(frame, x, flat, blocks, np.float32(block), places, depths)
                for k in range(num):
                    is_before = depths[k] + _QUARTER * size <= walls[np.uint32(places[k])]
                    counts[i, k] += np.uint8(is_before)
    return counts.reshape(shape)


@inlined_fused
def _update_row(log_odds, hits, counts, frame, center, size):
    """Adds the step of each cell of a row along z to its log-odds; `center` is the first one's."""
    T, reach = frame.T_world_camera, frame.max_range
    x, y = center[0] - T[0, 3], center[1] - T[1, 3]
    for k in range(counts.shape[0]):
        z = center[2] + np.float32(k) * size - T[2, 3]
        # A point within range may lie in a cell whose center is not: its step is that of the range.
        distance = min(math.sqrt(x * x + y * y + z * z), reach)
        step = _STEP * min(max(_ONE - _DECAY * distance, _ZERO), _ONE)
        # A point in a cell outweighs any number of rays through it: matter may be thin.
        change = step if hits[k] else (-step if counts[k] >= constants.PASSED_OCTANTS else _ZERO)
        log_odds[k] = min(max(log_odds[k] + change, -_LIMIT), _LIMIT)


@kernel
def grid_depth(log_odds, origin, size, frame):
    """Updates the cells of a grid that a depth image shows, in place.

    Args:
        log_odds: of the cells [X, Y, Z].
        origin: lower corner of the grid [3] [m].
        size: edge of a cell [m].
        frame: `calls.FrameArrays`; a range that is not positive changes nothing.
    """
    if not frame.max_range > _ZERO:  # or NaN: a pose that is not valid
        return
    bounds = _bounds(frame, origin, size, log_odds.shape)
    x, y, z = bounds[0, 0], bounds[1, 0], bounds[2, 0]
    shape = bounds[0, 1] - x, bounds[1, 1] - y, bounds[2, 1] - z
    if min(shape[0], shape[1], shape[2]) <= 0:
        return
    is_hit = _mark_hits(frame, origin, size, bounds)
    counts = _octants_seen_through(frame, origin, size, (x, y, z), shape)
    for i in range(shape[0]):
        for j in range(shape[1]):
            first = (i * shape[1] + j) * shape[2]
            center = (
                _center(origin[0], x + i, _ZERO, size),
                _center(origin[1], y + j, _ZERO, size),
                _center(origin[2], z, _ZERO, size),
            )
            row = log_odds[x + i, y + j, z : bounds[2, 1]]
            _update_row(row, is_hit[first : first + shape[2]], counts[i, j], frame, center, size)
