"""What most policies are: draw candidates, score them, take the best. Each fills in the parts."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Array

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, frontier
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    host_generator,
    local_random,
    poses_along,
    random_directions,
    region_of_interest,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decision import (
    PlannerState,
    Stopwatch,
    follow_way,
    initial_state,
    net_utility,
    no_decision,
    prepare_decision,
    select_best,
)
from r3jax.planning.limits import Limits
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.refine import refine_best
from r3jax.planning.situation import Situation
from r3jax.planning.travel import Travel
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.pixels import Value, score_pixels


@dataclass(frozen=True)
class Drawn:
    """The candidates of one decision."""

    poses: np.ndarray
    """[C, 4, 4] float64; C = 0: there is none."""

    memory: Any
    """What the policy keeps beside the map, after drawing."""

    notes: Any = None
    """What `score`, `weigh` and `conclude` need to know of the candidates; kept no longer."""


@dataclass(frozen=True)
class GreedyPolicy(ABC):
    """Draws candidates, scores them, weighs the path, takes the best.

    What a policy draws, and what it turns while scoring, becomes the nearest view that the
    carrier of the camera may take: no policy has to know the carrier.
    """

    config: PlannerConfig = field(default_factory=PlannerConfig)

    name: ClassVar[str]
    """As users write it."""

    source: ClassVar[str]
    """Where the rule comes from."""

    Config: ClassVar[type[PlannerConfig]] = PlannerConfig
    """Its settings."""

    climbs: ClassVar[bool] = False
    """True where `utility` is that of `scoring.utility`, and `total` the net of it: `decide` then
    refines the best candidates if the settings ask for it."""

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """What the policy keeps beside the map, before the first frame: nothing."""
        del camera, grid

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """The candidates: those of Ours, unless the policy has its own."""
        return Drawn(random_views(situation, self.config, key=key), situation.memory)

    @abstractmethod
    def score(
        self, situation: Situation, poses: np.ndarray, *, key: Array
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The candidates, turned if the policy turns them, and `utility` [C] among others."""

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """`total` of each candidate, from `utility` and `path` [C]: U_view."""
        return net_utility(utilities["utility"], utilities["path"], self.config.lambda2)

    def conclude(
        self, situation: Situation, poses: np.ndarray, utilities: dict[str, np.ndarray], best: int
    ) -> Any:
        """The memory after candidate `best` was chosen."""
        del poses, utilities, best
        return situation.memory

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """The state before the first frame; nothing in it is random."""
        del key
        memory = self.first_memory(camera, grid)
        return initial_state(camera, grid, memory, self.config.motion)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """The map holds all that most policies need of a frame."""
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
        """The candidate with the greatest total, of those that the carrier may take."""
        stopwatch = Stopwatch()
        draw_key, score_key = jax.random.split(key)
        with stopwatch.part("travel"):
            state, travel, masked = prepare_decision(
                state, map_state, grid, T_world_camera, self.config
            )
        pose = np.asarray(T_world_camera, dtype=np.float64)
        limits = Limits(self.config.motion, pose, travel.heights)
        with stopwatch.part("candidates"):
            situation = Situation(
                map_state, grid, masked, travel, state.camera, state.memory, limits
            )
            drawn = self.draw(situation, key=draw_key)
            if len(drawn.poses) == 0:
                decision, info = no_decision(travel, self.config, stopwatch)
                return decision, replace(state, memory=drawn.memory), info
            situation = replace(situation, memory=drawn.memory, notes=drawn.notes)
        with stopwatch.part("scoring"):
            poses, utilities = self.score(
                situation, limits.project_to_feasible(drawn.poses), key=score_key
            )
            poses = limits.project_to_feasible(poses)
        with stopwatch.part("travel"):
            lengths = travel.lengths(poses[:, :3, 3])
            utilities = utilities | {"path": limits.path_costs(lengths, poses)}
        if self.climbs and self.config.refine:
            with stopwatch.part("refining"):
                first = (utilities["utility"], utilities["path"])
                weigh = partial(net_utility, lambda2=self.config.lambda2, among=first)
                poses, utilities = refine_best(situation, poses, utilities, self.config, weigh)
        utilities = utilities | {"total": self.weigh(utilities)}
        best, decision, state, info = select_best(
            state, travel, poses, utilities, limits, stopwatch
        )
        memory = self.conclude(situation, poses, utilities, best)
        return decision, replace(state, memory=memory), info

    def follow(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> PlannerState:
        """The cells on the way, and what the latest view failed to show."""
        return follow_way(state, map_state, grid, T_world_camera, waypoints, self.config)


def free_views(situation: Situation, num: int, radius: float, *, key: Array) -> np.ndarray:
    """`num` views from safe places within `radius` of the robot, looking anywhere.

    Returns:
        [num, 4, 4] float64; [0, 4, 4] if the robot can stop nowhere.
    """
    position_key, direction_key = jax.random.split(key)
    positions = local_random(situation.travel, num, radius, key=position_key)
    if len(positions) == 0:
        return np.zeros((0, 4, 4))
    return poses_along(positions, random_directions(num, key=direction_key))


def draw_lots(num: int, *, key: Array) -> dict[str, np.ndarray]:
    """A `lot` for each of `num` candidates, where nothing else tells them apart."""
    return {"lot": host_generator(key).random(num)}


def score_by_pixels(
    situation: Situation,
    value: Value,
    poses: np.ndarray,
    scoring: ScoringConfig,
    rows: Any = (),
    reach: float | None = None,
) -> list[np.ndarray]:
    """`score_pixels` of a situation: each number that `value` gives of a view, [C] float64."""
    numbers = score_pixels(
        value,
        situation.map_state,
        situation.scoring_grid,
        situation.camera,
        poses.astype(np.float32),
        scoring,
        rows,
        reach,
    )
    return [np.asarray(number, dtype=np.float64) for number in numbers]


def random_views(situation: Situation, config: PlannerConfig, *, key: Array) -> np.ndarray:
    """C poses: local ones look anywhere, those drawn for the frontier look at it."""
    position_key, direction_key = jax.random.split(key)
    positions, aims = draw_positions(
        situation.travel, situation.scoring_grid, config, key=position_key
    )
    if len(positions) == 0:
        return np.zeros((0, 4, 4))
    directions = random_directions(len(positions), key=direction_key)
    is_aimed = np.isfinite(aims[:, :1])
    return poses_along(positions, np.where(is_aimed, aims - positions, directions))


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


ScoreViews = Callable[..., Any]
"""`scoring.batch.score_views` or `score_positions`, or a stand-in for one of them."""
