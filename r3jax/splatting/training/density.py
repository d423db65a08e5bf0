"""How the number of Gaussians changes: adaptive density control, or Markov chain Monte Carlo.

Adaptive density control is that of Kerbl et al. (2023, section 5.2) at fixed capacity. Every
decision is a mask over all rows. New Gaussians go into unused rows; if there are too few, those
with the largest gradients come first and the rest is counted.

In Kheradmand et al. (2024) the number grows slowly to the capacity. Faint Gaussians are moved to
solid ones, so that the rendered image stays the same; noise lets Gaussians explore.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from r3jax.splatting.projection import rotation_rows
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.optimizer import Moments, forget

_STEEPNESS = 100.0
"""Steepness of the gate that keeps noise from solid Gaussians."""

_NODES = np.arange(0.0, 5.0, 0.125)
"""Nodes of the trapezoidal rule; its error falls exponentially for such smooth, even functions."""

_WEIGHTS = np.where(_NODES == 0.0, 0.5, 1.0) * 0.125 * 2.0 / np.sqrt(np.pi)

_LARGEST_OPACITY = 1.0 - 1e-6


SHRINK = 1.6
"""The children of a split are smaller by this factor."""


class DensityStatistics(eqx.Module):
    """Gradients at each Gaussian's center since the last refinement."""

    gradient: Float[Array, " n"]
    """Sum of the lengths of the gradients by the projected center [per half image]."""

    count: Float[Array, " n"]
    """Number of views that saw the Gaussian."""

    @property
    def mean_gradient(self) -> Float[Array, " n"]:
        """Mean over the views that saw it; 0 where none did."""
        return self.gradient / jnp.maximum(self.count, 1.0)


class Refinement(NamedTuple):
    """The result of a refinement."""

    born: Int[Array, ""]
    """Number of new Gaussians."""

    pruned: Int[Array, ""]
    """Number of pruned Gaussians."""

    dropped: Int[Array, ""]
    """Number of Gaussians to clone or split for which there was no free row."""


def empty_statistics(capacity: int) -> DensityStatistics:
    """Returns the statistics of no view."""
    return DensityStatistics(gradient=jnp.zeros(capacity), count=jnp.zeros(capacity))


def observe(
    statistics: DensityStatistics,
    center_gradient: Float[Array, "n 2"],
    in_view: Bool[Array, " n"],
    width: int,
    height: int,
) -> DensityStatistics:
    """Adds one view.

    Args:
        statistics: so far.
        center_gradient: gradient of the loss by the projected centers [per px].
        in_view: True where the center lies in the image.
        width: of the image [px].
        height: of the image [px].
    """
    half = 0.5 * jnp.array([width, height], dtype=jnp.float32)
    # Centers in units of half the image, as the threshold was chosen for (NDC).
    length = jnp.sqrt(jnp.sum((center_gradient * half[None, :]) ** 2, axis=1))
    seen = in_view | (length > 0.0)
    return DensityStatistics(
        gradient=statistics.gradient + length, count=statistics.count + seen.astype(jnp.float32)
    )


def refine(
    scene: GaussianScene,
    moments: Moments,
    statistics: DensityStatistics,
    extent: Float[Array, ""],
    prunes_large: Bool[Array, ""] | bool,
    config: TrainConfig,
    *,
    key: PRNGKeyArray,
) -> tuple[GaussianScene, Moments, Refinement]:
    """Clones small and splits large Gaussians with large gradients; prunes faint ones.

    A clone is an exact copy; the original keeps its moments. A split replaces the parent by two
    Gaussians drawn from it, with scales / 1.6. Newborns start without moments.

    Args:
        scene: before.
        moments: Adam's, before.
        statistics: of the views since the last refinement.
        extent: of the cameras [m].
        prunes_large: also prune Gaussians larger than `config.prune_size` extents.
        config: thresholds.
        key: of the positions of split children.

    Returns:
        The scene and the moments after; all other rows are unchanged.
    """
    size = jnp.exp(jnp.max(scene.log_scales, axis=1))
    is_pulled = scene.is_alive & (statistics.mean_gradient >= config.gradient_threshold)
    is_large = size > config.percent_dense * extent
    prune = _pruned(scene, size, is_pulled & is_large, extent, prunes_large, config)
    wants = is_pulled & ~prune
    free = ~scene.is_alive | prune
    scene = eqx.tree_at(
        lambda s: s.opacity_logits, scene, jnp.where(prune, DEAD_LOGIT, scene.opacity_logits)
    )
    parent, child, is_served = pair_rows(wants, free, statistics.mean_gradient)
    served = _marked(parent, is_served)
    splits = served & is_large
    newborn = _marked(child, is_served)
    scene = copy_rows(scene, parent, child, is_served)
    scene = _split(scene, splits | _marked(child, is_served & splits[parent]), key)
    moments = forget(moments, newborn | splits | prune)
    born = jnp.sum(newborn, dtype=jnp.int32)
    dropped = jnp.sum(wants, dtype=jnp.int32) - born
    return scene, moments, Refinement(born, jnp.sum(prune, dtype=jnp.int32), dropped)


