"""Removes voxels that a frame sees through, in machine code: `mapping.moved.count_misses`."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels import constants
from r3jax.kernels.mapping.bins import camera_of
from r3jax.kernels.mapping.mark import BLOCK, is_camera, project
from r3jax.kernels.native.compiled import inlined_fused, kernel, parallel_kernel

_ZERO, _ONE, _FEW = np.float32(0.0), np.float32(1.0), np.float32(constants.FEW_OBSERVATIONS)
_SLACK, _NOISE = np.float32(constants.SLACK_EDGES), np.float32(constants.SLACK_NOISE)
_HALF_DIAGONAL = np.float32(constants.HALF_DIAGONAL)
_SHARE, _LEAST = np.float32(constants.NEAR_ENOUGH), np.float32(constants.LEAST_FOOTPRINT)


@inlined_fused
def _is_open(depth, pixel, z, focal, size, limit):
    """Checks whether all pixels of a voxel's footprint measure something beyond a limit."""
    height, width = depth.shape
    half = np.int64(math.ceil(focal * _HALF_DIAGONAL * size / z)) + 1
    row, column = pixel // width, pixel % width
    if half > constants.MOST_HALF or row < half or column < half:
        return False
    if row + half >= height or column + half >= width:
        return False
    for i in range(row - half, row + half + 1):
        for j in range(column - half, column + half + 1):
            if not depth[i, j] > limit:
                return False
    return True


@kernel
def map_miss(counts, m2, mean, misses, key, resolution, voxel_size, frame, workers):
    """Counts looks through each voxel, and removes those that were looked through often, in place.

    Args:
        counts: observations of each row [N].
        m2: spread of the colors [N].
        mean: colors [3, N].
        misses: looks through each row since it was last measured [N].
        key: of the map [2, N].
        resolution: best so far [N].
        voxel_size: edge [m].
        frame: `calls.FrameArrays`.
        workers: threads.
    """
    camera = camera_of(frame, voxel_size)
    if is_camera(frame, camera):
        _miss_all(counts, m2, mean, misses, key, resolution, voxel_size, frame, workers)


@parallel_kernel
def _miss_all(counts, m2, mean, misses, key, resolution, size, frame, workers):
    depth, capacity = frame.depth, key.shape[1]
    flat, blocks = depth.reshape(depth.size), (capacity + BLOCK - 1) // BLOCK
    focal = max(frame.fx, frame.fy)
    for worker in prange(workers):
        pixels, depths = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.float32)
        seen = np.empty(BLOCK, np.int32)
        for block in range(worker, blocks, workers):
            first, many = block * BLOCK, min(BLOCK, capacity - block * BLOCK)
            project(key, first, many, frame, size, pixels, depths)
            num = 0
            for i in range(many):
                seen[num] = i
                num += pixels[i] >= 0
            for k in range(num):
                i = np.int64(seen[k])
                row, z, pixel = first + i, depths[i], np.int64(pixels[i])
                slack = _SLACK * size + _NOISE * z
                measured = flat[pixel]
                if measured == _ZERO or measured < z - slack or counts[row] == _ZERO:
                    continue
                if measured <= z + slack:
                    misses[row] = 0
                    continue
                sharpness = frame.focal / z
                if sharpness < _SHARE * resolution[row] or sharpness * size < _LEAST:
                    continue
                if not _is_open(depth, pixel, z, focal, size, z + slack):
                    continue
                misses[row] += 1
                if misses[row] >= (
                    constants.MISSES_OF_FEW if counts[row] <= _FEW else constants.MISSES
                ):
                    misses[row] = 0
                    counts[row], m2[row] = _ZERO, _ZERO
                    for channel in range(3):
                        mean[channel, row] = _ZERO
