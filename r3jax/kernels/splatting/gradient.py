"""Gradient of projection and color, by hand, for the Gaussians that were drawn.

Names: `g_x` is dL/dx. The order is that of `project.py`, backwards.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.native.compiled import claim, inlined_fast, kernel, parallel_kernel
from r3jax.kernels.splatting import records as at
from r3jax.kernels.splatting.project import (
    ONE,
    TWO,
    ZERO,
    basis_at,
    clamped_slope,
    covariance_of,
    direction_of,
    gradient_by_direction,
    image_axes,
    in_camera,
    jacobian_rows,
    rotation_of,
    sigmoid,
)

ROOM = 71
"""Numbers that one Gaussian needs room for: rotation (9), rows of J R (6), axes in the image (6),
scales (3), gradients by the rows of J R (6) and by the rotation (9), basis of the harmonics (16),
gradients by it (16)."""

_HALF = np.float32(0.5)


@inlined_fast
def sum_slots(start, count, size, numbers, slots, sums):
    """Adds up a Gaussian's intersections in their order; is any of the sums not 0?

    Args:
        start: its first intersection.
        count: of its intersections.
        size: floats in the slot of one.
        numbers: how many of them count.
        slots: of all intersections, one after the other.
        sums: written; [numbers].
    """
    for k in range(numbers):
        sums[k] = ZERO
    for slot in range(start, start + count):
        for k in range(numbers):
            sums[k] += slots[slot * size + k]
    some = False
    for k in range(numbers):
        some |= sums[k] != ZERO
    return some


@inlined_fast
def conic_gradient(sums, xx, xy, yy):
    """Computes the gradients by the center (2) and by the covariance xx, xy, yy (3).

    s = d^T K d / 2 with K the inverse of the covariance S; with M the sum of v d d^T and
    v = -dL/ds, dL/dS = K M K / 2 and dL/dcenter = -K (sum of v d).
    """
    inverse = ONE / (xx * yy - xy * xy)
    kxx, kxy, kyy = yy * inverse, -xy * inverse, xx * inverse
    g_x, g_y = -(kxx * sums[1] + kxy * sums[3]), -(kxy * sums[1] + kyy * sums[3])
    mxx, mxy, myy = sums[2], sums[4], sums[5]
    ax, ay = kxx * mxx + kxy * mxy, kxx * mxy + kxy * myy  # first row of K M
    bx, by = kxy * mxx + kyy * mxy, kxy * mxy + kyy * myy  # second row
    g_xx, g_yy = _HALF * (ax * kxx + ay * kxy), _HALF * (bx * kxy + by * kyy)
    g_xy = ax * kxy + ay * kyy
    return g_x, g_y, g_xx, g_xy, g_yy


@inlined_fast
def _quat_gradient(g, unit, inverse, g_quat):
    """Writes the gradient by the quaternion, from that by the rotation matrix (9 numbers)."""
    w, x, y, z = unit
    a = TWO * (z * (g[3] - g[1]) + y * (g[2] - g[6]) + x * (g[7] - g[5]))
    b = TWO * (y * (g[1] + g[3]) + z * (g[2] + g[6]) - TWO * x * (g[4] + g[8]) + w * (g[7] - g[5]))
    c = TWO * (x * (g[1] + g[3]) + z * (g[5] + g[7]) - TWO * y * (g[0] + g[8]) + w * (g[2] - g[6]))
    d = TWO * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - TWO * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    # Only the component across the quaternion turns it; its length has no meaning.
    along = a * w + b * x + c * y + d * z
    g_quat[0], g_quat[1] = (a - along * w) * inverse, (b - along * x) * inverse
    g_quat[2], g_quat[3] = (c - along * y) * inverse, (d - along * z) * inverse


@inlined_fast
def shape_gradient(g_cov, shape, room, g_scales, g_quat):
    """Writes the gradients by scales (3) and quaternion (4), and that by the rows of J R."""
    g_xx, g_xy, g_yy = g_cov
    unit, inverse = shape
    rotation, rows, axes, scales = room[:9], room[9:15], room[15:21], room[21:24]
    g_rows, g_rotation = room[24:30], room[30:39]
    for i in range(6):
        g_rows[i] = ZERO
    for j in range(3):
        ax, ay = axes[j], axes[3 + j]
        g_ax, g_ay = TWO * g_xx * ax + g_xy * ay, TWO * g_yy * ay + g_xy * ax
        g_scales[j] = g_ax * ax + g_ay * ay
        scale = scales[j]
        for i in range(3):
            g_rows[i] += scale * g_ax * rotation[3 * i + j]
            g_rows[3 + i] += scale * g_ay * rotation[3 * i + j]
            g_rotation[3 * i + j] = scale * (rows[i] * g_ax + rows[3 + i] * g_ay)
    _quat_gradient(g_rotation, unit, inverse, g_quat)


@inlined_fast
def _row_gradient(axis, g_row, row, ratio, slope, z, focal, view, g_view, g_center):
    """Goes back through one row of J R and one coordinate of the center.

    `axis` is 0 for x, 1 for y; `ratio` is x/z and `slope` the same, clamped. Returns the
    gradients by x (or y) and by z.
    """
    over_z = focal / z
    g_over_z, g_slope = ZERO, ZERO
    for i in range(3):
        g_over_z += g_row[i] * row[i] / over_z
        g_slope -= over_z * g_row[i] * view[6 + i]
        g_view[3 * axis + i] += over_z * g_row[i]
        g_view[6 + i] -= over_z * slope * g_row[i]
    g_focal = g_over_z / z + g_center * ratio
    g_middle = g_center
    g_ratio = g_center * focal
    if slope == ratio:
        g_ratio += g_slope
    else:  # clamped to a limit, which is +- (size) / focal - middle / focal
        g_middle -= g_slope / focal
        g_focal -= g_slope * slope / focal
    g_view[15 + axis] += g_focal
    g_view[17 + axis] += g_middle
    return g_ratio / z, -(g_over_z * over_z + g_ratio * ratio) / z


@inlined_fast
def color_gradient(mean, sh, view, record, g_color, room, g_sh):
    """Writes the gradient by the harmonics; returns that by the center, through the direction."""
    x, y, z, inverse = direction_of(mean, view)
    count, basis, g_basis = sh.shape[0] // 3, room[39:55], room[55:71]
    basis_at(x, y, z, count, basis)
    red = g_color[0] if record[at.RED] > ZERO else ZERO
    green = g_color[1] if record[at.GREEN] > ZERO else ZERO
    blue = g_color[2] if record[at.BLUE] > ZERO else ZERO
    for k in range(count):
        b = basis[k]
        g_sh[3 * k], g_sh[3 * k + 1], g_sh[3 * k + 2] = b * red, b * green, b * blue
        g_basis[k] = red * sh[3 * k] + green * sh[3 * k + 1] + blue * sh[3 * k + 2]
    dx, dy, dz = gradient_by_direction(x, y, z, count, g_basis)
    along = dx * x + dy * y + dz * z
    return (dx - along * x) * inverse, (dy - along * y) * inverse, (dz - along * z) * inverse


@inlined_fast
def geometry_of(mean, quat, log_scales, view, size, room):
    """Lays out what the gradients of a Gaussian need; its matrices go to `room`.

    Returns:
        Center in the camera's frame; the slopes of the Jacobian; the covariance xx, xy, yy; and
        the quaternion at unit length with 1 / its length.
    """
    x, y, z = in_camera(mean, view)
    rotation, rows, axes = room[:9], room[9:15], room[15:21]
    w, qx, qy, qz, inverse = rotation_of(quat, rotation)
    u = clamped_slope(x / z, view[15], view[17], size[0])
    v = clamped_slope(y / z, view[16], view[18], size[1])
    jacobian_rows(view, u, v, view[15] / z, view[16] / z, rows)
    image_axes(rows, rotation, log_scales, axes)
    for j in range(3):
        room[21 + j] = np.exp(log_scales[j])
    return (x, y, z), (u, v), covariance_of(axes), ((w, qx, qy, qz), inverse)


@inlined_fast
def center_gradient(g_u, g_v, center, slopes, view, room, g_view):
    """Computes the gradients by the center in the camera's frame: by its pixel, and by J R."""
    x, y, z = center
    g_rows, rows = room[24:30], room[9:15]
    g_x, g_z = _row_gradient(
        0, g_rows[:3], rows[:3], x / z, slopes[0], z, view[15], view, g_view, g_u
    )
    g_y, more = _row_gradient(
        1, g_rows[3:], rows[3:], y / z, slopes[1], z, view[16], view, g_view, g_v
    )
    return g_x, g_y, g_z + more


