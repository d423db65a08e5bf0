"""Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS files."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.kernels.constants import SH0, SH1, SH2, SH3


def harmonics(
    x: Float[Array, " n"], y: Float[Array, " n"], z: Float[Array, " n"], degree: int
) -> list[Float[Array, " n"]]:
    """Computes the (degree + 1)^2 basis functions at unit directions (x, y, z)."""
    basis = [jnp.full_like(x, SH0)]
    if degree >= 1:
        basis += [-SH1 * y, SH1 * z, -SH1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            SH2[0] * x * y,
            -SH2[0] * y * z,
            SH2[1] * (2.0 * zz - xx - yy),
            -SH2[0] * x * z,
            SH2[2] * (xx - yy),
        ]
        if degree >= 3:
            basis += [
                -SH3[0] * y * (3.0 * xx - yy),
                SH3[1] * x * y * z,
                -SH3[2] * y * (4.0 * zz - xx - yy),
                SH3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
                -SH3[2] * x * (4.0 * zz - xx - yy),
                SH3[4] * z * (xx - yy),
                -SH3[0] * x * (xx - 3.0 * yy),
            ]
    return basis


def view_colors(
    sh: Float[Array, "n k 3"], means: Float[Array, "n 3"], camera_center: Float[Array, " 3"]
) -> Float[Array, "3 n"]:
    """Computes colors of Gaussians for a camera: max(SH(direction) + 0.5, 0).

    Args:
        sh: coefficients, k = (degree + 1)^2.
        means: centers in the world [m].
        camera_center: in the world [m].

    Returns:
        RGB, one row per channel; it may exceed 1.
    """
    x, y, z = (means[:, i] - camera_center[i] for i in range(3))
    squared = x * x + y * y + z * z
    squared_safe = jnp.where(squared > 0.0, squared, 1.0)
    inverse = jnp.where(squared > 0.0, 1.0 / jnp.sqrt(squared_safe), 0.0)
    return jnp.maximum(_sum_harmonics(sh, x * inverse, y * inverse, z * inverse) + 0.5, 0.0)


@jax.custom_vjp
def _sum_harmonics(
    sh: Float[Array, "n k 3"], x: Float[Array, " n"], y: Float[Array, " n"], z: Float[Array, " n"]
) -> Float[Array, "3 n"]:
    """Sums coefficient x basis at unit directions, for each channel."""
    basis = harmonics(x, y, z, _degree(sh))
    return jnp.stack([sum(b * sh[:, i, c] for i, b in enumerate(basis)) for c in range(3)])


def _sum_harmonics_fwd(
    sh: Array, x: Array, y: Array, z: Array
) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    return _sum_harmonics(sh, x, y, z), (sh, x, y, z)


def _sum_harmonics_bwd(
    residuals: tuple[Array, Array, Array, Array], cotangent: Float[Array, "3 n"]
) -> tuple[Array, Array, Array, Array]:
    # Written out, for autodiff pads each of 48 columns to a whole array and adds them up, which
    # takes seven times as long.
    sh, x, y, z = residuals
    basis, pull_back = jax.vjp(lambda x, y, z: harmonics(x, y, z, _degree(sh)), x, y, z)
    by_sh = jnp.stack(basis, axis=-1)[:, :, None] * cotangent.T[:, None, :]
    # Where nothing depends on the color, the coefficients may be NaN: they are masked.
    rows = jnp.where((cotangent != 0.0).any(axis=0)[:, None, None], sh, 0.0)
    by_basis = [sum(cotangent[c] * rows[:, i, c] for c in range(3)) for i in range(len(basis))]
    return by_sh, *pull_back(by_basis)


_sum_harmonics.defvjp(_sum_harmonics_fwd, _sum_harmonics_bwd)


def _degree(sh: Float[Array, "n k 3"]) -> int:
    return {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]]
