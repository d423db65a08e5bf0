"""What the rays of a view would tell: the entropy of their colors.

A ray passes unexplored cells, which hold matter that no photo shows with some probability each, and
ends at a voxel, or nowhere. With k unexplored cells before its end, the color that is seen comes
from something that no photo shows with the probability

    u = 1 - (1 - a)^k V        V of the voxel in the ray's direction; 1 for a ray that ends nowhere

and is then spread as widely as colors are; otherwise it is known up to noise. The entropy of that
mixture, over the noise's, is at most

    H(u) = -u ln u - (1 - u) ln(1 - u) + u h,        h the entropy of any color over the noise's

and equal to it but for what both parts have in common, which is next to nothing.

Shape symbols: C views; h w rays of a view; X Y Z cells of the grid; W words of bins.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from r3jax.baselines.gavis.visibility import unseen_share
from r3jax.geometry.cameras import Camera, pixel_rays
from r3jax.geometry.numerics import safe_norm
from r3jax.mapping.occupancy import OccupancyGrid, world_to_cell
from r3jax.scoring.pixels import PixelView

STRIDE = 4
"""Every fourth pixel of every fourth row has a ray: an unexplored cell at the sensor's range is as
wide as that, and samples of cells are most of the time."""


class RayEnds(eqx.Module):
    """What the rays of a view, or of several, end at."""

    hit: Bool[Array, "*C h w"]
    """True for a voxel, False for nothing within range."""

    depth: Float[Array, "*C h w"]
    """z-depth of the voxel [m]; inf for nothing."""

    offset: Float[Array, "*C 3 h w"]
    """From the voxel to the camera [m]."""

    visited: UInt32[Array, "*C W h w"]
    """Directions from which the voxel was seen."""


class Beliefs(eqx.Module):
    """What is believed of things that no photo shows."""

    kappa: Float[Array, ""]
    """Fall of visibility with the angle."""

    cell_opacity: Float[Array, ""]
    """Probability a that an unexplored cell stops a ray."""

    color_entropy: Float[Array, ""]
    """Entropy h of a color that no photo shows, over that of the noise [nats]."""


def ends_of_rays(view: PixelView) -> RayEnds:
    """Picks the pixels that have rays; `view.rows` are the visited bins."""
    thin = lambda x: x[..., ::STRIDE, ::STRIDE]
    return RayEnds(thin(view.hit), thin(view.depth), thin(view.offset), thin(view.rows))


@partial(jax.jit, static_argnames=("num_bins", "num_steps"))
def entropy_of_views(
    ends: RayEnds,
    grid: OccupancyGrid,
    camera: Camera,
    poses: Float[Array, "C 4 4"],
    max_range: Float[Array, ""],
    beliefs: Beliefs,
    *,
    num_bins: int,
    num_steps: int,
) -> Float[Array, " C"]:
    """Mean over the rays of each view of H(u), [nats].

    Args:
        ends: of the rays of all views.
        grid: whose unexplored cells count.
        camera: of the depth buffer that the rays were picked from.
        poses: of the views.
        max_range: rays go no farther [m].
        beliefs: what is believed of things that no photo shows.
        num_bins: number of direction bins.
        num_steps: cells along the range, rounded up.
    """

    def look(one: tuple[RayEnds, Array]) -> Float[Array, "h w"]:
        ends, pose = one
        direction = ends.offset / jnp.maximum(safe_norm(ends.offset, axis=0), 1e-6)[None]
        unseen = unseen_share(ends.visited, direction, num_bins, beliefs.kappa)
        cells = unexplored_before(ends.depth, grid, camera, pose, max_range, num_steps)
        return unknown_share(ends.hit, unseen, cells, beliefs)

    # Entropies outside of the map: XLA on a CPU would repeat the bins in each of their logarithms.
    shares = jax.lax.map(look, (ends, poses))
    return jnp.mean(entropy(shares, beliefs), axis=(1, 2))


def unknown_share(
    hit: Bool[Array, "h w"],
    unseen: Float[Array, "h w"],
    cells: Float[Array, "h w"],
    beliefs: Beliefs,
) -> Float[Array, "h w"]:
    """u: the probability that a ray's color comes from something that no photo shows."""
    passes = (1.0 - beliefs.cell_opacity) ** cells
    # As a sum of what is small: 1 - passes (1 - unseen) would lose the digits of a known voxel.
    return (1.0 - passes) + passes * jnp.where(hit, unseen, 0.0)


def entropy(share: Float[Array, "*C h w"], beliefs: Beliefs) -> Float[Array, "*C h w"]:
    """H(u) of rays [nats]."""
    known = 1.0 - share
    # xlogy: 0 ln 0 is 0, at rays that are known, or not known, for certain.
    both = -jax.scipy.special.xlogy(share, share) - jax.scipy.special.xlogy(known, known)
    return both + share * beliefs.color_entropy


def unexplored_before(
    depth: Float[Array, "h w"],
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    max_range: Float[Array, ""],
    num_steps: int,
) -> Float[Array, "h w"]:
    """Lengths of rays in unexplored cells, in edges of a cell: one sample per edge (midpoint rule).

    Args:
        depth: z-depth at which the rays end [m].
        grid: the cells.
        camera: of the full depth buffer.
        T_world_camera: its pose.
        max_range: rays go no farther [m].
        num_steps: samples of a ray.
    """
    rays = pixel_rays(camera)[::STRIDE, ::STRIDE]
    # The rays have z = 1: their length turns depth along the axis into distance.
    length = safe_norm(rays, axis=-1)
    end = jnp.minimum(depth * length, max_range)
    R, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
    unit = jnp.matmul(rays / length[..., None], R.T, precision="highest")
    unexplored = grid.unexplored
    at = (jnp.arange(num_steps, dtype=jnp.float32) + 0.5) * grid.cell_size
    points = position[None, None, None] + unit[:, :, None] * at[None, None, :, None]
    cell, size = world_to_cell(grid, points), jnp.array(grid.log_odds.shape)[None, None, None]
    is_inside = jnp.all((cell >= 0) & (cell < size), axis=-1)
    # Clipped for the lookup alone: `is_inside` has refused what lies outside.
    x, y, z = jnp.moveaxis(jnp.clip(cell, 0, size - 1), -1, 0)
    counts = unexplored[x, y, z] & is_inside & (at[None, None] < end[..., None])
    return jnp.sum(counts, axis=-1, dtype=jnp.float32)