@kernel
def _gradient_of_one(i, cloud, record, sums, view, size, room, g_cloud, g_view):
    """Computes the gradients of one drawn Gaussian, and adds its share of the view's gradient."""
    means, quats, log_scales, logits, sh, _ = cloud
    g_means, g_quats, g_scales, g_logits, g_sh, g_offsets = g_cloud
    point = means[i]
    center, slopes, covariance, shape = geometry_of(
        point, quats[i], log_scales[i], view, size, room
    )
    xx, xy, yy = covariance
    g_u, g_v, g_xx, g_xy, g_yy = conic_gradient(sums, xx, xy, yy)
    g_offsets[i, 0], g_offsets[i, 1] = g_u, g_v
    g_logits[i] = sums[0] * (ONE - sigmoid(logits[i]))
    shape_gradient((g_xx, g_xy, g_yy), shape, room, g_scales[i], g_quats[i])
    g_x, g_y, g_z = center_gradient(g_u, g_v, center, slopes, view, room, g_view)
    g_z += sums[9]
    away = color_gradient(point, sh[i], view, record, sums[6:9], room, g_sh[i])
    for k in range(3):
        g_means[i, k] = view[k] * g_x + view[3 + k] * g_y + view[6 + k] * g_z + away[k]
        g_view[k] += g_x * point[k]
        g_view[3 + k] += g_y * point[k]
        g_view[6 + k] += g_z * point[k]
        g_view[12 + k] -= away[k]
    g_view[9] += g_x
    g_view[10] += g_y
    g_view[11] += g_z


