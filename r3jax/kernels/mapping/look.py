"""Which voxels a frame looked at, and their direction bins: `mapping.seen` in machine code."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.kernels.mapping.bins import center_of, is_sound, mark_rows
from r3jax.kernels.native.arithmetic import whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined_fused, parallel_kernel, prefetch

SHOWS, HOLE = 1, 2
"""Codes of rows: a measurement shows the voxel; the pixel where it lies has none."""

_SIZE, _RANGE, _FX, _FY, _CX, _CY, _POSE = 0, 1, 2, 3, 4, 5, 6
"""Places in the numbers of a look; the last begins [R | t] of `T_camera_world`, row by row."""

_BLOCK = 1 << 12
"""Rows that a worker looks at before it takes the next."""

_AHEAD = 16
"""Rows whose pixels are on their way from memory while one is looked at: they lie anywhere."""

_EMPTY = np.uint32(EMPTY_WORD)
_ZERO, _ONE, _NEAREST = np.float32(0.0), np.float32(1.0), np.float32(1e-3)


@inlined_fused
def _along(numbers, axis, center):
    """One coordinate of a point in the camera's frame."""
    row = np.uint32(_POSE + 4 * axis)
    along = numbers[row] * center[0] + numbers[row + np.uint32(1)] * center[1]
    return along + numbers[row + np.uint32(2)] * center[2] + numbers[row + np.uint32(3)]


@inlined_fused
def _farthest_around(depth, row, column):
    """Largest depth of a pixel and its neighbors: on a slope it changes within a pixel."""
    farthest = _ZERO
    for i in range(max(row - 1, 0), min(row + 2, depth.shape[0])):
        for j in range(max(column - 1, 0), min(column + 2, depth.shape[1])):
            farthest = max(farthest, depth[i, j])
    return farthest


@inlined_fused
def _project(key, first, num, numbers, shape, pixels, depths):
    """Pixel and z-depth of each row from `first` on; -1 for rows out of the image or of range.

    Without a branch, so that LLVM turns the loop into vectors: most rows end here.
    """
    in_wide_vectors()
    height, width = np.float32(shape[0]), np.float32(shape[1])
    last_row, last_column = height - _ONE, width - _ONE
    reach = numbers[_RANGE] * numbers[_RANGE]
    for i in range(num):
        center = center_of(key, first + i, numbers[_SIZE])
        z = _along(numbers, 2, center)
        x, y = _along(numbers, 0, center), _along(numbers, 1, center)
        per_z = _ONE / z
        u = numbers[_FX] * x * per_z + numbers[_CX]
        v = numbers[_FY] * y * per_z + numbers[_CY]
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
def _code_of(pixel, measured, z, depth, slack):
    """What a frame says of a row that lies in one of its pixels; see `codes_of_rows`."""
    if measured == _ZERO:
        return HOLE
    if not measured > _ZERO:
        return 0
    # One edge of slack: a surface may lie anywhere within its voxel. Mostly the pixel itself says
    # so, which is farther than none of those around it.
    if z <= measured + slack:
        return SHOWS
    row, column = pixel // depth.shape[1], pixel % depth.shape[1]
    return SHOWS if z <= _farthest_around(depth, row, column) + slack else 0


@parallel_kernel
def look_pass(key, numbers, depth, workers, codes, has_holes):
    """Codes of all rows.

    Args:
        key: of the map [2, N].
        numbers: voxel size, range, camera, pose.
        depth: the frame's [H, W].
        workers: threads.
        codes: written [N].
        has_holes: written: 1 if any row is in a hole [1].
    """
    capacity, holes = key.shape[1], np.empty(workers, np.int32)
    sound = is_sound(numbers, _FX)
    blocks, flat = (capacity + _BLOCK - 1) // _BLOCK, depth.reshape(depth.size)
    for worker in prange(workers):
        pixels, depths = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.float32)
        seen = np.empty(_BLOCK, np.int32)
        holes[worker] = 0
        for block in range(worker, blocks, workers):
            first, size = block * _BLOCK, min(_BLOCK, capacity - block * _BLOCK)
            if sound:
                _project(key, first, size, numbers, depth.shape, pixels, depths)
            # Listed without a branch: whether a row is in view is a guess that often fails.
            num = 0
            for i in range(size):
                codes[first + i] = 0
                seen[num] = i
                num += (pixels[i] >= 0) & sound
            for k in range(num):
                if k + _AHEAD < num:
                    prefetch(flat, np.int64(pixels[seen[k + _AHEAD]]))
                i = np.int64(seen[k])
                pixel = np.int64(pixels[i])
                code = _code_of(pixel, flat[pixel], depths[i], depth, numbers[_SIZE])
                codes[first + i] = code
                if code == HOLE:
                    holes[worker] = 1
    has_holes[0] = 0
    for worker in range(workers):
        has_holes[0] |= holes[worker]


@parallel_kernel
def mark_pass(visited, resolution, key, camera, codes, shown_in_holes, table, lattice, workers):
    """Sets bins and resolutions of the rows that are shown, in place (`seen.mark_rows`).

    Args:
        visited: words of bins [W, N].
        resolution: best so far [N].
        key: of the map [2, N].
        camera: voxel size, focal length and position.
        codes: of `look_pass` [N].
        shown_in_holes: 1 where a row in a hole is shown all the same [N].
        table: candidates of each octahedral cell [S^2, K].
        lattice: directions of the bins [B, 3].
        workers: threads.
    """
    capacity = key.shape[1]
    blocks = (capacity + _BLOCK - 1) // _BLOCK if is_sound(camera) else 0
    for worker in prange(workers):
        rows = np.empty(_BLOCK, np.int64)
        for block in range(worker, blocks, workers):
            num = 0
            for row in range(block * _BLOCK, min((block + 1) * _BLOCK, capacity)):
                rows[num] = row
                is_in_hole = (codes[row] == HOLE) & (shown_in_holes[row] != 0)
                num += (codes[row] == SHOWS) | is_in_hole
            mark_rows(key, visited, resolution, rows, num, camera, table, lattice)
