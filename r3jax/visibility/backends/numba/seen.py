"""Which voxels and points a depth buffer leaves in sight: tests of `visibility.depth_buffer`."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.native.arithmetic import floor, whole
from r3jax.native.compiled import inlined_fused
from r3jax.visibility import depth_buffer
from r3jax.visibility.backends.numba.views import (
    CHUNK,
    COLUMN,
    COLUMN_SCALE,
    DISTANCE,
    ROW,
    ROW_SCALE,
)

_CORNER = np.float32(depth_buffer.CORNER)
_ZERO, _ONE, _INFINITE = np.float32(0.0), np.float32(1.0), np.float32(np.inf)


@inlined_fused
def _pixel_at(column, row, side, height, width, wraps):
    """Place of the pixel at continuous coordinates; outside: wrapped, or at the border."""
    c, r = floor(min(max(column, -_ONE), width)), floor(min(max(row, -_ONE), height))
    if wraps:
        crosses_column, crosses_row = (c < _ZERO) | (c >= width), (r < _ZERO) | (r >= height)
        turned = height - _ONE - r if crosses_column else r
        c = width - _ONE - c if crosses_row else c
        r = turned
    r, c = min(max(r, _ZERO), height - _ONE), min(max(c, _ZERO), width - _ONE)
    index = r * side + c
    return whole(index if index >= _ZERO else _ZERO)  # not a number: any pixel


@inlined_fused
def test_corners(placed, count, voxel_size, limit, side, shape, wraps, pixels, is_seen):
    """Tests voxels at the corner, as they appear in the view, that shows most.

    Args:
        placed: where they fall.
        count: how many they are.
        voxel_size: edge [m].
        limit: of the view, rows `side` apart [m].
        side: columns of a row as it is stored.
        shape: height and width of the image [px].
        wraps: True for an octahedral map.
        pixels: scratch, four for each voxel of a chunk.
        is_seen: written, 1 for voxels in the image, within range and not hidden as a whole.
    """
    stride, height, width = np.float32(side), np.float32(shape[0]), np.float32(shape[1])
    # Two loops: the first is arithmetic, which LLVM vectorizes, the second looks up.
    for i in range(count):
        column, row = placed[COLUMN + i], placed[ROW + i]
        right = _CORNER * voxel_size * placed[COLUMN_SCALE + i]
        down = _CORNER * voxel_size * placed[ROW_SCALE + i]
        left, east, top, south = column - right, column + right, row - down, row + down
        pixels[i] = _pixel_at(left, top, stride, height, width, wraps)
        pixels[CHUNK + i] = _pixel_at(left, south, stride, height, width, wraps)
        pixels[2 * CHUNK + i] = _pixel_at(east, top, stride, height, width, wraps)
        pixels[3 * CHUNK + i] = _pixel_at(east, south, stride, height, width, wraps)
    for i in range(count):
        column, row, distance = placed[COLUMN + i], placed[ROW + i], placed[DISTANCE + i]
        first = max(limit[np.uint32(pixels[i])], limit[np.uint32(pixels[CHUNK + i])])
        second = max(
            limit[np.uint32(pixels[2 * CHUNK + i])], limit[np.uint32(pixels[3 * CHUNK + i])]
        )
        is_in = (column >= _ZERO) & (column < width) & (row >= _ZERO) & (row < height)
        is_in = is_in & (distance <= max(first, second)) & (distance < _INFINITE)
        is_seen[i] = is_in


@inlined_fused
def test_points(placed, count, nearest, side, shape, wraps, is_seen):
    """Tests points in empty space, which nothing may hide, at their own pixel.

    The arguments are those of `test_corners`, but for `nearest`: the buffer itself.
    """
    stride, height, width = np.float32(side), np.float32(shape[0]), np.float32(shape[1])
    for i in range(count):
        column, row, distance = placed[COLUMN + i], placed[ROW + i], placed[DISTANCE + i]
        is_in = (column >= _ZERO) & (column < width) & (row >= _ZERO) & (row < height)
        pixel = _pixel_at(column, row, stride, height, width, wraps)
        is_in = is_in & (distance <= nearest[pixel]) & (distance < _INFINITE)
        is_seen[i] = is_in
