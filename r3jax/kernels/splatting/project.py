"""Projection and color of one Gaussian: `r3jax.splatting.projection`, scalar by scalar.

The harmonics, up to degree 3, are those of `r3jax.splatting.projection` in the same order.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.native.compiled import inlined_fast
from r3jax.kernels.splatting import records as at

_C0, _C1 = np.float32(constants.SH0), np.float32(constants.SH1)
_P, _Q, _R = (np.float32(c) for c in constants.SH2)
_S, _T, _U, _V, _W = (np.float32(c) for c in constants.SH3)
_2, _3, _4, _6, _8 = (np.float32(i) for i in (2, 3, 4, 6, 8))


@inlined_fast
def basis_at(x, y, z, count, basis):
    """Writes the first `count` basis functions at the unit direction (x, y, z)."""
    basis[0] = _C0
    if count > 1:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = _P * x * y
        basis[5] = -_P * y * z
        basis[6] = _Q * (_2 * zz - xx - yy)
        basis[7] = -_P * x * z
        basis[8] = _R * (xx - yy)
        if count > 9:
            basis[9] = -_S * y * (_3 * xx - yy)
            basis[10] = _T * x * y * z
            basis[11] = -_U * y * (_4 * zz - xx - yy)
            basis[12] = _V * z * (_2 * zz - _3 * xx - _3 * yy)
            basis[13] = -_U * x * (_4 * zz - xx - yy)
            basis[14] = _W * z * (xx - yy)
            basis[15] = -_S * x * (xx - _3 * yy)


@inlined_fast
def gradient_by_direction(x, y, z, count, g):
    """Computes the gradient by (x, y, z), as free variables, of sum(g[k] basis[k])."""
    dx = dy = dz = np.float32(0.0)
    if count > 1:
        dx, dy, dz = -_C1 * g[3], -_C1 * g[1], _C1 * g[2]
    if count > 4:
        dx += _P * (y * g[4] - z * g[7]) + _2 * x * (_R * g[8] - _Q * g[6])
        dy += _P * (x * g[4] - z * g[5]) - _2 * y * (_R * g[8] + _Q * g[6])
        dz += -_P * (y * g[5] + x * g[7]) + _4 * _Q * z * g[6]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        xy, yz, xz = x * y, y * z, x * z
        dx += (
            -_6 * _S * xy * g[9]
            + _T * yz * g[10]
            + _2 * _U * xy * g[11]
            - _6 * _V * xz * g[12]
            - _U * (_4 * zz - _3 * xx - yy) * g[13]
            + _2 * _W * xz * g[14]
            - _3 * _S * (xx - yy) * g[15]
        )
        dy += (
            -_3 * _S * (xx - yy) * g[9]
            + _T * xz * g[10]
            - _U * (_4 * zz - xx - _3 * yy) * g[11]
            - _6 * _V * yz * g[12]
            + _2 * _U * xy * g[13]
            - _2 * _W * yz * g[14]
            + _6 * _S * xy * g[15]
        )
        dz += (
            _T * xy * g[10]
            - _8 * _U * yz * g[11]
            + _3 * _V * (_2 * zz - xx - yy) * g[12]
            - _8 * _U * xz * g[13]
            + _W * (xx - yy) * g[14]
        )
    return dx, dy, dz


NEAR = np.float32(constants.NEAR_PLANE)
DILATION = np.float32(constants.DILATION)
ALPHA_MIN = np.float32(constants.ALPHA_MIN)
MARGIN = np.float32(0.5 * constants.FRUSTUM_MARGIN)
LOG2_E = np.float32(np.log2(np.e))
HALF, ZERO, ONE, TWO = (np.float32(x) for x in (0.5, 0.0, 1.0, 2.0))
_BALL_SLACK = np.float32(1.01)
_TWO_S_SCALE, _TWO_S_MORE = np.float32(2.002), np.float32(1e-4)


@inlined_fast
def in_camera(mean, view):
    """Computes the coordinates of a center in the camera's frame [m]."""
    x = view[0] * mean[0] + view[1] * mean[1] + view[2] * mean[2] + view[9]
    y = view[3] * mean[0] + view[4] * mean[1] + view[5] * mean[2] + view[10]
    z = view[6] * mean[0] + view[7] * mean[1] + view[8] * mean[2] + view[11]
    return x, y, z


@inlined_fast
def clamped_slope(ratio, focal, middle, size):
    """Computes x/z where the Jacobian is taken: at most 30 % of half the image outside it."""
    margin = MARGIN * np.float32(size)
    low, high = -(middle + margin) / focal, (np.float32(size) - middle + margin) / focal
    return min(max(ratio, low), high)


@inlined_fast
def rotation_of(quat, rotation):
    """Writes the rotation matrix (9 numbers) of a quaternion wxyz; returns it at unit length.

    Returns:
        w, x, y, z and 1 / length of the quaternion (1 where it is zero).
    """
    squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]
    inverse = ONE / np.sqrt(squared) if squared > ZERO else ONE
    w, x, y, z = quat[0] * inverse, quat[1] * inverse, quat[2] * inverse, quat[3] * inverse
    rotation[0] = ONE - TWO * (y * y + z * z)
    rotation[1] = TWO * (x * y - w * z)
    rotation[2] = TWO * (x * z + w * y)
    rotation[3] = TWO * (x * y + w * z)
    rotation[4] = ONE - TWO * (x * x + z * z)
    rotation[5] = TWO * (y * z - w * x)
    rotation[6] = TWO * (x * z - w * y)
    rotation[7] = TWO * (y * z + w * x)
    rotation[8] = ONE - TWO * (x * x + y * y)
    return w, x, y, z, inverse


