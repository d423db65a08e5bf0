"""Ours and Ours-Pano: go where the closed-form renderability is low (arXiv 2601.07484).

    U_view = U / sum U - lambda2 L / sum L,    U = lambda1 U_G + U_R,  L the path length

Ours scores poses with random directions. Ours-Pano scores positions and takes the best
direction of each one's panorama: one depth buffer per position answers for all directions.

Shape symbols: C candidates, always `config.num_candidates`, so that scoring compiles once.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, frontier
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    local_random,
    poses_along,
    random_directions,
    region_of_interest,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decision import (
    PlannerState,
    Stopwatch,
    initial_state,
    look_round,
    net_utility,
    no_decision,
    settle,
)
from r3jax.planning.explorable import mask_unexplorable
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.travel import Travel
from r3jax.scoring.batch import score_positions, score_views


@dataclass(frozen=True)
class Ours:
    """Random nearby and frontier views, scored by renderability and unexplored space in view."""

    config: PlannerConfig = field(default_factory=PlannerConfig)
    score: Callable[..., Any] = score_views
    """Scores poses [C, 4, 4]; `scoring.batch.score_views` or a stand-in for it."""

    name = "ours"

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """The state before the first frame; nothing in it is random."""
        del key
        return initial_state(camera, grid)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """The map holds all that this policy needs of a frame."""
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
        """The pose with the greatest U_view among the candidates."""
        stopwatch, config = Stopwatch(), self.config
        position_key, direction_key = jax.random.split(key)
        with stopwatch.part("travel"):
            travel = look_round(state, grid, T_world_camera, config)
        with stopwatch.part("candidates"):
            scoring_grid = mask_unexplorable(grid, travel.reachable)
            positions, aims = draw_positions(travel, scoring_grid, config, key=position_key)
            if len(positions) == 0:
                decision, info = no_decision(travel, config, stopwatch)
                return decision, state, info
            directions = random_directions(len(positions), key=direction_key)
            # Candidates for the frontier look at it; the others have no aim.
            is_aimed = np.isfinite(aims[:, :1])
            poses = poses_along(positions, np.where(is_aimed, aims - positions, directions))
        with stopwatch.part("scoring"):
            views = self.score(
                map_state, scoring_grid, state.camera, poses.astype(np.float32), config.scoring
            )
            utilities = {
                "exploration": np.asarray(views.exploration, dtype=np.float64),
                "rendering": np.asarray(views.rendering, dtype=np.float64),
                "utility": np.asarray(views.total, dtype=np.float64),
            }
        return _choose(state, travel, poses, utilities, config, stopwatch)


@dataclass(frozen=True)
class OursPano:
    """Random nearby and frontier positions; each looks where its panorama needs views most."""

    config: PlannerConfig = field(default_factory=PlannerConfig)
    score: Callable[..., Any] = score_positions
    """Scores positions [C, 3]; `scoring.batch.score_positions` or a stand-in for it."""

    name = "ours-pano"

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """The state before the first frame; nothing in it is random."""
        del key
        return initial_state(camera, grid)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """The map holds all that this policy needs of a frame."""
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
        """The position with the greatest U_view of its best direction, and that direction."""
        stopwatch, config = Stopwatch(), self.config
        with stopwatch.part("travel"):
            travel = look_round(state, grid, T_world_camera, config)
        with stopwatch.part("candidates"):
            scoring_grid = mask_unexplorable(grid, travel.reachable)
            positions, _ = draw_positions(travel, scoring_grid, config, key=key)
            if len(positions) == 0:
                decision, info = no_decision(travel, config, stopwatch)
                return decision, state, info
        with stopwatch.part("scoring"):
            panorama = self.score(
                map_state, scoring_grid, state.camera, positions.astype(np.float32), config.scoring
            )
            poses = np.array(panorama.T_world_camera, dtype=np.float64)
            poses[:, :3, 3] = positions  # not rounded to float32: a path ends exactly there
            utilities = {"utility": np.asarray(panorama.best_score, dtype=np.float64)}
        return _choose(state, travel, poses, utilities, config, stopwatch)


def draw_positions(
    travel: Travel, scoring_grid: OccupancyGrid, config: PlannerConfig, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """C positions: up to `num_frontier` in sight of the frontier, the others local.

    Args:
        travel: where the robot can go.
        scoring_grid: the grid without hopeless unexplored cells (`mask_unexplorable`).
        config: how many, and how near.
        key: source of randomness.

    Returns:
        Positions [C, 3] and the frontier cell each one is meant for [C, 3] (NaN for local
        ones), float64 [m]; [0, 3] if the robot can stop nowhere.
    """
    frontier_key, local_key = jax.random.split(key)
    targets = np.asarray(frontier(scoring_grid))
    positions, aims = region_of_interest(travel, targets, config.num_frontier, key=frontier_key)
    local = local_random(
        travel, config.num_candidates - len(positions), config.radius, key=local_key
    )
    positions = np.concatenate([positions, local])
    aims = np.concatenate([aims, np.full_like(local, np.nan)])
    if 0 < len(positions) < config.num_candidates:  # nothing local: repeat, to keep the shape
        repeats = np.arange(config.num_candidates) % len(positions)
        positions, aims = positions[repeats], aims[repeats]
    return positions, aims


def _choose(
    state: PlannerState,
    travel: Travel,
    poses: np.ndarray,
    utilities: dict[str, np.ndarray],
    config: PlannerConfig,
    stopwatch: Stopwatch,
) -> tuple[Decision, PlannerState, PlanInfo]:
    """Weighs utility against path length and takes the best."""
    with stopwatch.part("travel"):
        path = travel.lengths(poses[:, :3, 3])
    total = net_utility(utilities["utility"], path, config.lambda2)
    return settle(state, travel, poses, utilities | {"path": path, "total": total}, stopwatch)
