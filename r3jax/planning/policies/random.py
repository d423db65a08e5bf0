"""The floor of every table: any view that can be reached, chosen by chance."""

from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Array

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import host_generator, local_random, poses_along, random_directions
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decision import (
    PlannerState,
    Stopwatch,
    initial_state,
    look_round,
    no_decision,
    settle,
)
from r3jax.planning.policy import Decision, PlanInfo


@dataclass(frozen=True)
class Random:
    """A random nearby view: the candidates of `ours` (without the frontier's), no score."""

    config: PlannerConfig = field(default_factory=PlannerConfig)

    name = "random"

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """The state before the first frame; nothing in it is random."""
        del key
        return initial_state(camera, grid)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Chance needs no observation."""
        del map_state, frame
        return state

    def decide(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """One of the candidates; `total` is the lot each one drew."""
        del map_state
        stopwatch, config = Stopwatch(), self.config
        position_key, direction_key, lot_key = jax.random.split(key, 3)
        with stopwatch.part("travel"):
            travel = look_round(state, grid, T_world_camera, config)
        with stopwatch.part("candidates"):
            positions = local_random(travel, config.num_candidates, config.radius, key=position_key)
            if len(positions) == 0:
                decision, info = no_decision(travel, config, stopwatch)
                return decision, state, info
            poses = poses_along(positions, random_directions(len(positions), key=direction_key))
        with stopwatch.part("travel"):
            path = travel.lengths(positions)
        lots = host_generator(lot_key).random(len(positions))
        return settle(state, travel, poses, {"path": path, "total": lots}, stopwatch)
