"""Predicts the map after a view that has not been taken.

Each voxel that the view would show gets a hypothetical observation:

    bins        the bin towards the camera joins them
    resolution  focal / distance, if that is better
    count       n + 1
    m2          m2 n / (n - 1) for n > 1: the variance m2 / (n - 1) stays, as expected if the new
                color scatters like the others: imagined views do not reduce noise

Colors and surfaces stay: unseen space cannot be predicted. So R never decreases, from any position,
and the order of hypothetical views does not matter.

Shape symbols: N rows of the map; n voxels; c cells; M voxels at a time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import Camera
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.seen import mark_rows, seen_in_view, visible_rows
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import visible_unexplored
from r3jax.visibility.views import pinhole_view


@jax.jit
def simulate_view(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> tuple[MapState, Bool[Array, " N"]]:
    """Updates the map by an imagined view.

    Args:
        state: the map before.
        camera: of the view; its focal length in the unit that the map was made with.
        T_world_camera: pose of the view.
        config: range and size of the depth buffer.

    Returns:
        The map, and the voxels that the view shows.
    """
    shown = visible_rows(state, pinhole_view(camera, T_world_camera, config), config)
    return observed(state, shown, T_world_camera[:3, 3], camera.focal), shown


@jax.jit
def imagine_view(
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> tuple[MapState, OccupancyGrid]:
    """Updates map and grid for a decision, as if a view had been taken.

    The unexplored cells that the view would show no longer count.

    Args:
        map_state: the map before.
        grid: the coarse grid before.
        camera: of the view.
        T_world_camera: pose of the view.
        config: range and size of the depth buffer.
    """
    shown = visible_unexplored(map_state, grid, camera, T_world_camera, config)
    after, _ = simulate_view(map_state, camera, T_world_camera, config)
    return after, grid.ignoring(shown)


@jax.jit
def simulate_view_near(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> tuple[MapState, Cells]:
    """Updates gathered voxels and cells by an imagined view.

    The unexplored cells that the view shows are no longer unexplored.

    Args:
        voxels: those that occlude or are visible; `scoring.gather.gather_in_range` gathers them.
        cells: of the coarse grid.
        camera: of the view.
        T_world_camera: pose of the view.
        config: range and size of the depth buffer.
    """
    view = pinhole_view(camera, T_world_camera, config)
    shown, empty = seen_in_view(voxels, cells, view, config)
    after = observed(voxels, shown, T_world_camera[:3, 3], camera.focal)
    return after, cells._replace(unexplored=cells.unexplored & ~empty)


def observed(
    voxels: MapState,
    shown: Bool[Array, " n"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
) -> MapState:
    """Adds one imagined observation to each visible voxel.

    Args:
        voxels: before.
        shown: which of them a camera sees.
        position: its center [m].
        focal: its focal length [px].
    """
    # Bins and resolution by the code of real frames, so that both count alike.
    marked, n = mark_rows(voxels, shown, position, focal), voxels.count
    grows = shown & (n > 1.0)
    m2 = jnp.where(grows, voxels.m2 * n / jnp.maximum(n - 1.0, 1.0), voxels.m2)
    return eqx.tree_at(lambda v: (v.count, v.m2), marked, (n + shown.astype(n.dtype), m2))
