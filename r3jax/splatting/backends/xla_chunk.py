"""The arithmetic of `xla`: a chunk of Gaussians over a batch of tiles, forward and backward.

XLA on a CPU computes whatever several loops need once in each of them, however costly: so the
steps are held apart by `stage`. And its scans are several times slower than written-out chains:
so running products and sums are chains of elementwise operations, in two levels.

Shape symbols: B tiles of a batch, G Gaussians of a chunk, P = 256 pixels of a tile.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.kernels.constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

PIXELS = TILE * TILE


Operation = Callable[[Array, Array], Array]
"""Elementwise, such as a product or a sum."""


class Chunk(eqx.Module):
    """The next Gaussians of every tile of a batch, as its pixels see them."""

    splats: Float[Array, "11 B G"]
    """Center relative to the tile's middle, conic, opacity, RGB, depth, 1; zeros where the tile
    has no more Gaussians."""

    alpha: Float[Array, "B G P"]
    """0 where skipped."""

    weight: Float[Array, "B G P"]
    """What the Gaussian adds to the pixel: 0 once compositing has stopped."""

    through: Float[Array, "B P"]
    """Transmittance behind the last of them."""


def stage(go: Bool[Array, ""], compute: Callable[..., Array], *args: Array) -> Array:
    """Computes compute(*args), into memory: XLA does not merge a branch with its surroundings.

    Args:
        go: true, but not known to be while compiling.
        compute: a function of arrays to one array.
        *args: its arguments.
    """
    result = jax.eval_shape(compute, *args)
    return jax.lax.cond(go, compute, lambda *_: jnp.zeros(result.shape, result.dtype), *args)


def see_chunk(
    go: Bool[Array, ""], splats: Float[Array, "11 B G"], through: Float[Array, "B P"]
) -> Chunk:
    """Evaluates a chunk at the pixels; `through` is the transmittance before it."""
    alpha = stage(go, _alpha, splats)
    products = stage(go, lambda alpha: _chain(1.0 - alpha, jnp.multiply), alpha)
    firsts, last = _link(through, products, jnp.multiply)
    weight = stage(go, _weight, alpha, products, firsts)
    return Chunk(splats=splats, alpha=alpha, weight=weight, through=last)


def chunk_sums(chunk: Chunk) -> Float[Array, "B 5 P"]:
    """Sums weight x (RGB, depth, 1) over the Gaussians of the chunk."""
    return jnp.einsum("kbg,bgp->bkp", chunk.splats[6:], chunk.weight)


def chunk_gradient(
    go: Bool[Array, ""],
    chunk: Chunk,
    wanted: Float[Array, "B 5 P"],
    total: Float[Array, "B P"],
    so_far: Float[Array, "B P"],
) -> tuple[Float[Array, "10 B G"], Float[Array, "B P"]]:
    """Computes the gradient by the splats of a chunk.

    With the transmittance T_i in front, the features c_i and v the cotangent of the pixel:
    alpha_i dL/dalpha_i = T_i alpha_i c_i.v - alpha_i / (1 - alpha_i) sum_(j > i) T_j alpha_j c_j.v

    Args:
        go: see `stage`.
        chunk: the Gaussians.
        wanted: v.
        total: sum of T alpha c.v over all Gaussians of the pixel.
        so_far: the same over those before this chunk.

    Returns:
        The gradient by center, conic, opacity, RGB and depth, and `so_far` with this chunk.
    """
    value = jnp.einsum("kbg,bkp->bgp", chunk.splats[6:], wanted)
    gain = stage(go, jnp.multiply, chunk.weight, value)
    sums = stage(go, partial(_chain, op=jnp.add), gain)
    firsts, last = _link(so_far, sums, jnp.add)
    pull = stage(go, _pull, chunk.alpha, chunk.weight, gain, sums, firsts, total)
    shape = _shape_gradient(chunk.splats, jnp.einsum("bgp,pm->mbg", pull, _moments()))
    features = jnp.einsum("bgp,bkp->kbg", chunk.weight, wanted[:, :4])
    return jnp.concatenate([shape, features]), last


def _alpha(splats: Float[Array, "11 B G"]) -> Float[Array, "B G P"]:
    """Computes min(0.99, o exp(-s)) at each pixel of the tile, 0 where it is skipped."""
    x, y, xx, xy, yy, opacity = splats[:6, :, :, None]
    px, py = (c[None, None, :] for c in pixel_offsets())
    dx, dy = x - px, y - py
    s = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = jnp.minimum(ALPHA_MAX, opacity * jnp.exp(-s))
    return jnp.where((alpha >= ALPHA_MIN) & (s >= 0.0), alpha, 0.0)


def _weight(
    alpha: Float[Array, "B G P"], products: Float[Array, "B O I P"], firsts: Float[Array, "B O P"]
) -> Float[Array, "B G P"]:
    """Computes T_i alpha_i, from the transmittance T_i (1 - alpha_i) behind the Gaussian."""
    behind = (firsts[:, :, None] * products).reshape(alpha.shape)
    return jnp.where(behind > TRANSMITTANCE_MIN, behind * (alpha / (1.0 - alpha)), 0.0)


def _pull(
    alpha: Float[Array, "B G P"],
    weight: Float[Array, "B G P"],
    gain: Float[Array, "B G P"],
    sums: Float[Array, "B O I P"],
    firsts: Float[Array, "B O P"],
    total: Float[Array, "B P"],
) -> Float[Array, "B G P"]:
    """Computes alpha dL/dalpha; 0 where alpha is clipped, since it is constant there."""
    later = total[:, None, :] - (firsts[:, :, None] + sums).reshape(alpha.shape)
    pull = gain - later * (alpha / (1.0 - alpha))
    return jnp.where((weight > 0.0) & (alpha < ALPHA_MAX), pull, 0.0)


def _shape_gradient(
    splats: Float[Array, "11 B G"], moments: Float[Array, "6 B G"]
) -> Float[Array, "6 B G"]:
    """Computes the gradient by center, conic and opacity.

    Args:
        splats: the Gaussians.
        moments: of alpha dL/dalpha = -dL/ds about the tile's middle, see `_moments`.
    """
    x, y, xx, xy, yy, opacity = splats[:6]
    one, mx, my, mxx, mxy, myy = moments
    # About the Gaussian's center: the sums of d, d d^T with d = center - pixel.
    dx, dy = x * one - mx, y * one - my
    dxx = x * (dx - mx) + mxx
    dxy = x * dy - y * mx + mxy
    dyy = y * (dy - my) + myy
    by_opacity = one / jnp.where(opacity > 0.0, opacity, 1.0)
    by_center = [-(xx * dx + xy * dy), -(xy * dx + yy * dy)]
    return jnp.stack([*by_center, -0.5 * dxx, -dxy, -0.5 * dyy, by_opacity])


def _chain(x: Float[Array, "B G P"], op: Operation) -> Float[Array, "B O I P"]:
    """Computes running products or sums within blocks of up to 8 elements of G."""
    tiles, size, pixels = x.shape
    inner = max(d for d in range(1, 9) if size % d == 0)
    blocks = x.reshape(tiles, size // inner, inner, pixels)
    chain = [blocks[:, :, 0]]
    for i in range(1, inner):
        chain.append(op(chain[-1], blocks[:, :, i]))
    return jnp.stack(chain, axis=2)


def _link(
    start: Float[Array, "B P"], chains: Float[Array, "B O I P"], op: Operation
) -> tuple[Float[Array, "B O P"], Float[Array, "B P"]]:
    """Chains the blocks of `_chain` from `start` on: the values before each, and after the last."""
    firsts = [start]
    for i in range(chains.shape[1]):
        firsts.append(op(firsts[-1], chains[:, i, -1]))
    return jnp.stack(firsts[:-1], axis=1), firsts[-1]


def pixel_offsets() -> tuple[Float[Array, " P"], Float[Array, " P"]]:
    """Computes the centers of a tile's pixels, row by row, relative to its middle [px]."""
    along = jnp.arange(TILE, dtype=jnp.float32) - 0.5 * (TILE - 1)
    return jnp.tile(along, TILE), jnp.repeat(along, TILE)


def _moments() -> Float[Array, "P 6"]:
    """Computes 1, x, y, x^2, xy, y^2 at a tile's pixels."""
    x, y = pixel_offsets()
    return jnp.stack([jnp.ones(PIXELS), x, y, x * x, x * y, y * y], axis=-1)
