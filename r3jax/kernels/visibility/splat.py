"""Which pixels of an image pyramid voxels cover: `depth_buffer.footprint` as kernels."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.native.arithmetic import ceil_log2, floor, power_of_two, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined_fused
from r3jax.kernels.visibility.picture import RING, pyramid_size, stride_of
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

TARGETS = 4 * CHUNK
"""Places in the pyramid of a chunk's voxels, four each."""

SPARE = 64
"""Places behind the pyramid, for what is not covered: a write costs less than a branch."""

_SPARES = np.arange(CHUNK, dtype=np.float32) % SPARE
"""Which of them: not one for all, or each write would wait for the one before."""

_HALF_WIDTH, _NEAR = np.float32(constants.HALF_WIDTH), np.float32(constants.NEAR)
_SEAM, _RING = np.float32(constants.SEAM), np.float32(RING)
_ZERO, _QUARTER, _HALF = np.float32(0.0), np.float32(0.25), np.float32(0.5)
_ONE, _TWO, _LEAST = np.float32(1.0), np.float32(2.0), np.float32(1e-6)


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
