"""The paper's formulas in plain JAX, summed over what a view shows.

Differentiable with respect to the position, the focal length and the voxels' statistics; visibility
is held fixed. Tests compare the kernels with these formulas.

Shape symbols: n voxels; c cells; B bins of the panorama; h w pixels of the depth buffer.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.sphere import nearest_bin
from r3jax.kernels.calls import Cells
from r3jax.mapping.state import MapState
from r3jax.scoring.config import Score, ScoringConfig
from r3jax.scoring.terms import deficits, score_voxels
from r3jax.visibility.depth_buffer import depth_buffer, visible
from r3jax.visibility.views import View, VisibilityConfig


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
        view: the view.
        position: camera center, equal to the view's; carries the derivative [m].
        focal: focal length of R [px].
        config: settings.
        num_bins: bins of the Fibonacci lattice; 1 sums over all directions.
    """
    seen, empty = seen_in_view(voxels, cells, view, config)
    return sums_of_seen(voxels, cells, (seen, empty), position, focal, config.score, num_bins)


def sums_of_seen(
    voxels: MapState,
    cells: Cells,
    seen: tuple[Bool[Array, " n"], Bool[Array, " c"]],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    score: Score,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """Computes `sums_in_view` for known visibility."""
    deficit = deficits(voxels, position, focal, score)
    deficit, unexplored = jnp.where(seen[0], deficit, 0.0), seen[1].astype(jnp.float32)
    points = jnp.stack([cells.x, cells.y, cells.z])
    return (
        sum_by_direction(voxels.center, deficit, position, num_bins),
        sum_by_direction(points, unexplored, position, num_bins),
    )


def change_of_sums(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    kept: Sequence[UInt8[Array, " _"]],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    score: Score,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """Computes how imagined views change `sums_in_view`; visibility stays the same.

    Args:
        before: voxels and cells before the views.
        after: the same after them (`simulated.simulate_view_near`).
        kept: visible voxels and cells, as bits in bytes.
        position: of the camera [m].
        focal: focal length of R [px].
        score: how R is computed.
        num_bins: bins of the Fibonacci lattice.

    Returns:
        Differences of the sums of 1 - R, and numbers of cells that are no longer unexplored.
    """
    (voxels, cells), (voxels_after, cells_after) = before, after
    seen, empty = (
        jnp.unpackbits(bits, count=num).astype(bool)
        for bits, num in zip(kept, (voxels.capacity, cells.x.shape[0]), strict=True)
    )
    deficit, left = (deficits(known, position, focal, score) for known in (voxels, voxels_after))
    # An imagined view adds to the count of just the voxels that it shows.
    shown = seen & (voxels_after.count > voxels.count)
    explored = empty & cells.unexplored & ~cells_after.unexplored
    points = jnp.stack([cells.x, cells.y, cells.z])
    return (
        sum_by_direction(voxels.center, jnp.where(shown, left - deficit, 0.0), position, num_bins),
        sum_by_direction(points, explored.astype(jnp.float32), position, num_bins),
    )


def seen_in_view(
    voxels: MapState, cells: Cells, view: View, config: VisibilityConfig
) -> tuple[Bool[Array, " n"], Bool[Array, " c"]]:
    """Finds the voxels and the unexplored cells that a view sees."""
    points = jnp.stack([cells.x, cells.y, cells.z])
    seen, empty = visible(voxels.voxels, points, view, config)
    return seen, empty & cells.unexplored


def rows_in_pixels(voxels: MapState, view: View) -> Int[Array, "h w"]:
    """Finds the row of the voxel in each pixel of a view; n where there is none."""
    return depth_buffer(voxels.voxels, view, VisibilityConfig()).row


def mean_in_pixels(
    voxels: MapState,
    view: View,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    score: Score,
) -> Float[Array, ""]:
    """Averages R over the pixels of a view; pixels without a voxel count as 0."""
    return mean_of_rows(voxels, rows_in_pixels(voxels, view), position, focal, score)


def mean_of_rows(
    voxels: MapState,
    rows: Int[Array, "h w"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    score: Score,
) -> Float[Array, ""]:
    """Averages R over the pixels of an image; pixels without a voxel count as 0.

    An importance weighs the pixels; one without a voxel has a weight of 1.
    """
    shown = voxels_of_rows(voxels, rows)
    value = score_voxels(shown, position, focal, score).value
    if score.importance is None:
        return jnp.mean(value)
    weight = jnp.where(shown.present, score.importance(shown), 1.0)
    return jnp.sum(weight * value) / jnp.maximum(jnp.sum(weight), 1e-9)


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
    """Sums the weights of points by direction bin, as seen from a position.

    A single bin sums all weights.
    """
    if num_bins == 1:
        return jnp.sum(weight, keepdims=True)
    # The choice of the bin is piecewise constant: no derivative passes through it.
    offset = jax.lax.stop_gradient(points - position[:, None])
    direction = offset / jnp.maximum(safe_norm(offset, axis=0), 1e-6)[None, :]
    bins = nearest_bin(direction, num_bins)
    return jnp.zeros(num_bins, dtype=jnp.float32).at[bins].add(weight)
