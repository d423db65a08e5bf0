"""Adam with a learning rate for each kind of parameter (Kerbl et al. 2023)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from r3jax.kernels import calls
from r3jax.kernels.constants import BETA1, BETA2, EPSILON
from r3jax.kernels.native.platform import by_platform
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig

# Optax types any tree as its own union of arrays and mappings.
_optax: Any = optax

_HIGHER_HARMONICS = 1.0 / 20.0
"""Learning rate of the view-dependent color, as a share of that of the constant one."""


class Moments(eqx.Module):
    """What Adam remembers."""

    mean: GaussianScene
    """Running mean of the gradients."""

    square: GaussianScene
    """Running mean of their squares."""

    count: Int[Array, ""]
    """Updates so far."""


def empty_moments(scene: GaussianScene) -> Moments:
    """Returns the moments of a scene before its first gradient."""
    # Two sets of buffers: the step gives both away.
    mean, square = (jax.tree.map(jnp.zeros_like, scene) for _ in range(2))
    return Moments(mean=mean, square=square, count=jnp.zeros((), dtype=jnp.int32))


def mean_rate(
    config: TrainConfig, extent: Float[Array, ""], step: Int[Array, ""]
) -> Float[Array, ""]:
    """Computes the learning rate of the centers [m] at iteration `step` (the first is 1).

    It decays exponentially: log rate is linear in the iteration.
    """
    done = jnp.minimum(step / jnp.maximum(config.iterations, 1), 1.0)
    ratio = config.rate_means_last / config.rate_means
    return extent * config.rate_means * jnp.asarray(ratio) ** done


def guarded_update(
    scene: GaussianScene,
    gradient: GaussianScene,
    moments: Moments,
    rate_of_means: Float[Array, ""],
    degree: Int[Array, ""],
    config: TrainConfig,
    is_wanted: Bool[Array, ""],
) -> tuple[GaussianScene, Moments, Bool[Array, ""]]:
    """Takes one step of Adam, unless a parameter or a gradient is not finite.

    Args:
        scene: before.
        gradient: by its parameters.
        moments: before.
        rate_of_means: learning rate of the centers [m].
        degree: harmonics above it have no gradient: they stay as they are, 0 at first.
        config: the other learning rates.
        is_wanted: if not, nothing changes.

    Returns:
        Scene and moments after, and whether the step was done.
    """
    step = by_platform(cpu=_by_kernels, default=_by_formulas)
    return step(scene, gradient, moments, rate_of_means, degree, config, is_wanted)


def _by_formulas(
    scene: GaussianScene,
    gradient: GaussianScene,
    moments: Moments,
    rate_of_means: Float[Array, ""],
    degree: Int[Array, ""],
    config: TrainConfig,
    is_wanted: Bool[Array, ""],
) -> tuple[GaussianScene, Moments, Bool[Array, ""]]:
    is_done = is_wanted & jnp.isfinite(_squared_size(gradient) + _squared_size(scene))
    k = jnp.arange(gradient.sh.shape[1])
    sh = jnp.where((k < (degree + 1) ** 2)[None, :, None], gradient.sh, 0.0)
    gradient = eqx.tree_at(lambda s: s.sh, gradient, sh)
    return *adam_update(scene, gradient, moments, rate_of_means, config, is_done), is_done


def _squared_size(scene: GaussianScene) -> Float[Array, ""]:
    """Sums all squares.

    The sum is not finite if any entry is not, or would overflow Adam's moments.
    """
    return jnp.asarray(sum(jnp.vdot(x, x) for x in jax.tree.leaves(scene)))


def _by_kernels(
    scene: GaussianScene,
    gradient: GaussianScene,
    moments: Moments,
    rate_of_means: Float[Array, ""],
    degree: Int[Array, ""],
    config: TrainConfig,
    is_wanted: Bool[Array, ""],
) -> tuple[GaussianScene, Moments, Bool[Array, ""]]:
    rates = [rate_of_means, config.rate_quats, config.rate_log_scales, config.rate_opacities]
    rates += [config.rate_sh, config.rate_sh * _HIGHER_HARMONICS]
    count = (moments.count + 1).astype(jnp.float32)
    leaves, structure = jax.tree.flatten((scene, moments.mean, moments.square))
    *after, is_done = calls.adam(
        leaves,
        jax.tree.leaves(gradient),
        jnp.stack([jnp.float32(rate) for rate in rates]),
        jnp.stack([1.0 / (1.0 - BETA1**count), 1.0 / (1.0 - BETA2**count)]),
        (degree + 1) ** 2,
        is_wanted,
    )
    scene, mean, square = jax.tree.unflatten(structure, after)
    return scene, Moments(mean, square, moments.count + is_done.astype(jnp.int32)), is_done


def adam_update(
    scene: GaussianScene,
    gradient: GaussianScene,
    moments: Moments,
    rate_of_means: Float[Array, ""],
    config: TrainConfig,
    is_applied: Bool[Array, ""],
) -> tuple[GaussianScene, Moments]:
    """Takes one step of Adam (Kingma & Ba 2015), epsilon 1e-15, bias corrected.

    Unused rows have no gradient and stay as they are. If not `is_applied`, everything does.
    """
    tree = _optax.tree
    keep: Callable[[Array, Array], Array] = lambda new, old: jnp.where(is_applied, new, old)
    count = moments.count + 1
    mean = tree.update_moment(gradient, moments.mean, BETA1, 1)
    square = tree.update_moment_per_elem_norm(gradient, moments.square, BETA2, 2)
    mean = jax.tree.map(keep, mean, moments.mean)
    square = jax.tree.map(keep, square, moments.square)
    mean_hat = tree.bias_correction(mean, BETA1, count.astype(jnp.float32))
    square_hat = tree.bias_correction(square, BETA2, count.astype(jnp.float32))
    higher = jnp.ones((scene.sh.shape[1], 1)).at[1:].set(_HIGHER_HARMONICS)
    rates = {
        "means": rate_of_means,
        "quats": config.rate_quats,
        "log_scales": config.rate_log_scales,
        "opacity_logits": config.rate_opacities,
        "sh": config.rate_sh * higher[None],
    }

    def moved(name: str) -> Array:
        x, m, v = (getattr(tree, name) for tree in (scene, mean_hat, square_hat))
        return keep(x - rates[name] * m / (jnp.sqrt(v) + EPSILON), x)

    count = keep(count, moments.count)
    return GaussianScene(**{name: moved(name) for name in rates}), Moments(mean, square, count)


def forget(moments: Moments, rows: Bool[Array, " n"]) -> Moments:
    """Zeroes the moments of some rows: what now stands there has no past."""

    def zeroed(m: Array) -> Array:
        return jnp.where(rows.reshape((-1,) + (1,) * (m.ndim - 1)), 0.0, m)

    return Moments(
        mean=jax.tree.map(zeroed, moments.mean),
        square=jax.tree.map(zeroed, moments.square),
        count=moments.count,
    )
