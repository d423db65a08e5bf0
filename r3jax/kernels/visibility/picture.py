"""Where the pixels of depth buffers lie: all levels of an image pyramid in one flat array.

The levels lie one below the other, rows of all of them `stride_of(side)` apart, where the side is
the least power of two that holds the image. Each has a border of `RING` pixels on all sides, so
that what falls just outside of the image needs no test where it is written or read. `find_targets`
finds the pixels that voxels cover: `depth_buffer.footprint`.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.native.arithmetic import ceil_log2, floor, power_of_two, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, inlined_fused, kernel
from r3jax.kernels.visibility.views import (
    CHUNK,
    COLUMN,
    COLUMN_SCALE,
    DIFFERENCE_SCALE,
    DISTANCE,
    ROW,
    ROW_SCALE,
    SUM_SCALE,
)

RING = 2
"""Pixels of the border: a voxel just outside covers the first two."""


TARGETS = 4 * CHUNK
"""Places in the pyramid of a chunk's voxels, four each."""

SPARE = 64
"""Spare pixels behind the pyramid for writes outside it: a write costs less than a branch."""

_SPARES = np.arange(CHUNK, dtype=np.float32) % SPARE
"""Which of them: not one for all, or each write would wait for the one before."""

_HALF_WIDTH, _NEAR = np.float32(constants.HALF_WIDTH), np.float32(constants.NEAR)
_SEAM, _RING = np.float32(constants.SEAM), np.float32(RING)
_ZERO, _QUARTER, _HALF = np.float32(0.0), np.float32(0.25), np.float32(0.5)
_ONE, _TWO, _LEAST = np.float32(1.0), np.float32(2.0), np.float32(1e-6)


@inlined
def side_of(shape):
    """Computes the least power of two that holds an image."""
    side = 1
    while side < max(shape[0], shape[1]):
        side *= 2
    return side


@inlined
def num_levels(side):
    """Counts the levels of a pyramid, down to a single pixel."""
    levels = 1
    while side > 1:
        side, levels = side >> 1, levels + 1
    return levels


@inlined
def stride_of(side):
    """Computes the places from a pixel to the one below."""
    return side + 2 * RING


@inlined
def begin_of(level, side):
    """Computes the place of the first pixel of a level; works with floats, too."""
    rows = 2 * (side - (side >> level)) + 2 * RING * level
    return (rows + RING) * stride_of(side) + RING


@inlined
def picture_size(side):
    """Returns the number of places in the finest level."""
    return stride_of(side) * stride_of(side)


@inlined
def pyramid_size(side):
    """Returns the number of places in all levels."""
    return (2 * side + 2 * RING * num_levels(side)) * stride_of(side)


@inlined
def shape_of(shape, level):
    """Computes the height and width of a level.

    Both are rounded up, so that every finer pixel has a parent.
    """
    above = (1 << level) - 1
    return (shape[0] + above) >> level, (shape[1] + above) >> level


@inlined
def wrap_pixel(row, column, shape, wraps):
    """Maps a pixel just outside the image to where it continues (`visibility.views.wrap`).

    On an octahedral map, whose borders are glued to themselves, the one that it is glued to; in
    other images the nearest one.
    """
    height, width = shape
    if wraps:
        crosses_column, crosses_row = (column < 0) | (column >= width), (row < 0) | (row >= height)
        row, column = (
            height - 1 - row if crosses_column else row,
            width - 1 - column if crosses_row else column,
        )
    return min(max(row, 0), height - 1), min(max(column, 0), width - 1)


@inlined
def _ring_pixel(i, shape):
    """Computes the row and column of the i-th pixel one step outside of an image."""
    height, width = shape
    if i < 2 * (width + 2):
        return (height if i & 1 else -1), (i >> 1) - 1
    i -= 2 * (width + 2)
    return i >> 1, (width if i & 1 else -1)


@kernel
def fold_ring(pixels, begin, stride, shape):
    """Takes what was written one step outside of an octahedral map over into it."""
    for i in range(2 * (shape[0] + shape[1] + 2)):
        row, column = _ring_pixel(i, shape)
        to_row, to_column = wrap_pixel(row, column, shape, True)
        at = begin + to_row * stride + to_column
        pixels[at] = min(pixels[at], pixels[begin + row * stride + column])


