"""Adam with a learning rate for each kind of parameter (Kerbl et al. 2023)."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training_config import TrainConfig

Moments = optax.ScaleByAdamState
"""Adam's running means of the gradients and of their squares, and the number of updates."""

# Optax types any tree as its own union of arrays and mappings.
_ADAM: Any = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-15)

_HIGHER_HARMONICS = 1.0 / 20.0
"""Learning rate of the view-dependent color, as a share of that of the constant one."""


def empty_moments(scene: GaussianScene) -> Moments:
    """Moments of a scene that has seen no gradient."""
    return _ADAM.init(scene)


def mean_rate(
    config: TrainConfig, extent: Float[Array, ""], step: Int[Array, ""]
) -> Float[Array, ""]:
    """Learning rate of the centers [m] at iteration `step` (the first is 1).

    It decays exponentially: log rate is linear in the iteration.
    """
    done = jnp.minimum(step / jnp.maximum(config.iterations, 1), 1.0)
    ratio = config.rate_means_last / config.rate_means
    return extent * config.rate_means * jnp.asarray(ratio) ** done


def adam_update(
    scene: GaussianScene,
    gradient: GaussianScene,
    moments: Moments,
    rate_of_means: Float[Array, ""],
    config: TrainConfig,
) -> tuple[GaussianScene, Moments]:
    """One step of Adam (Kingma & Ba 2015), epsilon 1e-15, bias corrected.

    Unused rows have no gradient and stay as they are.
    """
    direction, moments = _ADAM.update(gradient, moments)
    higher = jnp.ones((scene.sh.shape[1], 1)).at[1:].set(_HIGHER_HARMONICS)
    updated = GaussianScene(
        means=scene.means - rate_of_means * direction.means,
        quats=scene.quats - config.rate_quats * direction.quats,
        log_scales=scene.log_scales - config.rate_log_scales * direction.log_scales,
        opacity_logits=scene.opacity_logits - config.rate_opacities * direction.opacity_logits,
        sh=scene.sh - (config.rate_sh * higher)[None] * direction.sh,
    )
    return updated, moments


def forget(moments: Moments, rows: Bool[Array, " n"]) -> Moments:
    """Zeroes the moments of some rows: what now stands there has no past."""
    zeroed = lambda m: jnp.where(rows.reshape((-1,) + (1,) * (m.ndim - 1)), 0.0, m)
    return moments._replace(
        mu=jax.tree.map(zeroed, moments.mu), nu=jax.tree.map(zeroed, moments.nu)
    )
