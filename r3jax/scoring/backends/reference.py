"""What a view shows of a map, by the paper's formulas, in plain JAX.

Differentiable with respect to the position, the focal length and what is known of the voxels;
what is visible is held fixed. What other backends answer is held to this.

Shape symbols: n voxels; c cells; B bins of the panorama; h w pixels of the depth buffer.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.sphere import nearest_bin
from r3jax.geometry.voxels import unpack
from r3jax.mapping.state import MapState
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import Forms, ScoringConfig
from r3jax.scoring.terms import Renderability, score_voxels
from r3jax.visibility.reference import nearest_voxels, visible
from r3jax.visibility.views import View


def sums_in_view(
    voxels: MapState,
    cells: Cells,
    view: View,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """Sums 1 - R over the visible voxels, and counts the visible unexplored cells, by direction.

    Args:
        voxels: of the map.
        cells: of the grid.
        view: what is looked at.
        position: of the camera: that of the view, with the derivative [m].
        focal: focal length of R [px].
        config: settings.
        num_bins: bins of the Fibonacci lattice; 1 sums over all directions.
    """
    seen, empty = seen_in_view(voxels, cells, view, config)
    seen = seen & is_sampled(voxels, config.sample)
    deficit = 1.0 - score_voxels(voxels, position, focal, config.forms).value
    deficit, unexplored = jnp.where(seen, deficit, 0.0), empty.astype(jnp.float32)
    points = jnp.stack([cells.x, cells.y, cells.z])
    return (
        config.sample * sum_by_direction(voxels.center, deficit, position, num_bins),
        sum_by_direction(points, unexplored, position, num_bins),
    )


def change_of_sums(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    kept: Sequence[UInt8[Array, " _"]],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """Sums up what imagined views have changed of `sums_in_view` where the same is seen.

    Args:
        before: voxels and cells before the views.
        after: the same after them (`simulated.simulate_view_near`).
        kept: which voxels (of the sample) and which cells are seen, as bits in bytes.
        position: of the camera [m].
        focal: focal length of R [px].
        forms: of kappa and delta, and the sample.
        num_bins: bins of the Fibonacci lattice.

    Returns:
        Sums of 1 - R after less before, and numbers of cells that are no longer unexplored.
    """
    (voxels, cells), (voxels_after, cells_after) = before, after
    seen, empty = (
        jnp.unpackbits(bits, count=num).astype(bool)
        for bits, num in zip(kept, (voxels.capacity, cells.x.shape[0]), strict=True)
    )
    lack, left = (
        1.0 - score_voxels(known, position, focal, forms).value for known in (voxels, voxels_after)
    )
    # The count tells: an imagined view adds to it in just the voxels that it shows.
    shown = seen & (voxels_after.count > voxels.count)
    explored = empty & cells.unexplored & ~cells_after.unexplored
    points = jnp.stack([cells.x, cells.y, cells.z])
    change = forms.sample * jnp.where(shown, left - lack, 0.0)
    return (
        sum_by_direction(voxels.center, change, position, num_bins),
        sum_by_direction(points, explored.astype(jnp.float32), position, num_bins),
    )


def seen_in_view(
    voxels: MapState, cells: Cells, view: View, config: ScoringConfig
) -> tuple[Bool[Array, " n"], Bool[Array, " c"]]:
    """Finds the voxels and the unexplored cells that a view sees."""
    points = jnp.stack([cells.x, cells.y, cells.z])
    seen, empty = visible(voxels, points, view, config)
    return seen, empty & cells.unexplored


def is_sampled(voxels: MapState, sample: int) -> Bool[Array, " n"]:
    """Tells which voxels stand for `sample` of their neighbors: one of so many in every plane."""
    x, y, z = unpack(voxels.key[0], voxels.key[1])
    # With factors that differ, walls along any axis keep their share, not all of it or none.
    return (x + 3 * y + 2 * z) % sample == 0


def rows_in_pixels(voxels: MapState, view: View) -> Int[Array, "h w"]:
    """Finds the row of the voxel that each pixel of a view shows; n where it shows none."""
    return nearest_voxels(voxels, view)[1]


def mean_in_pixels(
    voxels: MapState,
    view: View,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms,
) -> Float[Array, ""]:
    """Averages R of the voxel that each pixel shows; 0 where it shows none."""
    return mean_of_rows(voxels, rows_in_pixels(voxels, view), position, focal, forms)


def mean_of_rows(
    voxels: MapState,
    rows: Int[Array, "h w"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    forms: Forms,
) -> Float[Array, ""]:
    """Averages R of the voxels in the pixels of an image; 0 where there is none."""
    shown = voxels_of_rows(voxels, rows)
    return jnp.mean(score_voxels(shown, position, focal, forms).value)


def terms_of_rows(
    voxels: MapState, position: Float[Array, " 3"], focal: Float[Array, ""], forms: Forms
) -> Renderability:
    """`score_voxels` of every row; where the position is not finite, every term is NaN."""
    factor = jnp.where(jnp.all(jnp.isfinite(position)), 1.0, jnp.nan)
    terms = score_voxels(voxels, position, focal, forms)
    return jax.tree.map(lambda term: factor * term, terms)


def voxels_of_rows(voxels: MapState, rows: Int[Array, "h w"]) -> MapState:
    """Gathers the voxel in each pixel, row by row; absent where a pixel shows none."""
    flat = rows.reshape(-1)
    is_hit = flat < voxels.capacity
    return voxels.take(jnp.where(is_hit, flat, 0), is_hit)


def sum_by_direction(
    points: Float[Array, "3 n"],
    weight: Float[Array, " n"],
    position: Float[Array, " 3"],
    num_bins: int,
) -> Float[Array, " B"]:
    """Sums weights into the bins in which points lie, seen from a position; 1 bin sums all."""
    if num_bins == 1:
        return jnp.sum(weight, keepdims=True)
    # The choice of the bin is piecewise constant: no derivative passes through it.
    offset = jax.lax.stop_gradient(points - position[:, None])
    direction = offset / jnp.maximum(safe_norm(offset, axis=0), 1e-6)[None, :]
    bins = nearest_bin(direction, num_bins)
    return jnp.zeros(num_bins, dtype=jnp.float32).at[bins].add(weight)
