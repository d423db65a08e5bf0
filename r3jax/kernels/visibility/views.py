"""Where voxels fall in a view, a chunk at a time: the arithmetic of `visibility.views`.

What is worked out of a chunk lies in one flat array that stays in the L1 cache; the constants
below say where each part of it begins.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels.native.compiled import in_wide_vectors, inlined_fused

CHUNK = 512
"""Voxels at a time."""

COLUMN, ROW = 0 * CHUNK, 1 * CHUNK
COLUMN_SCALE, ROW_SCALE = 2 * CHUNK, 3 * CHUNK
SUM_SCALE, DIFFERENCE_SCALE = 4 * CHUNK, 5 * CHUNK
DISTANCE = 6 * CHUNK
"""Infinite where a voxel lies behind the camera or out of range: so it hides nothing and is never
seen, without a test."""

REACH = 7 * CHUNK
"""How far the view reaches at a voxel [m]; written by `seen.test_corners`."""

PLACED = 8 * CHUNK
"""Floats that a chunk's placement takes."""

POSITION, ROTATION, LENS, RANGE, TOLERANCE, FOCAL, PIXEL_ANGLE = 0, 3, 12, 16, 17, 18, 19
"""Where the parts of a view's row begin: the camera's center, `T_world_camera`'s rotation row by
row, fx fy cx cy of the buffer, range [m], tolerance [voxels], focal length of R [px], angle of a
pixel [rad]. A panorama has neither rotation nor lens."""

VIEW_SIZE = 20
"""Floats that describe a view."""

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LEAST, _AHEAD, _INFINITE = np.float32(1e-6), np.float32(1e-3), np.float32(np.inf)


@inlined_fused
def _sign(x):
    return _ONE if x >= _ZERO else -_ONE


@inlined_fused
def place_all_round(view, size, x, y, z, placed):
    """Places voxels on the octahedral map round a position (`PanoramaView.place`)."""
    in_wide_vectors()
    center_x, center_y, center_z = view[POSITION], view[POSITION + 1], view[POSITION + 2]
    far, half = view[RANGE], _HALF * np.float32(size)
    for i in range(x.shape[0]):
        dx, dy, dz = x[i] - center_x, y[i] - center_y, z[i] - center_z
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), _LEAST)
        inverse = _ONE / max(abs(dx) + abs(dy) + abs(dz), _LEAST)
        u, v = dx * inverse, dy * inverse
        a, b = abs(u), abs(v)
        is_lower = dz < _ZERO
        p = b if is_lower else a
        q = a if is_lower else b
        column = (_ONE - b) * _sign(u) if is_lower else u
        row = (_ONE - a) * _sign(v) if is_lower else v
        scale, sign_x, sign_y = half * inverse, _sign(dx), _sign(dy)
        both, apart = u + v, u - v
        placed[COLUMN + i] = column * half + half
        placed[ROW + i] = row * half + half
        placed[COLUMN_SCALE + i] = scale * (_ONE + p)
        placed[ROW_SCALE + i] = scale * (_ONE + q)
        placed[SUM_SCALE + i] = scale * (
            abs(_ONE - both * sign_x) + abs(_ONE - both * sign_y) + abs(both)
        )
        placed[DIFFERENCE_SCALE + i] = scale * (
            abs(_ONE - apart * sign_x) + abs(-_ONE - apart * sign_y) + abs(apart)
        )
        placed[DISTANCE + i] = distance if distance <= far else _INFINITE


@inlined_fused
def place_in_image(view, x, y, z, placed):
    """Places voxels in the image of a camera (`PinholeView.place`)."""
    in_wide_vectors()
    center_x, center_y, center_z = view[POSITION], view[POSITION + 1], view[POSITION + 2]
    r = ROTATION
    xx, xy, xz = view[r], view[r + 1], view[r + 2]
    yx, yy, yz = view[r + 3], view[r + 4], view[r + 5]
    zx, zy, zz = view[r + 6], view[r + 7], view[r + 8]
    fx, fy, cx, cy = view[LENS], view[LENS + 1], view[LENS + 2], view[LENS + 3]
    far = view[RANGE]
    for i in range(x.shape[0]):
        dx, dy, dz = x[i] - center_x, y[i] - center_y, z[i] - center_z
        right = xx * dx + yx * dy + zx * dz
        down = xy * dx + yy * dy + zy * dz
        ahead = xz * dx + yz * dy + zz * dz
        is_ahead = ahead > _AHEAD
        inverse = _ONE / (ahead if is_ahead else _ONE)
        slope_x, slope_y = right * inverse, down * inverse
        along_x, along_y = fx * inverse, fy * inverse
        # Derivatives of column and row along the world's axes.
        c0, r0 = along_x * (xx - slope_x * xz), along_y * (xy - slope_y * xz)
        c1, r1 = along_x * (yx - slope_x * yz), along_y * (yy - slope_y * yz)
        c2, r2 = along_x * (zx - slope_x * zz), along_y * (zy - slope_y * zz)
        placed[COLUMN + i] = fx * slope_x + cx
        placed[ROW + i] = fy * slope_y + cy
        placed[COLUMN_SCALE + i] = abs(c0) + abs(c1) + abs(c2)
        placed[ROW_SCALE + i] = abs(r0) + abs(r1) + abs(r2)
        placed[SUM_SCALE + i] = abs(c0 + r0) + abs(c1 + r1) + abs(c2 + r2)
        placed[DIFFERENCE_SCALE + i] = abs(c0 - r0) + abs(c1 - r1) + abs(c2 - r2)
        distance = math.sqrt(right * right + down * down + ahead * ahead)
        placed[DISTANCE + i] = distance if is_ahead and distance <= far else _INFINITE


@inlined_fused
def place(view, shape, wraps, x, y, z, first, count, placed):
    """Places `count` voxels from `first` on."""
    # Slices, not offsets: Numba allows for negative indices, and LLVM would gather one by one.
    end = first + count
    x, y, z = x[first:end], y[first:end], z[first:end]
    if wraps:
        place_all_round(view, shape[0], x, y, z, placed)
    else:
        place_in_image(view, x, y, z, placed)