@inlined_fast
def jacobian_rows(view, u, v, fx_z, fy_z, rows):
    """Writes the two rows of J R (6 numbers): the image's axes seen from the world [px/m]."""
    for i in range(3):
        rows[i] = fx_z * (view[i] - u * view[6 + i])
        rows[3 + i] = fy_z * (view[3 + i] - v * view[6 + i])


@inlined_fast
def image_axes(rows, rotation, log_scales, axes):
    """Writes the Gaussian's three axes in the image (6 numbers: x components, then y) [px]."""
    for j in range(3):
        scale = np.exp(log_scales[j])
        for k in range(2):
            axes[3 * k + j] = scale * (
                rows[3 * k] * rotation[j]
                + rows[3 * k + 1] * rotation[3 + j]
                + rows[3 * k + 2] * rotation[6 + j]
            )


@inlined_fast
def covariance_of(axes):
    """Computes xx, xy, yy of the dilated covariance in the image [px^2]."""
    xx = axes[0] * axes[0] + axes[1] * axes[1] + axes[2] * axes[2] + DILATION
    xy = axes[0] * axes[3] + axes[1] * axes[4] + axes[2] * axes[5]
    yy = axes[3] * axes[3] + axes[4] * axes[4] + axes[5] * axes[5] + DILATION
    return xx, xy, yy


@inlined_fast
def sigmoid(logit):
    """Computes 1 / (1 + exp(-logit))."""
    return ONE / (ONE + np.exp(-logit))


@inlined_fast
def _are_finite(mean, quat, log_scales):
    """Checks whether all parameters are finite."""
    total = quat[3]
    for i in range(3):
        total += abs(mean[i]) + abs(quat[i]) + abs(log_scales[i])
    return abs(total) < np.inf


@inlined_fast
def _is_outside(center, row, two_s, log_scales, size):
    """Checks whether even a ball of the Gaussian's largest scale would miss the image.

    Most invisible Gaussians then need no covariance.
    """
    scale = np.exp(max(log_scales[0], log_scales[1], log_scales[2]))
    squared = scale * scale * (row[0] * row[0] + row[1] * row[1] + row[2] * row[2]) + DILATION
    reach = _BALL_SLACK * np.sqrt(two_s * squared)
    return center + reach < ZERO or center - reach > np.float32(size)


@inlined_fast
def project_one(mean, quat, log_scales, logit, offset, view, width, height, scratch, record):
    """Writes the geometry of a Gaussian to its record, with 21 numbers of scratch room.

    Returns:
        Whether it may touch a pixel. Comparisons are written so that NaN means no.
    """
    x, y, z = in_camera(mean, view)
    opacity = sigmoid(logit)
    if not (z > NEAR and opacity >= ALPHA_MIN and _are_finite(mean, quat, log_scales)):
        return False
    fx, fy, cx, cy = view[15], view[16], view[17], view[18]
    center_x, center_y = fx * x / z + cx + offset[0], fy * y / z + cy + offset[1]
    rotation, rows, axes = scratch[:9], scratch[9:15], scratch[15:21]
    u, v = clamped_slope(x / z, fx, cx, width), clamped_slope(y / z, fy, cy, height)
    jacobian_rows(view, u, v, fx / z, fy / z, rows)
    two_s = _TWO_S_SCALE * np.log(opacity / ALPHA_MIN) + _TWO_S_MORE
    if _is_outside(center_x, rows[:3], two_s, log_scales, width) or _is_outside(
        center_y, rows[3:], two_s, log_scales, height
    ):
        return False
    rotation_of(quat, rotation)
    image_axes(rows, rotation, log_scales, axes)
    xx, xy, yy = covariance_of(axes)
    determinant = xx * yy - xy * xy
    if not (determinant > ZERO and determinant < np.inf):
        return False
    record[at.CENTER_X], record[at.CENTER_Y] = center_x, center_y
    record[at.A] = HALF * LOG2_E * yy / determinant
    record[at.B] = -LOG2_E * xy / determinant
    record[at.C] = HALF * LOG2_E * xx / determinant
    record[at.LOG_OPACITY] = np.log2(opacity)
    record[at.DEPTH] = z
    record[at.SLOPE], record[at.VARIANCE] = xy / xx, determinant / xx
    record[at.INVERSE_XX], record[at.TWO_S] = ONE / xx, two_s
    return True


@inlined_fast
def direction_of(mean, view):
    """Computes the unit vector from camera to Gaussian, and 1 / distance (0 at the center)."""
    x, y, z = mean[0] - view[12], mean[1] - view[13], mean[2] - view[14]
    squared = x * x + y * y + z * z
    inverse = ONE / np.sqrt(squared) if squared > ZERO else ZERO
    return x * inverse, y * inverse, z * inverse, inverse


@inlined_fast
def color_one(mean, sh, view, basis, record):
    """Writes max(SH + 0.5, 0) to a record; `sh` is one Gaussian's [k * 3] coefficients.

    Returns:
        Whether the color is a number.
    """
    x, y, z, _ = direction_of(mean, view)
    count = sh.shape[0] // 3
    basis_at(x, y, z, count, basis)
    red = green = blue = HALF
    for k in range(count):
        red += basis[k] * sh[3 * k]
        green += basis[k] * sh[3 * k + 1]
        blue += basis[k] * sh[3 * k + 2]
    record[at.RED], record[at.GREEN], record[at.BLUE] = (
        max(red, ZERO),
        max(green, ZERO),
        max(blue, ZERO),
    )
    return abs(red) + abs(green) + abs(blue) < np.inf
