"""What a chooser knows: a map and a grid of the photos that it has chosen, and no others.

Shape symbols: P poses of a pool; n photos chosen.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import (
    OccupancyGrid,
    empty_grid,
    integrate_depth,
    mark_free_ball,
    world_to_cell,
)
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Situation
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.travel import plan_travel

_integrate_depth = jax.jit(integrate_depth)
_mark_free_ball = jax.jit(mark_free_ball)


@dataclass(frozen=True)
class Known:
    """The map of the frames that were shown, and where they were taken."""

    map_state: MapState

    grid: OccupancyGrid

    reached: np.ndarray
    """Cells that a pose of the pool lies in, [X, Y, Z] bool: they count as reachable, as there is
    no robot that must get there."""

    camera: Camera
    """Camera that candidates are scored with."""

    config: ExplorationConfig
    """Of the map and the grid."""

    chosen: tuple[Frame, ...] = ()
    """Frames that were shown, in order."""

    def shown(self, frame: Frame) -> "Known":
        """Adds a frame to the map, the grid and the chosen frames."""
        config = self.config
        grid = _integrate_depth(self.grid, frame, config.max_range)
        return replace(
            self,
            map_state=integrate_growing(self.map_state, frame, config.max_range),
            grid=_mark_free_ball(grid, frame.position, config.body_radius),
            chosen=(*self.chosen, frame),
        )

    def situation(self, memory: Any, *, known_cells: bool = False) -> Situation:
        """Returns the situation that a policy decides in.

        Args:
            memory: what it keeps beside the map.
            known_cells: True tells it that no cell is unexplored.
        """
        position = np.asarray(self.chosen[-1].T_world_camera, dtype=np.float64)[:3, 3]
        travel = plan_travel(self.grid, position, PlannerConfig().safety_margin)
        masked = mask_unexplorable(self.grid, self.reached)
        if known_cells:
            masked = masked.ignoring(np.ones(self.grid.log_odds.shape, dtype=bool))
        return Situation(self.map_state, self.grid, masked, travel, self.camera, memory)


def nothing_known(
    camera: Camera, bounds: np.ndarray, poses: np.ndarray, config: ExplorationConfig
) -> Known:
    """Returns the empty map and grid before the first frame.

    Args:
        camera: that candidates are scored with.
        bounds: box that the grid covers, [2, 3] [m].
        poses: of the pool, [P, 4, 4].
        config: of the map and the grid.
    """
    grid = empty_grid(bounds, config.cell_size)
    cells = np.asarray(world_to_cell(grid, jnp.asarray(poses[:, :3, 3], jnp.float32)))
    reached = np.zeros(grid.log_odds.shape, dtype=bool)
    reached[tuple(cells.T)] = True
    size = (config.capacity, config.voxel_size, config.num_bins)
    map_state = empty_map(*size, remove_moved=config.remove_moved)
    return Known(map_state, grid, reached, camera, config)
