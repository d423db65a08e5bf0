"""The terms of renderability, voxel by voxel: the formulas.

    R = bias x noise x resolution        (arXiv 2601.07484)

Shape symbols: n voxels.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.geometry.numerics import safe_norm, safe_power
from r3jax.mapping.state import MapState
from r3jax.scoring.config import PAPER, Forms
from r3jax.scoring.directions import seen_directions


class Renderability(eqx.Module):
    """The terms of one query, per voxel."""

    kappa: Float[Array, " n"]
    """1 between the seen directions, 2 outside their box."""

    bias: Float[Array, " n"]
    """b = cos(theta)^kappa, theta the angle to the nearest seen direction."""

    delta: Float[Array, " n"]
    """Color consistency of the observations."""

    noise: Float[Array, " n"]
    """eps = delta^(kappa (1 - b)): noise hurts where the view must interpolate."""

    resolution: Float[Array, " n"]
    """gamma = min(1, rho_max / rho)^(1 - delta b), rho = focal / distance."""

    value: Float[Array, " n"]
    """R = b eps gamma, in [0, 1]; 0 for voxels never seen."""


def consistency(
    count: Float[Array, " n"], m2: Float[Array, " n"], form: str = "trace"
) -> Float[Array, " n"]:
    """Computes delta: how consistent the colors of a voxel are, in [0, 1].

    `trace` is Algorithm 2 of arXiv 2601.07484, 1 - sqrt(2 / 1.5) sqrt(tr(M) / (n - 1));
    `pairwise` is its text, one minus the mean squared difference over pairs, which equals
    1 - 2 tr(M) / (n - 1). Both are clipped to [0, 1], and are 1 for n <= 1.
    """
    # The unbiased estimate; the floor avoids a division by zero at the first observation.
    variance = m2 / jnp.maximum(count - 1.0, 1.0)
    spread = 2.0 * variance if form == "pairwise" else jnp.sqrt(2.0 / 1.5 * variance)
    return jnp.where(count > 1.0, jnp.clip(1.0 - spread, 0.0, 1.0), 1.0)


def score_voxels(
    voxels: MapState,
    camera_position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms = PAPER,
    kappa_is_one: Bool[Array, " n"] | None = None,
) -> Renderability:
    """Computes the terms of every voxel as seen from one camera position.

    Args:
        voxels: their statistics.
        camera_position: camera center [m].
        focal: its focal length [px], in the unit used when the map was made.
        forms: of kappa and delta.
        kappa_is_one: whether kappa is 1, if it was determined before; None: computed here.
    """
    delta = consistency(voxels.count, voxels.m2, forms.delta)
    # From the voxel to the camera, as the visited bins were recorded.
    offset = camera_position[:, None] - voxels.center
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    direction = offset / distance[None, :]
    cosine, inside = seen_directions(voxels.visited, direction, voxels.num_bins)
    is_one = (inside > 0.0) | (forms.kappa == "one") if kappa_is_one is None else kappa_is_one
    kappa_value = jnp.where(is_one, 1.0, 2.0)
    # kappa is 1 or 2: a product, not a power, whose gradient could be NaN at 0.
    bias = jnp.where(is_one, cosine, cosine * cosine)
    # delta may be exactly 0, where the gradient of a plain power is infinite or NaN.
    noise = safe_power(delta, kappa_value * (1.0 - bias))
    # rho_max / rho with rho = f / d: coming closer than before costs, staying farther does not.
    ratio = jnp.minimum(voxels.resolution * distance / focal, 1.0)
    resolution = safe_power(ratio, 1.0 - delta * bias)
    blank: Callable[[Array], Array] = lambda term: jnp.where(voxels.present, term, 0.0)
    return Renderability(
        kappa=kappa_value,
        bias=blank(bias),
        delta=delta,
        noise=blank(noise),
        resolution=blank(resolution),
        value=blank(bias * noise * resolution),
    )