@kernel
def fill_ring(pixels, begin, stride, shape, wraps):
    """Writes into the pixels one step outside of an image what they stand for."""
    for i in range(2 * (shape[0] + shape[1] + 2)):
        row, column = _ring_pixel(i, shape)
        from_row, from_column = wrap_pixel(row, column, shape, wraps)
        pixels[begin + row * stride + column] = pixels[begin + from_row * stride + from_column]


@kernel
def push_down(pixels, side, shape, wraps):
    """Leaves the least value over all levels at the finest."""
    stride = stride_of(side)
    for level in range(num_levels(side) - 1, -1, -1):
        begin, here = begin_of(level, side), shape_of(shape, level)
        if wraps:
            fold_ring(pixels, begin, stride, here)
        if side >> level > 1:
            above = begin_of(level + 1, side)
            for r in range(here[0]):
                fine, coarse = begin + r * stride, above + (r >> 1) * stride
                _take_over(pixels[fine : fine + here[1]], pixels[coarse : coarse + side])


@inlined
def _take_over(fine, coarse):
    """Takes a row of the coarser level over into two pixels each."""
    width = fine.shape[0]
    for c in range(width >> 1):
        value = coarse[c]
        fine[2 * c], fine[2 * c + 1] = min(fine[2 * c], value), min(fine[2 * c + 1], value)
    if width & 1:
        fine[width - 1] = min(fine[width - 1], coarse[width >> 1])


@inlined_fused
def _first_of(middle, edge):
    """Finds the first of the two pixels round a coordinate.

    A coordinate far outside, or one that is not a number, leads into the ring.
    """
    low = middle - _HALF
    low = low if low > -_RING else -_RING
    return floor(low if low < edge else edge)


@inlined_fused
def _covers(down, right, reach, slants):
    """Checks whether a voxel covers a pixel center at this offset from its own.

    Its image is taken as the octagon round the cube.

    A far voxel may reach no center at all, and shows in its own pixel still.
    """
    is_own = (abs(right) <= _HALF) & (abs(down) <= _HALF)
    in_slants = (abs(right + down) <= slants[0]) & (abs(right - down) <= slants[1])
    return (abs(down) <= reach[0]) & (abs(right) <= reach[1]) & (in_slants | is_own)


@inlined_fused
def find_targets(placed, count, voxel_size, side, targets):
    """Finds the up to four pixels that each voxel covers (`depth_buffer.footprint`).

    Places are worked out in float32, which holds them exactly below 2^24.
    """
    in_wide_vectors()
    full, stride = np.float32(side), np.float32(stride_of(side))
    end, top = np.float32(pyramid_size(side)), ceil_log2(np.float32(side))
    for i in range(count):
        half = voxel_size * (_HALF_WIDTH + _NEAR * voxel_size / placed[DISTANCE + i])
        wide, high = half * placed[COLUMN_SCALE + i], half * placed[ROW_SCALE + i]
        widest = max(max(wide, high), _LEAST)
        level = min(max(ceil_log2(widest), _ZERO), top)
        scale = power_of_two(-level)
        edge = full * scale
        # Two levels that meet overlap: no seam opens between voxels on either.
        begins_level = (level > _ZERO) & (widest * scale < _SEAM)
        spread = _QUARTER if begins_level else _ZERO
        reach = max(high * scale + spread, _HALF), max(wide * scale + spread, _HALF)
        slants = (
            half * placed[SUM_SCALE + i] * scale + _TWO * spread,
            half * placed[DIFFERENCE_SCALE + i] * scale + _TWO * spread,
        )
        column, row = placed[COLUMN + i] * scale, placed[ROW + i] * scale
        c, r = _first_of(column, edge), _first_of(row, edge)
        right, down = c + _HALF - column, r + _HALF - row
        right1, down1 = right + _ONE, down + _ONE
        # `picture.begin_of`, of a level that differs from voxel to voxel.
        begin = _TWO * (full - edge) + _TWO * _RING * level + _RING
        at, spare = (begin + r) * stride + (_RING + c), end + _SPARES[i]
        below = at + stride
        targets[i] = whole(at if _covers(down, right, reach, slants) else spare)
        targets[CHUNK + i] = whole(at + _ONE if _covers(down, right1, reach, slants) else spare)
        targets[2 * CHUNK + i] = whole(below if _covers(down1, right, reach, slants) else spare)
        targets[3 * CHUNK + i] = whole(
            below + _ONE if _covers(down1, right1, reach, slants) else spare
        )
