"""Voxels in a frame's view: `mapping.seen` and `mapping.moved.count_misses` in machine code.

One pass over the rows lists those in view; of these it removes the voxels that the frame sees
through, and sets the direction bins of those that it shows.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.kernels import constants
from r3jax.kernels.mapping.bins import camera_of, center_of, is_valid, mark_rows
from r3jax.kernels.native.arithmetic import whole
from r3jax.kernels.native.compiled import (
    in_wide_vectors,
    inlined,
    inlined_fused,
    kernel,
    parallel_kernel,
    prefetch,
)

_FEW = np.float32(constants.FEW_OBSERVATIONS)
_SLACK, _NOISE = np.float32(constants.SLACK_EDGES), np.float32(constants.SLACK_NOISE)
_HALF_DIAGONAL = np.float32(constants.HALF_DIAGONAL)
_SHARE, _LEAST = np.float32(constants.NEAR_ENOUGH), np.float32(constants.LEAST_FOOTPRINT)


_BLOCK = 1 << 12
"""Rows that a worker looks at before it takes the next."""

_AHEAD = 16
"""Prefetch distance [rows]: their pixels lie anywhere in memory."""

_EMPTY = np.uint32(EMPTY_WORD)
_ZERO, _ONE, _NEAREST = np.float32(0.0), np.float32(1.0), np.float32(1e-3)


@inlined_fused
def _along(T, axis, center):
    """Computes one coordinate of a point in the camera's frame."""
    along = T[axis, 0] * center[0] + T[axis, 1] * center[1]
    return along + T[axis, 2] * center[2] + T[axis, 3]


@inlined_fused
def _farthest_around(depth, row, column):
    """Finds the largest depth of a pixel and its neighbors.

    On a slope the depth changes within a pixel.
    """
    farthest = _ZERO
    for i in range(max(row - 1, 0), min(row + 2, depth.shape[0])):
        for j in range(max(column - 1, 0), min(column + 2, depth.shape[1])):
            farthest = max(farthest, depth[i, j])
    return farthest


@inlined_fused
def _project(key, first, num, frame, voxel_size, pixels, depths):
    """Projects each row from `first` on to its pixel and z-depth; -1 out of the image or range.

    There is no branch, so that LLVM turns the loop into vectors: most rows end here.
    """
    in_wide_vectors()
    shape, T = frame.depth.shape, frame.T_camera_world
    height, width = np.float32(shape[0]), np.float32(shape[1])
    last_row, last_column = height - _ONE, width - _ONE
    reach = frame.max_range * frame.max_range
    fx, fy, cx, cy = frame.fx, frame.fy, frame.cx, frame.cy
    for i in range(num):
        center = center_of(key, first + i, voxel_size)
        z = _along(T, 2, center)
        x, y = _along(T, 0, center), _along(T, 1, center)
        per_z = _ONE / z
        u = fx * x * per_z + cx
        v = fy * y * per_z + cy
        is_in = (z > _NEAREST) & (u >= _ZERO) & (u < width) & (v >= _ZERO) & (v < height)
        # Straight from the camera, as the grid and the scores have it; depth alone is along the
        # axis.
        is_in &= x * x + y * y + z * z <= reach
        is_in &= key[1, first + i] != _EMPTY
        # Into the image before they become whole, whatever they are: masked where they are not in.
        row, column = whole(min(max(v, _ZERO), last_row)), whole(min(max(u, _ZERO), last_column))
        pixels[i] = np.int32(np.int32(row * np.int32(shape[1])) + column) if is_in else np.int32(-1)
        depths[i] = z


@inlined_fused
def _list_in_view(key, first, num, frame, voxel_size, pixels, depths, seen):
    """Projects rows from `first` on and lists those in view in `seen`; returns their number."""
    _project(key, first, num, frame, voxel_size, pixels, depths)
    # Without a branch: whether a row is in view is often mispredicted.
    count = 0
    for i in range(num):
        seen[count] = i
        count += pixels[i] >= 0
    return count


@inlined_fused
def _is_shown(pixel, measured, z, depth, slack, is_visible):
    """Checks whether a frame shows a row that lies in one of its pixels."""
    if measured == _ZERO:
        return is_visible  # a hole
    if not measured > _ZERO:
        return False
    # One edge of slack: a surface may lie anywhere within its voxel. Mostly the pixel itself says
    # so, which is farther than none of those around it.
    if z <= measured + slack:
        return True
    row, column = pixel // depth.shape[1], pixel % depth.shape[1]
    return z <= _farthest_around(depth, row, column) + slack


