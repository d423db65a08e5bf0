"""The radiance field: a cloud of 3D Gaussians with view-dependent color.

Shape symbols used in splatting/: n Gaussians, k harmonics per color channel (1, 4, 9 or 16), H, W
image size.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.geometry.arguments import one

DEAD_LOGIT = -100.0
"""Opacity logit of an unused row: its opacity rounds to 0, and so does every gradient."""


class GaussianScene(eqx.Module):
    """3D Gaussians as Kerbl et al. (2023) store them: unconstrained parameters, [n, ...] each.

    Rows with an opacity logit of at most half `DEAD_LOGIT` are unused and invisible.
    """

    means: Float[Array, "n 3"]
    """Centers in the world [m]."""

    quats: Float[Array, "n 4"]
    """Rotations, quaternions wxyz of any length but 0."""

    log_scales: Float[Array, "n 3"]
    """Natural logarithm of the standard deviations along the own axes [m]."""

    opacity_logits: Float[Array, " n"]
    """Opacity before the sigmoid."""

    sh: Float[Array, "n k 3"]
    """Coefficients of the real spherical harmonics, RGB; k = (degree + 1)^2. Color is
    max(SH + 0.5, 0)."""

    @property
    def capacity(self) -> int:
        """Number of rows, used or not."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]

    @property
    def is_alive(self) -> Bool[Array, " n"]:
        """True for the rows in use."""
        return self.opacity_logits > 0.5 * DEAD_LOGIT


a_scene = one(GaussianScene, "r3jax.fit and r3jax.read_scene give one", leaf="means", ndim=2)


def empty_scene(capacity: int, sh_degree: int = 3) -> GaussianScene:
    """Makes a scene of unused rows."""
    return GaussianScene(
        means=jnp.zeros((capacity, 3)),
        quats=jnp.zeros((capacity, 4)).at[:, 0].set(1.0),
        log_scales=jnp.zeros((capacity, 3)),
        opacity_logits=jnp.full(capacity, DEAD_LOGIT),
        sh=jnp.zeros((capacity, (sh_degree + 1) ** 2, 3)),
    )