@kernel
def _gradient_of_block(block, cloud, records, slots, view, size, g_cloud, g_view):
    """Computes the gradients of a block of Gaussians; 0 for those that were not drawn."""
    integers = records.view(np.int32)
    room, sums = np.empty(ROOM, np.float32), np.empty(10, np.float32)
    g_means, g_quats, g_scales, g_logits, g_sh, g_offsets = g_cloud
    for i in range(block * at.BLOCK, min((block + 1) * at.BLOCK, records.shape[0])):
        count, start = integers[i, at.COUNT], integers[i, at.START]
        if count > 0 and sum_slots(start, count, at.GRADIENT_SIZE, 10, slots, sums):
            _gradient_of_one(i, cloud, records[i], sums, view, size, room, g_cloud, g_view)
        else:
            g_means[i], g_quats[i], g_scales[i] = ZERO, ZERO, ZERO
            g_logits[i], g_sh[i], g_offsets[i] = ZERO, ZERO, ZERO


@parallel_kernel
def gradient_of_cloud(cloud, records, slots, view, size, workers, g_cloud, g_view):
    """Computes the gradients by all parameters and by the view, summed in a fixed order."""
    blocks = -(-records.shape[0] // at.BLOCK)
    shares = np.zeros((blocks, at.VIEW_SIZE), np.float64)
    next_block = np.zeros(1, np.int64)
    for _ in prange(workers):
        block = claim(next_block)
        while block < blocks:
            _gradient_of_block(block, cloud, records, slots, view, size, g_cloud, shares[block])
            block = claim(next_block)
    for k in range(at.VIEW_SIZE):
        total = 0.0
        for block in range(blocks):
            total += shares[block, k]
        g_view[k] = total
