"""The terms of renderability, voxel by voxel: the formulas.

    R = bias x noise x resolution        (arXiv 2601.07484)

Shape symbols: n voxels; W words of bins; B bins.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from r3jax.geometry.numerics import safe_norm, safe_power
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.kernels.constants import ON_EDGE
from r3jax.mapping.state import MapState
from r3jax.scoring.config import PAPER, Score


class Renderability(eqx.Module):
    """The terms of one query, per voxel; `ScoringConfig` may raise them to a power."""

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
    camera_position: Float[Array, " 3"] | Float[Array, "3 n"],
    focal: Float[Array, ""],
    score: Score = PAPER,
    kappa_is_one: Bool[Array, " n"] | None = None,
) -> Renderability:
    """Computes the terms of every voxel as seen from one camera position, or from one of its own.

    Args:
        voxels: their statistics.
        camera_position: camera center, or one for each voxel [m].
        focal: its focal length [px], in the unit used when the map was made.
        score: forms of kappa and delta, powers of the terms, and another R than their product.
        kappa_is_one: whether kappa is 1, if it was determined before; None: computed here.
    """
    delta = consistency(voxels.count, voxels.m2, score.forms.delta)
    # From the voxel to the camera, as the visited bins were recorded.
    position = camera_position if camera_position.ndim == 2 else camera_position[:, None]
    offset = position - voxels.center
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    direction = offset / distance[None, :]
    cosine, inside = seen_directions(voxels.visited, direction, voxels.num_bins)
    is_one = (inside > 0.0) | (score.forms.kappa == "one") if kappa_is_one is None else kappa_is_one
    kappa_value = jnp.where(is_one, 1.0, 2.0)
    # kappa is 1 or 2: a product, not a power, whose gradient could be NaN at 0.
    bias = jnp.where(is_one, cosine, cosine * cosine)
    # delta may be exactly 0, where the gradient of a plain power is infinite or NaN.
    noise = safe_power(delta, kappa_value * (1.0 - bias))
    # rho_max / rho with rho = f / d: coming closer than before costs, staying farther does not.
    ratio = jnp.minimum(voxels.resolution * distance / focal, 1.0)
    resolution = safe_power(ratio, 1.0 - delta * bias)
    bias, noise, resolution = (
        term if power is None else safe_power(term, jnp.broadcast_to(power, term.shape))
        for term, power in zip((bias, noise, resolution), score.powers, strict=True)
    )
    blank: Callable[[Array], Array] = lambda term: jnp.where(voxels.present, term, 0.0)
    terms = Renderability(
        kappa=kappa_value,
        bias=blank(bias),
        delta=delta,
        noise=blank(noise),
        resolution=blank(resolution),
        value=blank(bias * noise * resolution),
    )
    if score.combine is None:
        return terms
    own = blank(jnp.clip(score.combine(voxels, terms), 0.0, 1.0))
    return eqx.tree_at(lambda t: t.value, terms, own)


def deficits(
    voxels: MapState,
    camera_position: Float[Array, " 3"],
    focal: Float[Array, ""],
    score: Score,
    kappa_is_one: Bool[Array, " n"] | None = None,
) -> Float[Array, " n"]:
    """Computes 1 - R of every voxel, times its importance; arguments as in `score_voxels`."""
    terms = score_voxels(voxels, camera_position, focal, score, kappa_is_one)
    return deficits_of(voxels, terms, score)


def deficits_of(voxels: MapState, terms: Renderability, score: Score) -> Float[Array, " n"]:
    """Computes `deficits` from known terms."""
    deficit = 1.0 - terms.value
    return deficit if score.importance is None else score.importance(voxels) * deficit


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def seen_directions(
    visited: UInt32[Array, "W n"], direction: Float[Array, "3 n"], num_bins: int
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Compares new directions with the bins from which voxels were seen.

    Per voxel, with r the new direction and q_k the visited bins (arXiv 2601.07484):

        cosine = max_k <q_k, r>, clamped to [0, 1]
        inside = 1 if the origin lies in the bounding box of the bins with <q_k, r> > 0,
                 projected on the tangent plane at r; else 0

    Only signs of the tangent coordinates matter for the box, so the axes up x r and r x (up x r)
    are left unnormalized. The loop runs over bins and is vectorized over voxels; its cost is about
    20 operations per bin and voxel.

    Args:
        visited: bit `k % 32` of word `k // 32` for each visited bin k.
        direction: unit vectors from the voxels to the camera.
        num_bins: number of bins B.

    Returns:
        `cosine` and `inside`. The derivative of `cosine` is that of the nearest bin's product;
        `inside` is piecewise constant.
    """
    # One array of pairs behind a branch: otherwise XLA on a CPU would fuse, and so repeat, the scan
    # over the bins into every kernel that uses one of its results.
    pairs = jax.lax.cond(
        jnp.any(visited != jnp.uint32(0)),
        lambda: jax.lax.complex(*_scan(visited, direction, num_bins)[:2]),
        lambda: jnp.zeros(direction.shape[1], dtype=jnp.complex64),
    )
    return pairs.real, pairs.imag


