"""Voxels into an image pyramid, and the pyramid into one image: `visibility.footprint` as kernels.

A level is stored as a square whose side s is the least power of two that holds it, in the places
from s^2 to 2 s^2: no table says where it begins. A third of the places stays unused.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.native.arithmetic import ceil_log2, floor, power_of_two, whole
from r3jax.native.compiled import inlined, inlined_fused
from r3jax.visibility import footprint
from r3jax.visibility.backends.numba.views import (
    CHUNK,
    COLUMN,
    COLUMN_SCALE,
    DIFFERENCE_SCALE,
    DISTANCE,
    ROW,
    ROW_SCALE,
    SUM_SCALE,
)

TARGETS = 4 * CHUNK
"""Places in the pyramid of a chunk's voxels, four each."""

SPARE = 64
"""Places behind the pyramid, for what is not covered: a write costs less than a branch."""

_HALF_WIDTH, _NEAR = np.float32(footprint.HALF_WIDTH), np.float32(footprint.NEAR)
_SEAM = np.float32(footprint.SEAM)
_ZERO, _QUARTER, _HALF = np.float32(0.0), np.float32(0.25), np.float32(0.5)
_ONE, _TWO = np.float32(1.0), np.float32(2.0)
_LEAST, _LOWEST, _HIGHEST = np.float32(1e-6), np.float32(-2.0), np.float32(1e6)


@inlined
def side_of(shape):
    """The least power of two that holds an image."""
    side = 1
    while side < max(shape[0], shape[1]):
        side *= 2
    return side


@inlined
def pyramid_size(side):
    """Places of all levels."""
    return 2 * side * side


@inlined
def finest(pixels, side):
    """The finest level, rows `side` apart."""
    return pixels[side * side : 2 * side * side]


@inlined_fused
def _first_of(middle):
    """The first of the two pixels round a coordinate."""
    low = middle if middle > _LOWEST else _LOWEST
    return floor((low if low < _HIGHEST else _HIGHEST) - _HALF)


@inlined_fused
def _target(row, column, down, right, reach, slants, level, wraps, spare):
    """Place of one pixel in the pyramid as a float, or a spare one if the voxel misses it."""
    offset, stride, height, width = level
    is_own = (abs(right) <= _HALF) & (abs(down) <= _HALF)
    covers = (abs(right + down) <= slants[0]) & (abs(right - down) <= slants[1])
    is_in = (abs(down) <= reach[0]) & (abs(right) <= reach[1]) & (covers | is_own)
    if wraps:
        # One step outside, the borders are glued to themselves, turned (`views.wrap`).
        crosses_column = (column < _ZERO) | (column >= width)
        crosses_row = (row < _ZERO) | (row >= height)
        turned = height - _ONE - row if crosses_column else row
        column = width - _ONE - column if crosses_row else column
        row = min(max(turned, _ZERO), height - _ONE)
        column = min(max(column, _ZERO), width - _ONE)
    else:
        is_in = is_in & (row >= _ZERO) & (row < height) & (column >= _ZERO) & (column < width)
    index = offset + row * stride + column
    # Only what compares as inside is kept: a coordinate that is not a number never is.
    return index if is_in & (index >= _ZERO) & (index < spare) else spare


@inlined_fused
def find_targets(placed, count, voxel_size, shape, side, wraps, targets):
    """Finds the up to four pixels that each voxel covers (`footprint.footprint`).

    Indices are worked out in float32, which holds them exactly below 2^24.
    """
    full, end = np.float32(side), np.float32(pyramid_size(side))
    top = ceil_log2(full)
    height, width = np.float32(shape[0]), np.float32(shape[1])
    for i in range(count):
        distance = placed[DISTANCE + i]
        half = voxel_size * (_HALF_WIDTH + _NEAR * voxel_size / distance)
        wide, high = _TWO * half * placed[COLUMN_SCALE + i], _TWO * half * placed[ROW_SCALE + i]
        widest = _HALF * max(max(wide, high), _LEAST)
        level = min(max(ceil_log2(widest), _ZERO), top)
        scale = power_of_two(-level)
        begins_level = (level > _ZERO) & (widest * scale < _SEAM)
        spread = _QUARTER if begins_level else _ZERO
        column, row = placed[COLUMN + i] * scale, placed[ROW + i] * scale
        reach = (
            max(_HALF * high * scale + spread, _HALF),
            max(_HALF * wide * scale + spread, _HALF),
        )
        slants = (
            half * placed[SUM_SCALE + i] * scale + _TWO * spread,
            half * placed[DIFFERENCE_SCALE + i] * scale + _TWO * spread,
        )
        stride = full * scale
        at = (stride * stride, stride, -floor(-height * scale), -floor(-width * scale))
        spare = end + np.float32(i & (SPARE - 1))
        c, r = _first_of(column), _first_of(row)
        right, down = c + _HALF - column, r + _HALF - row
        right1, down1 = right + _ONE, down + _ONE
        targets[i] = whole(_target(r, c, down, right, reach, slants, at, wraps, spare))
        targets[CHUNK + i] = np.int32(
            _target(r, c + _ONE, down, right1, reach, slants, at, wraps, spare)
        )
        targets[2 * CHUNK + i] = np.int32(
            _target(r + _ONE, c, down1, right, reach, slants, at, wraps, spare)
        )
        targets[3 * CHUNK + i] = np.int32(
            _target(r + _ONE, c + _ONE, down1, right1, reach, slants, at, wraps, spare)
        )


@inlined
def push_down(pixels, side, shape):
    """Leaves the least value over all levels at the finest."""
    levels = 0
    while (1 << levels) < side:
        levels += 1
    for level in range(levels - 1, -1, -1):
        stride = side >> level
        begin, above = stride * stride, (stride >> 1) * (stride >> 1)
        height = (shape[0] + (1 << level) - 1) >> level
        width = (shape[1] + (1 << level) - 1) >> level
        for r in range(height):
            fine, coarse = begin + r * stride, above + (r >> 1) * (stride >> 1)
            for c in range(width >> 1):
                value = pixels[coarse + c]
                first, second = fine + 2 * c, fine + 2 * c + 1
                pixels[first] = min(pixels[first], value)
                pixels[second] = min(pixels[second], value)
            if width & 1:
                last = fine + width - 1
                pixels[last] = min(pixels[last], pixels[coarse + (width >> 1)])