@inlined
def _is_camera(frame, camera):
    """Checks that the intrinsics and the pose are valid."""
    total = frame.fx + frame.fy + frame.cx + frame.cy
    for axis in range(3):
        for k in range(4):
            total += frame.T_camera_world[axis, k]
    return math.isfinite(total) & is_valid(camera)


@inlined_fused
def _is_open(depth, pixel, z, focal, size, slack):
    """Checks whether most pixels of a voxel's footprint see through it, and none shows it."""
    height, width = depth.shape
    half = np.int64(math.ceil(focal * _HALF_DIAGONAL * size / z)) + 1
    step = 1 + 2 * half // constants.MOST_SAMPLES
    row, column, near, limit = pixel // width, pixel % width, z - slack, z + slack
    total, beyond = 0, 0
    for i in range(row - half, row + half + 1, step):
        for j in range(column - half, column + half + 1, step):
            total += 1
            if i < 0 or j < 0 or i >= height or j >= width:
                continue
            measured = depth[i, j]
            if measured > limit:
                beyond += 1
            elif not (_ZERO < measured < near):
                return False
    return 2 * beyond > total


@inlined_fused
def _miss(rows, mean, misses, row, pixel, z, frame):
    """Counts a look through a voxel in view; removes one that was looked through often."""
    depth, size, counts = frame.depth, rows.voxel_size, rows.counts
    slack = _SLACK * size + _NOISE * z
    measured = depth[pixel // depth.shape[1], pixel % depth.shape[1]]
    if measured == _ZERO or measured < z - slack or counts[row] == _ZERO:
        return
    if measured <= z + slack:
        misses[row] = 0
        return
    sharpness = frame.focal / z
    if sharpness < _SHARE * rows.resolution[row] or sharpness * size < _LEAST:
        return
    if not _is_open(depth, pixel, z, max(frame.fx, frame.fy), size, slack):
        return
    misses[row] += 1
    if misses[row] >= (constants.MISSES_OF_FEW if counts[row] <= _FEW else constants.MISSES):
        misses[row] = 0
        counts[row], rows.m2[row] = _ZERO, _ZERO
        for channel in range(3):
            mean[channel, row] = _ZERO


@kernel
def map_look(rows, mean, misses, frame, is_visible, bins, lattice, workers):
    """Removes the rows that a frame sees through, marks those that it shows, in place.

    Args:
        rows: of the map, `calls.MapRows`.
        mean: colors [3, N].
        misses: looks through each row since it was last measured [N]; [0]: nothing is removed.
        frame: `calls.FrameArrays`.
        is_visible: 1 where no other voxel hides a row [N].
        bins: candidates of each octahedral cell [S^2, K].
        lattice: directions of the bins [B, 3].
        workers: threads.
    """
    camera = camera_of(frame, rows.voxel_size)
    if _is_camera(frame, camera):
        _look_at_all(rows, mean, misses, camera, frame, is_visible, bins, lattice, workers)


@parallel_kernel
def _look_at_all(rows, mean, misses, camera, frame, is_visible, bins, lattice, workers):
    depth, key, voxel_size = frame.depth, rows.key, rows.voxel_size
    capacity, removes = key.shape[1], misses.shape[0] > 0
    flat, blocks = depth.reshape(depth.size), (capacity + _BLOCK - 1) // _BLOCK
    for worker in prange(workers):
        pixels, depths = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.float32)
        seen, visible = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.int64)
        for block in range(worker, blocks, workers):
            first, size = block * _BLOCK, min(_BLOCK, capacity - block * _BLOCK)
            num = _list_in_view(key, first, size, frame, voxel_size, pixels, depths, seen)
            count = 0
            for k in range(num):
                if k + _AHEAD < num:
                    prefetch(flat, np.int64(pixels[seen[k + _AHEAD]]))
                i = np.int64(seen[k])
                row, pixel = first + i, np.int64(pixels[i])
                if removes:
                    _miss(rows, mean, misses, row, pixel, depths[i], frame)
                visible[count] = row
                count += _is_shown(
                    pixel, flat[pixel], depths[i], depth, voxel_size, is_visible[row] != 0
                )
            mark_rows(key, rows.visited, rows.resolution, visible, count, camera, bins, lattice)
