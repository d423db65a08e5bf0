"""A policy that decides as if views that others will take had been taken.

Two cameras that know the same would want the same view. The second to decide treats
the first one's view as taken: its effect on the map is simulated (`scoring.simulated`), and the
unexplored cells in it no longer count. Nor are those that lie nearer to where the
other goes, unless nothing else is left: two cameras that see a door go through it one after the
other for nothing. All that holds for one decision: neither the map nor the grid that is kept
learns of it.

Shape symbols: X Y Z cells along the axes; K other cameras.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, frontier_unexplored, squared_distance
from r3jax.mapping.state import MapState
from r3jax.planning.policy import Decision, PlanInfo, Policy
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import imagine_view


@dataclass(frozen=True)
class PromisedView:
    """A view that one robot has decided to take, and that is not taken yet."""

    camera: Camera

    T_world_camera: np.ndarray
    """Its pose, [4, 4]."""


@dataclass
class ReservedViews:
    """Decides as another policy does, on what will be known once the promised views are taken."""

    policy: Policy
    """The robot that decides."""

    promised: tuple[PromisedView, ...]

    scoring: ScoringConfig
    """How far the promised views see."""

    def __post_init__(self) -> None:
        """Goes by the name of the policy, and by its settings."""
        # Others ask a policy for them, `motion_of` for one: they get what the inner one plans with.
        self.name, self.config = self.policy.name, getattr(self.policy, "config", None)

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Any:
        """As the policy does."""
        return self.policy.init(camera, grid, key=key)

    def observe(self, state: Any, map_state: MapState, frame: Frame) -> Any:
        """As the policy does."""
        return self.policy.observe(state, map_state, frame)

    def decide(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, Any, PlanInfo]:
        """Returns the view that the policy would take if the promised ones had been taken."""
        # One after the other: what the first promises to show, the second cannot promise again.
        for view in self.promised:
            pose = jnp.asarray(view.T_world_camera, dtype=jnp.float32)
            map_state, grid = imagine_view(map_state, grid, view.camera, pose, self.scoring)
        others = jnp.asarray([view.T_world_camera[:3, 3] for view in self.promised], jnp.float32)
        here = jnp.asarray(T_world_camera[:3, 3], dtype=jnp.float32)
        # After the promises, so that "nothing left" counts what they leave.
        grid = without_yielded(grid, here, others)
        return self.policy.decide(state, map_state, grid, T_world_camera, key=key)

    def follow(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> Any:
        """As the policy does."""
        return self.policy.follow(state, map_state, grid, T_world_camera, waypoints)


@jax.jit
def without_yielded(
    grid: OccupancyGrid, here: Float[Array, " 3"], others: Float[Array, "K 3"]
) -> OccupancyGrid:
    """Returns the grid for a decision that leaves to others what lies nearer to them.

    Cells that are nearer to one of the others than to here do not count, unless that would leave
    nothing to explore.

    Args:
        grid: the coarse grid.
        here: where the camera is [m].
        others: where the others go [m].
    """
    # Two arrays at a time, never [K, X, Y, Z]; and squares order as distances do, without roots.
    nearest = functools.reduce(jnp.minimum, [squared_distance(grid, other) for other in others])
    is_yielded = nearest < squared_distance(grid, here)
    # Only frontier cells matter: no robot can explore cells that border on no free cell.
    is_left = jnp.any(frontier_unexplored(grid.ignoring(is_yielded)))
    return grid.ignoring(is_yielded & is_left)
