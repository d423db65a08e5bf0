"""How far behind a depth buffer a voxel may lie: `depth_buffer.surface_limit` as kernels."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.native.compiled import in_wide_vectors, inlined_fused, kernel
from r3jax.kernels.visibility.picture import begin_of, stride_of

MARGIN = max(constants.STRIDES)
"""Pixels by which a buffer is continued beyond its border."""

_FAR, _MAX_STRETCH = np.float32(constants.FAR), np.float32(constants.MAX_STRETCH)
_ZERO, _ONE, _TWO, _LEAST = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(1e-6)


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
