"""Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024).

The number of Gaussians grows slowly to the capacity. Faint ones are moved to where solid ones
stand, so that the rendered image stays as it is; noise lets Gaussians explore.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.density import Refinement, copy_rows, rotated
from r3jax.splatting.training.optimizer import Moments, forget

_STEEPNESS = 100.0
"""Steepness of the gate that keeps noise from solid Gaussians."""

_NODES = np.arange(0.0, 5.0, 0.125)
"""Nodes of the trapezoidal rule; its error falls exponentially for such smooth, even functions."""

_WEIGHTS = np.where(_NODES == 0.0, 0.5, 1.0) * 0.125 * 2.0 / np.sqrt(np.pi)

_LARGEST_OPACITY = 1.0 - 1e-6


def regularization(scene: GaussianScene, config: TrainConfig) -> Float[Array, ""]:
    """Computes weighted mean opacity plus weighted mean scale [m] of the rows in use (eq. 10)."""
    alive = scene.is_alive
    num = jnp.maximum(jnp.sum(alive), 1).astype(jnp.float32)
    opacity = jnp.sum(jnp.where(alive, jax.nn.sigmoid(scene.opacity_logits), 0.0))
    scale = jnp.sum(jnp.where(alive[:, None], jnp.exp(scene.log_scales), 0.0))
    return config.opacity_weight * opacity / num + config.scale_weight * scale / (3.0 * num)


def perturbed(
    scene: GaussianScene,
    rate_of_means: Float[Array, ""],
    config: TrainConfig,
    *,
    key: PRNGKeyArray,
) -> GaussianScene:
    """Adds noise to the centers (eq. 8): rate x noise x gate(opacity) x covariance x normal.

    The gate sigmoid(100 (0.005 - opacity)) lets only faint Gaussians move; the covariance keeps
    the noise along their surface.
    """
    gate = jax.nn.sigmoid(
        _STEEPNESS * (config.prune_opacity - jax.nn.sigmoid(scene.opacity_logits))
    )
    gate = jnp.where(scene.is_alive, gate, 0.0)
    normal = jax.random.normal(key, scene.means.shape)
    variances = jnp.exp(2.0 * scene.log_scales)
    conjugate = scene.quats * jnp.array([[1.0, -1.0, -1.0, -1.0]])
    colored = rotated(scene.quats, variances * rotated(conjugate, normal))
    noise = (config.noise * rate_of_means * gate)[:, None] * colored
    noise = jnp.where(jnp.isfinite(noise), noise, 0.0)  # variances overflow at scales of e^44 m
    return eqx.tree_at(lambda s: s.means, scene, scene.means + noise)


def refine(
    scene: GaussianScene, moments: Moments, config: TrainConfig, *, key: PRNGKeyArray
) -> tuple[GaussianScene, Moments, Refinement]:
    """Moves faint Gaussians to solid ones, then adds new ones there.

    Returns:
        The scene and the moments after. Nothing is ever dropped: the capacity is the budget.
    """
    key_move, key_grow = jax.random.split(key)
    is_faint = scene.is_alive & (jax.nn.sigmoid(scene.opacity_logits) <= config.prune_opacity)
    has_solid = jnp.any(scene.is_alive & ~is_faint)  # else there is nowhere to move to
    is_faint = is_faint & has_solid
    scene, moments = respawn(scene, moments, is_faint, config, key=key_move)
    num_alive = jnp.sum(scene.is_alive, dtype=jnp.int32)
    wanted = (config.growth * num_alive.astype(jnp.float32)).astype(jnp.int32)
    free = ~scene.is_alive
    born = jnp.where(has_solid, jnp.minimum(wanted, jnp.sum(free, dtype=jnp.int32)), 0)
    scene, moments = respawn(
        scene, moments, free & (jnp.cumsum(free) <= born), config, key=key_grow
    )
    moved = jnp.sum(is_faint, dtype=jnp.int32)
    return scene, moments, Refinement(born, moved, jnp.zeros_like(born))


def respawn(
    scene: GaussianScene,
    moments: Moments,
    rows: Bool[Array, " n"],
    config: TrainConfig,
    *,
    key: PRNGKeyArray,
) -> tuple[GaussianScene, Moments]:
    """Makes `rows` copies of other Gaussians, drawn by opacity, and shares the opacity out.

    There must be others in use.

    A Gaussian that now stands N times gets the opacity and the scales of eq. 9. The moments of
    all that changed are forgotten.
    """
    opacity = jax.nn.sigmoid(scene.opacity_logits)
    weight = jnp.where(scene.is_alive & ~rows, opacity, 0.0)
    source = _drawn(weight, key)
    copies = jnp.zeros(scene.capacity, dtype=jnp.int32).at[source].add(rows.astype(jnp.int32))
    is_shared = copies > 0
    shared_opacity, factor = shared(opacity, copies + 1)
    limited = jnp.clip(shared_opacity, config.prune_opacity, _LARGEST_OPACITY)
    logits = jnp.log(limited) - jnp.log1p(-limited)
    scene = eqx.tree_at(
        lambda s: (s.opacity_logits, s.log_scales),
        scene,
        (
            jnp.where(is_shared, logits, scene.opacity_logits),
            scene.log_scales + jnp.where(is_shared, jnp.log(factor), 0.0)[:, None],
        ),
    )
    scene = copy_rows(scene, source, jnp.arange(scene.capacity), rows)
    return scene, forget(moments, rows | is_shared)


def _drawn(weight: Float[Array, " n"], key: PRNGKeyArray) -> Int[Array, " n"]:
    """Draws as many rows as there are, with replacement in proportion to their weights."""
    cumulative = jnp.cumsum(weight)
    point = jax.random.uniform(key, weight.shape) * cumulative[-1]
    row = jnp.searchsorted(cumulative, point, side="right")
    # Rounding may put a point at the very end: the last row of any weight takes it.
    last = jnp.max(jnp.where(weight > 0.0, jnp.arange(weight.shape[0]), 0))
    return jnp.minimum(row, last)


def shared(
    opacity: Float[Array, " n"], number: Int[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Computes opacity and scale of `number` Gaussians that together look like one (eq. 9).

        o' = 1 - (1 - o)^(1/N)
        scale' / scale = o / sum_{i=1..N} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1)

    The double sum cancels badly in float32 for large N. It equals the integral over a line
    through all N Gaussians of what they hide together,

        2 / sqrt(pi)  integral_0^inf  1 - (1 - o' exp(-x^2))^N  dx,

    which has only positive terms (the sum over i is geometric, and 1/sqrt(k+1) is the integral
    of exp(-(k+1) x^2)) and holds for any N.

    Args:
        opacity: of the one, in [0, 1).
        number: how many take its place, at least 1.

    Returns:
        Opacity of each, and the factor of all their scales.
    """
    opacity = jnp.minimum(opacity, _LARGEST_OPACITY)
    count = number.astype(jnp.float32)
    share = -jnp.expm1(jnp.log1p(-opacity) / count)
    bell = jnp.asarray(np.exp(-(_NODES**2)), dtype=jnp.float32)
    hidden = -jnp.expm1(count[:, None] * jnp.log1p(-share[:, None] * bell[None, :]))
    line = hidden @ jnp.asarray(_WEIGHTS, dtype=jnp.float32)
    return share, jnp.where(line > 0.0, opacity / jnp.where(line > 0.0, line, 1.0), 1.0)
