"""Which voxels and points a depth buffer leaves in sight: tests of `visibility.depth_buffer`."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels.constants import CORNER
from r3jax.kernels.native.arithmetic import floor, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined_fused
from r3jax.kernels.visibility.picture import begin_of, stride_of
from r3jax.kernels.visibility.views import (
    CHUNK,
    COLUMN,
    COLUMN_SCALE,
    DISTANCE,
    REACH,
    ROW,
    ROW_SCALE,
)

_CORNER = np.float32(CORNER)
_ZERO, _ONE, _INFINITE = np.float32(0.0), np.float32(1.0), np.float32(np.inf)


@inlined_fused
def _pixel_at(column, row, begin, stride, height, width):
    """Finds the place of the pixel at continuous coordinates.

    Coordinates far outside, and those that are not numbers, lead into the ring.
    """
    c = column if column > -_ONE else -_ONE
    r = row if row > -_ONE else -_ONE
    c, r = floor(c if c < width else width), floor(r if r < height else height)
    return whole(begin + r * stride + c)


@inlined_fused
def test_corners(placed, count, voxel_size, limit, side, shape, pixels, is_seen):
    """Tests voxels at the corner, as they appear in the view, that shows most.

    Args:
        placed: where they fall.
        count: how many they are.
        voxel_size: edge [m].
        limit: of the view with its ring, see `picture` [m].
        side: of the picture.
        shape: height and width of the image [px].
        pixels: scratch, four for each voxel of a chunk.
        is_seen: written, 1 for voxels in the image, within range and not hidden as a whole.
    """
    in_wide_vectors()
    begin, stride = np.float32(begin_of(0, side)), np.float32(stride_of(side))
    height, width = np.float32(shape[0]), np.float32(shape[1])
    # Three loops: the first and the last are arithmetic, which LLVM vectorizes.
    for i in range(count):
        column, row = placed[COLUMN + i], placed[ROW + i]
        right = _CORNER * voxel_size * placed[COLUMN_SCALE + i]
        down = _CORNER * voxel_size * placed[ROW_SCALE + i]
        left, east, top, south = column - right, column + right, row - down, row + down
        pixels[i] = _pixel_at(left, top, begin, stride, height, width)
        pixels[CHUNK + i] = _pixel_at(left, south, begin, stride, height, width)
        pixels[2 * CHUNK + i] = _pixel_at(east, top, begin, stride, height, width)
        pixels[3 * CHUNK + i] = _pixel_at(east, south, begin, stride, height, width)
    for i in range(count):
        first = max(limit[np.uint32(pixels[i])], limit[np.uint32(pixels[CHUNK + i])])
        second = max(
            limit[np.uint32(pixels[2 * CHUNK + i])], limit[np.uint32(pixels[3 * CHUNK + i])]
        )
        placed[REACH + i] = max(first, second)
    for i in range(count):
        column, row, distance = placed[COLUMN + i], placed[ROW + i], placed[DISTANCE + i]
        is_in = (column >= _ZERO) & (column < width) & (row >= _ZERO) & (row < height)
        is_in = is_in & (distance <= placed[REACH + i]) & (distance < _INFINITE)
        is_seen[i] = is_in


@inlined_fused
def test_points(placed, count, nearest, side, shape, is_seen):
    """Tests points in empty space, which nothing may hide, at their own pixel.

    The arguments are those of `test_corners`, but for `nearest`: the buffer itself.
    """
    in_wide_vectors()
    begin, stride = np.float32(begin_of(0, side)), np.float32(stride_of(side))
    height, width = np.float32(shape[0]), np.float32(shape[1])
    for i in range(count):
        column, row, distance = placed[COLUMN + i], placed[ROW + i], placed[DISTANCE + i]
        is_in = (column >= _ZERO) & (column < width) & (row >= _ZERO) & (row < height)
        pixel = np.uint32(_pixel_at(column, row, begin, stride, height, width))
        is_in = is_in & (distance <= nearest[pixel]) & (distance < _INFINITE)
        is_seen[i] = is_in