def _pruned(
    scene: GaussianScene,
    size: Float[Array, " n"],
    will_split: Bool[Array, " n"],
    extent: Float[Array, ""],
    prunes_large: Bool[Array, ""] | bool,
    config: TrainConfig,
) -> Bool[Array, " n"]:
    """Finds Gaussians that are too faint, or too large even after a split."""
    is_faint = jax.nn.sigmoid(scene.opacity_logits) < config.prune_opacity
    size_after = jnp.where(will_split, size / SHRINK, size)
    is_huge = jnp.asarray(prunes_large) & (size_after > config.prune_size * extent)
    return scene.is_alive & (is_faint | is_huge)


def pair_rows(
    wants: Bool[Array, " n"], free: Bool[Array, " n"], priority: Float[Array, " n"]
) -> tuple[Int[Array, " n"], Int[Array, " n"], Bool[Array, " n"]]:
    """Assigns free rows to the requesting rows, those of high priority first.

    Returns:
        Row of the k-th parent, row of its child, and whether the pair is real; pairs that are
        not real name arbitrary rows.
    """
    parent = jnp.argsort(jnp.where(wants, -priority, jnp.inf), stable=True)
    child = jnp.argsort(~free, stable=True)
    num_pairs = jnp.minimum(jnp.sum(wants), jnp.sum(free))
    return parent, child, jnp.arange(wants.shape[0]) < num_pairs


def _marked(rows: Int[Array, " n"], is_real: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Marks the rows that are named by real entries."""
    return jnp.zeros(rows.shape[0], dtype=bool).at[rows].max(is_real)


def copy_rows(
    scene: GaussianScene, source: Int[Array, " m"], target: Int[Array, " m"], is_real: Array
) -> GaussianScene:
    """Copies rows over others; targets of real pairs differ, other pairs are ignored."""
    target = jnp.where(is_real, target, scene.capacity)  # out of range: dropped
    return jax.tree.map(lambda x: x.at[target].set(x[source], mode="drop"), scene)


def _split(scene: GaussianScene, rows: Bool[Array, " n"], key: PRNGKeyArray) -> GaussianScene:
    """Moves rows to points drawn from their own Gaussian, and shrinks them."""
    along = jax.random.normal(key, scene.means.shape) * jnp.exp(scene.log_scales)
    means = scene.means + rotated(scene.quats, along)
    return eqx.tree_at(
        lambda s: (s.means, s.log_scales),
        scene,
        (
            jnp.where(rows[:, None], means, scene.means),
            jnp.where(rows[:, None], scene.log_scales - jnp.log(SHRINK), scene.log_scales),
        ),
    )


def rotated(quats: Float[Array, "n 4"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Rotates vectors along the Gaussians' own axes into the world."""
    R = rotation_rows(quats)
    return jnp.stack([sum(R[i][j] * vectors[:, j] for j in range(3)) for i in range(3)], axis=1)


def reset_opacities(
    scene: GaussianScene, moments: Moments, config: TrainConfig
) -> tuple[GaussianScene, Moments]:
    """Lowers all opacities to at most `config.reset_opacity` and resets their moments."""
    limit = jnp.log(config.reset_opacity / (1.0 - jnp.asarray(config.reset_opacity)))
    logits = jnp.minimum(scene.opacity_logits, limit)
    scene = eqx.tree_at(lambda s: s.opacity_logits, scene, logits)
    logits_of: Callable[[Moments], tuple[Array, Array]] = lambda m: (
        m.mean.opacity_logits,
        m.square.opacity_logits,
    )
    return scene, eqx.tree_at(logits_of, moments, (jnp.zeros_like(logits),) * 2)


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


def relocate(
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
