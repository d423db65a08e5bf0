"""U_G, U_R and their sum: what one view would explore and how badly it would render now."""

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float

from r3jax.arguments import a_camera, a_pose, checked
from r3jax.geometry.cameras import Camera, sound
from r3jax.mapping.occupancy import OccupancyGrid, a_grid
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.cells import Cells, cells_of, unexplored_by_direction, visible_cells
from r3jax.scoring.config import ScoringConfig, scoring_settings
from r3jax.scoring.demand import Demand, gain_by_direction
from r3jax.scoring.lack import lack_by_direction
from r3jax.scoring.views import pinhole_view
from r3jax.scoring.visibility import candidates_of, depth_buffer, seen_in
from r3jax.scoring.voxels import Voxels, voxels_of


class ViewUtility(eqx.Module):
    """What a view promises, before the way to it is paid for."""

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
    """U_G and U_R of one view (arXiv 2601.07484).

    Visible means in the field of view, not hidden by voxels, and within `config.max_range`.
    Written for one pose; `jax.vmap` it over many, or use `scoring.batch.score_views`.
    """
    config = ScoringConfig() if config is None else config
    voxels = voxels_of(state, config.delta)
    utility = utility_of_view(voxels, cells_of(grid), camera, T_world_camera, config)
    factor = sound(camera, T_world_camera, state.voxel_size, grid.cell_size)
    return jax.tree.map(lambda part: factor * part, utility)


def utility_of_view(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
    demand: Demand | None = None,
) -> ViewUtility:
    """`view_utility` of voxels and cells that are already at hand.

    With a demand for these voxels, `rendering` is what seeing them would add (`scoring.demand`).
    """
    view = pinhole_view(camera, T_world_camera, config)
    buffer, visible = seen_in(voxels, view, config)
    position = T_world_camera[:3, 3]
    focal = camera.focal
    if demand is None:
        rendering = lack_by_direction(voxels, visible, position, focal, config.kappa, 1)[0]
    else:
        rendering = gain_by_direction(voxels, visible, demand, position, focal, 1)[0]
    seen = visible_cells(cells, view, buffer)
    exploration = unexplored_by_direction(cells, seen, position, 1)[0]
    return ViewUtility(exploration, rendering, config.lambda1 * exploration + rendering)


@jax.jit
def visible_unexplored(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> Bool[Array, "X Y Z"]:
    """The cells that U_G of a view counts."""
    voxels, cells = voxels_of(state, config.delta), cells_of(grid)
    view = pinhole_view(camera, T_world_camera, config)
    buffer = depth_buffer(voxels, candidates_of(voxels, view), view, config)
    return visible_cells(cells, view, buffer).mask.reshape(grid.log_odds.shape)
