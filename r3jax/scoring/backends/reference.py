"""What a view shows of a map, by the paper's formulas: every voxel, in plain JAX.

Differentiable with respect to the position, the focal length and what is known of the voxels;
what is visible is held fixed. What other backends answer is held to this.

Shape symbols: n voxels; c cells; B bins of the panorama; h w pixels of the depth buffer.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.mapping.state import MapState
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import Forms, ScoringConfig
from r3jax.scoring.deficit import sum_by_direction
from r3jax.scoring.terms import score_voxels
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
    deficit = 1.0 - score_voxels(voxels, position, focal, config.forms).value
    deficit, unexplored = jnp.where(seen, deficit, 0.0), empty.astype(jnp.float32)
    points = jnp.stack([cells.x, cells.y, cells.z])
    return (
        sum_by_direction(voxels.center, deficit, position, num_bins),
        sum_by_direction(points, unexplored, position, num_bins),
    )


def seen_in_view(
    voxels: MapState, cells: Cells, view: View, config: ScoringConfig
) -> tuple[Bool[Array, " n"], Bool[Array, " c"]]:
    """Finds the voxels and the unexplored cells that a view sees."""
    points = jnp.stack([cells.x, cells.y, cells.z])
    seen, empty = visible(voxels, points, view, config)
    return seen, empty & cells.unexplored


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


def voxels_of_rows(voxels: MapState, rows: Int[Array, "h w"]) -> MapState:
    """Gathers the voxel in each pixel, row by row; absent where a pixel shows none."""
    flat = rows.reshape(-1)
    is_hit = flat < voxels.capacity
    return voxels.take(jnp.where(is_hit, flat, 0), is_hit)
