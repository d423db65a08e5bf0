"""Where voxels fall in a view, a chunk at a time: the arithmetic of `visibility.views`.

Results of a chunk are in one flat array that stays in the L1 cache; the constants
below say where each part of it begins.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from typing import Any, NamedTuple

import numpy as np

from r3jax.kernels.native.compiled import in_wide_vectors, inlined, inlined_fused, kernel

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


class View(NamedTuple):
    """One of `calls.Views`."""

    position: Any
    """Of the camera: x, y, z [m]."""

    rotation: Any
    """Of `T_world_camera`, row by row [9]."""

    fx: Any
    fy: Any
    cx: Any
    cy: Any
    max_range: Any
    tolerance: Any
    pixel_angle: Any
    focal: Any


@inlined
def view_at(views, i):
    """Returns the i-th of some views."""
    return View(
        (views.position[i, 0], views.position[i, 1], views.position[i, 2]), views.rotation[i],
        views.fx[i], views.fy[i], views.cx[i], views.cy[i], views.max_range[i],
        views.tolerance[i], views.pixel_angle[i], views.focal[i],
    )  # fmt: skip


@kernel
def sound_views(views, voxel_size):
    """Marks the views whose numbers are all finite; the others see nothing."""
    is_valid = np.empty(views.focal.shape[0], np.bool_)
    is_size = voxel_size > _ZERO and voxel_size < _INFINITE
    for i in range(is_valid.shape[0]):
        # Differences of infinities are NaN, and any sum with NaN is NaN.
        total = views.fx[i] + views.fy[i] + views.cx[i] + views.cy[i] + views.focal[i]
        total += views.max_range[i] + views.tolerance[i] + views.pixel_angle[i]
        for axis in range(3):
            total += views.position[i, axis]
        for k in range(9):
            total += views.rotation[i, k]
        is_valid[i] = is_size and math.isfinite(total)
    return is_valid


_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LEAST, _AHEAD, _INFINITE = np.float32(1e-6), np.float32(1e-3), np.float32(np.inf)


@inlined_fused
def _sign(x):
    return _ONE if x >= _ZERO else -_ONE


@inlined_fused
def place_all_round(view, size, x, y, z, placed):
    """Places voxels on the octahedral map round a position (`PanoramaView.place`)."""
    in_wide_vectors()
    center_x, center_y, center_z = view.position
    far, half = view.max_range, _HALF * np.float32(size)
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
    center_x, center_y, center_z = view.position
    r = view.rotation
    xx, xy, xz = r[0], r[1], r[2]
    yx, yy, yz = r[3], r[4], r[5]
    zx, zy, zz = r[6], r[7], r[8]
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    far = view.max_range
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
def place(view, layout, points, first, count, placed):
    """Places `count` voxels from `first` on, of points [3, n] [m]."""
    # Slices, not offsets: Numba allows for negative indices, and LLVM would gather one by one.
    end = first + count
    x, y, z = points[0, first:end], points[1, first:end], points[2, first:end]
    if layout.wraps:
        place_all_round(view, layout.height, x, y, z, placed)
    else:
        place_in_image(view, x, y, z, placed)