@seen_directions.defjvp
def _seen_directions_jvp(
    num_bins: int,
    primals: tuple[UInt32[Array, "W n"], Float[Array, "3 n"]],
    tangents: tuple[Any, Float[Array, "3 n"]],
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    visited, direction = primals
    cosine, inside, nearest = _scan(visited, direction, num_bins, keep_nearest=True)
    moved = sum(nearest[axis] * tangents[1][axis] for axis in range(3))
    is_free = (cosine > 0.0) & (cosine < 1.0)  # the clamp is flat outside
    return (cosine, inside), (jnp.where(is_free, moved, 0.0), jnp.zeros_like(inside))


def nearest_seen(
    visited: UInt32[Array, "W ..."], direction: Float[Array, "3 ..."], num_bins: int
) -> Float[Array, "..."]:
    """Computes the cosine max_k <q_k, r> over the visited bins, in [-1, 1].

    It is -1 if no bin was visited.

    Args:
        visited: as in `seen_directions`.
        direction: unit vectors from the voxels to the camera.
        num_bins: number of bins B.
    """
    x, y, z = direction
    best = jnp.full_like(x, -1.0)
    for k, (q_x, q_y, q_z) in enumerate(fibonacci_lattice(num_bins).astype("float32").tolist()):
        is_visited = (visited[k // 32] & jnp.uint32(1 << (k % 32))) != jnp.uint32(0)
        cosine = q_x * x + q_y * y + q_z * z
        best = jnp.maximum(best, jnp.where(is_visited, cosine, -1.0))
    return best


# Jitted: a thousand operations are then traced once per size, not once per program.
@functools.partial(jax.jit, static_argnames=("num_bins", "keep_nearest"))
def _scan(
    visited: UInt32[Array, "W n"],
    direction: Float[Array, "3 n"],
    num_bins: int,
    *,
    keep_nearest: bool = False,
) -> tuple[Float[Array, " n"], Float[Array, " n"], tuple[Array, ...]]:
    x, y, z = direction
    is_pole = x * x + y * y < 1e-12
    # Tangent axes: a = up x r = (-y, x, 0), or the x axis at the poles; b = r x a.
    a_x, a_y = jnp.where(is_pole, 1.0, -y), jnp.where(is_pole, 0.0, x)
    b_x, b_y, b_z = -z * a_y, z * a_x, x * a_y - y * a_x
    # A voxel without bins keeps -1, which the clamp turns into 0.
    lowest, zero = jnp.full_like(x, -1.0), jnp.zeros_like(x)
    best, nearest = lowest, (zero, zero, zero)
    # Empty boxes have inverted bounds, so that they do not contain the origin.
    a_low = b_low = jnp.full_like(x, jnp.inf)
    a_high = b_high = jnp.full_like(x, -jnp.inf)
    # Python floats: the lattice becomes constants of the program, without a gather.
    for k, (q_x, q_y, q_z) in enumerate(fibonacci_lattice(num_bins).astype("float32").tolist()):
        is_visited = (visited[k // 32] & jnp.uint32(1 << (k % 32))) != jnp.uint32(0)
        cosine = jnp.where(is_visited, q_x * x + q_y * y + q_z * z, -1.0)
        if keep_nearest:
            is_better = cosine > best
            nearest = tuple(
                jnp.where(is_better, q, old)
                for q, old in zip((q_x, q_y, q_z), nearest, strict=True)
            )
        best = jnp.maximum(best, cosine)
        # By the paper's text the bins on the camera's side of the tangent plane span the box.
        is_ahead = cosine > 0.0
        a = q_x * a_x + q_y * a_y
        b = q_x * b_x + q_y * b_y + q_z * b_z
        a_low = jnp.minimum(a_low, jnp.where(is_ahead, a, jnp.inf))
        a_high = jnp.maximum(a_high, jnp.where(is_ahead, a, -jnp.inf))
        b_low = jnp.minimum(b_low, jnp.where(is_ahead, b, jnp.inf))
        b_high = jnp.maximum(b_high, jnp.where(is_ahead, b, -jnp.inf))
    is_inside = (a_low <= ON_EDGE) & (a_high >= -ON_EDGE)
    is_inside &= (b_low <= ON_EDGE) & (b_high >= -ON_EDGE)
    return jnp.clip(best, 0.0, 1.0), is_inside.astype(x.dtype), nearest
