"""Which voxels and points a depth buffer leaves in sight: `visibility.depth_buffer` as kernels.

`surface_limit` finds how far behind the buffer a voxel may lie; the tests compare with it.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.constants import CORNER
from r3jax.kernels.native.arithmetic import floor, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined_fused, kernel
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

MARGIN = max(constants.STRIDES)
"""Pixels by which a buffer is continued beyond its border."""

_FAR, _MAX_STRETCH = np.float32(constants.FAR), np.float32(constants.MAX_STRETCH)
_TWO, _LEAST = np.float32(2.0), np.float32(1e-06)


@kernel
def _extend(padded, begin, step, count, across, width):
    """Continues `count` lines in a straight line beyond their first and their last.

    Line k has its first element at `begin + k step`, the others `across` apart: rows or columns.
    A line is mirrored at the border, in place and in value; one that is shorter than the margin
    is mirrored again at its new end.
    """
    offset = 1 if count > 1 else 0
    for direction in (-1, 1):
        edge = begin if direction < 0 else begin + (count - 1) * step
        value_at, missing, end = edge, MARGIN, edge
        while missing > 0:
            turn = min(missing, count - offset)
            for j in range(1, turn + 1):
                to, source = end + direction * j * step, end - direction * (j - 1 + offset) * step
                for k in range(width):
                    shift = k * across
                    padded[to + shift] = _TWO * padded[value_at + shift] - padded[source + shift]
            missing -= turn
            end += direction * turn * step
            if count > 1:
                value_at = end


@inlined_fused
def _flatter(before, after, step):
    """Computes the change per pixel on the flatter side; 0 where the sides disagree."""
    least = min(abs(before), abs(after)) / step
    return least if before * after > _ZERO else _ZERO


@inlined_fused
def _steepest_down(lines, stride, slopes):
    """Writes the slope along columns: lines of the buffer from `MARGIN` above to as many below."""
    here = MARGIN * stride + MARGIN
    middle = lines[here : here + slopes.shape[0]]
    for step in constants.STRIDES:
        above, below = lines[here - step * stride :], lines[here + step * stride :]
        for c in range(slopes.shape[0]):
            flat = _flatter(middle[c] - above[c], below[c] - middle[c], np.float32(step))
            slopes[c] = max(slopes[c], flat)


@inlined_fused
def _steepest_right(line, c):
    """Finds the slope along the row at one column; the line begins `MARGIN` before the first."""
    here, found = line[MARGIN + c], _ZERO
    for step in constants.STRIDES:
        before, after = here - line[MARGIN + c - step], line[MARGIN + c + step] - here
        found = max(found, _flatter(before, after, np.float32(step)))
    return found


@inlined_fused
def _limit_line(distance, line, slopes, pixel_angle, allowance, limit):
    """Writes the limits of one row, see `depth_buffer.surface_limit`."""
    for c in range(slopes.shape[0]):
        right, down = _steepest_right(line, c), slopes[c]
        span = pixel_angle * max(line[MARGIN + c], _LEAST)
        tangent = math.sqrt(down * down + right * right) / span
        stretch = min(math.sqrt(_ONE + tangent * tangent), _MAX_STRETCH)
        limit[c] = distance[c] + allowance * stretch


@kernel
def surface_limit(distance, side, shape, pixel_angle, allowance, padded, slopes, limit):
    """Finds the distance up to which voxels count as the surface in the buffer [m].

    Args:
        distance: the buffer, see `picture` [m].
        side: of the picture.
        shape: height and width of the image [px].
        pixel_angle: angle that a pixel covers [rad].
        allowance: depth of the surface across itself [m].
        padded: scratch, `padded_size(shape)`.
        slopes: scratch, one for each column.
        limit: written, in places as those of `distance`.
    """
    in_wide_vectors()
    height, width = shape
    stride = width + 2 * MARGIN
    first = MARGIN * stride + MARGIN
    for r in range(height):
        at, to = begin_of(0, side) + r * stride_of(side), first + r * stride
        line, source = padded[to : to + width], distance[at : at + width]
        for c in range(width):
            line[c] = min(source[c], _FAR)
    _extend(padded, first, stride, height, 1, width)
    _extend(padded, first, 1, width, stride, height)
    for r in range(height):
        at = begin_of(0, side) + r * stride_of(side)
        slopes[:] = _ZERO
        _steepest_down(padded[r * stride :], stride, slopes)
        _limit_line(
            distance[at : at + width], padded[(r + MARGIN) * stride :], slopes, pixel_angle,
            allowance, limit[at : at + width],
        )  # fmt: skip


@inlined_fused
def padded_size(shape):
    """Returns how many floats `surface_limit` needs as scratch."""
    return (shape[0] + 2 * MARGIN) * (shape[1] + 2 * MARGIN)


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
