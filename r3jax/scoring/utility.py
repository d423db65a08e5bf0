"""The utility of a view: U_G (what it would explore) and U_R (how badly it would render now)."""

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float

from r3jax.geometry.arguments import a_camera, a_pose, checked
from r3jax.geometry.cameras import Camera, nan_unless_valid
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid, a_grid, cells_of
from r3jax.mapping.seen import seen_in_view
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.backend import sums_in_view
from r3jax.scoring.config import ScoringConfig, scoring_settings
from r3jax.visibility.views import pinhole_view


class ViewUtility(eqx.Module):
    """The utility of a view, without the cost of the path to it."""

    exploration: Float[Array, ""]
    """U_G: visible unexplored cells."""

    rendering: Float[Array, ""]
    """U_R: sum of (1 - R) over the visible voxels. A sum: a mean would pick close-ups."""

    total: Float[Array, ""]
    """lambda1 U_G + U_R."""


@checked(state=a_map, grid=a_grid, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
@jax.jit
def view_utility(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
) -> ViewUtility:
    """Computes U_G and U_R of one view (arXiv 2601.07484).

    Visible means in the field of view, not hidden by voxels, and within `config.max_range`.
    Written for one pose; `jax.vmap` it over many, or use `scoring.batch.score_views`.
    """
    config = ScoringConfig() if config is None else config
    utility = utility_of_view(state, cells_of(grid), camera, T_world_camera, config)
    factor = nan_unless_valid(camera, T_world_camera, state.voxel_size, grid.cell_size)
    return jax.tree.map(lambda part: factor * part, utility)


def utility_of_view(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> ViewUtility:
    """Computes `view_utility` from gathered voxels and cells."""
    view = pinhole_view(camera, T_world_camera, config)
    position = T_world_camera[:3, 3]
    deficit, unexplored = sums_in_view(voxels, cells, view, position, camera.focal, config, 1)
    exploration, rendering = unexplored[0], deficit[0]
    return ViewUtility(exploration, rendering, config.lambda1 * exploration + rendering)


@jax.jit
def visible_unexplored(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> Bool[Array, "X Y Z"]:
    """Finds the cells that U_G counts."""
    view = pinhole_view(camera, T_world_camera, config)
    _, unexplored = seen_in_view(state, cells_of(grid), view, config)
    return unexplored.reshape(grid.log_odds.shape)
