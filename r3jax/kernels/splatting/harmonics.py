"""Real spherical harmonics of one Gaussian and their derivatives, up to degree 3.

The same functions in the same order as `r3jax.splatting.harmonics`.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels import constants
from r3jax.kernels.native.compiled import inlined_fast

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
