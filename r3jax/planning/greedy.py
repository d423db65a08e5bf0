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
    Candidates,
    candidates_along,
    candidates_at,
    host_generator,
    local_random,
    path_lengths,
    random_directions,
    region_of_interest,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decision import (
    PlannerState,
    Stopwatch,
    follow_path,
    initial_state,
    net_utility,
    no_decision,
    prepare_decision,
    select_best,
)
from r3jax.planning.policy import Decision, PlanInfo, Situation
from r3jax.planning.refinement.refine import refine_best
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.travel import Travel
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.pixels import Value, score_pixels

RECONSIDERED = 8
"""Candidates of an earlier decision that are scored again."""


@dataclass(frozen=True)
class Drawn:
    """The candidates of one decision."""

    candidates: Candidates
    """Views on offer; none of them valid: there is nothing to choose from."""

    memory: Any
    """What the policy keeps beside the map, after drawing."""

    notes: Any = None
    """What `score`, `weigh` and `conclude` need to know of the candidates; kept no longer."""


@dataclass(frozen=True)
class GreedyPolicy(ABC):
    """Draws candidates, scores them, weighs the path, takes the best.

    What a policy draws, and what it turns while scoring, becomes the nearest view that the
    robot may take: no policy has to know the robot.
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

    scores_by_notes: ClassVar[bool] = False
    """True where scores need what drawing noted: `reconsider` keeps their order then."""

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """What the policy keeps beside the map, before the first frame: nothing."""
        del camera, grid

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """The candidates: those of Ours, unless the policy has its own."""
        return Drawn(random_views(situation, self.config, key=key), situation.memory)

    @abstractmethod
    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """The candidates, turned if the policy turns them, and `utility` [C] among others."""

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """`total` of each candidate, from `utility` and `path` [C]: U_view."""
        return net_utility(utilities["utility"], utilities["path"], self.config.lambda2)

    def conclude(
        self,
        situation: Situation,
        candidates: Candidates,
        utilities: dict[str, np.ndarray],
        best: int,
    ) -> Any:
        """The memory after candidate `best` was chosen."""
        del candidates, utilities, best
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
        """The candidate with the greatest total, of those that the robot may take."""
        draw = lambda situation, key: self.draw(situation, key=key)
        return self._choose(state, map_state, grid, T_world_camera, draw, key=key)

    def reconsider(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        planned: Decision,
        *,
        key: Array,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """Decides again, among the best candidates of a decision that was made on less.

        Args:
            state: what the policy remembers.
            map_state: the map as it has come out.
            grid: the grid as it has come out.
            T_world_camera: where the latest view was taken.
            planned: the decision, with its candidates.
            key: randomness of this decision.

        Returns:
            As `decide`; None if no path leads to any of them.
        """
        finite = np.isfinite(planned.utilities["path"])
        total = np.where(finite, planned.utilities["total"], -np.inf)
        # A policy that ranks fewer (`ours-ahead`: where its best paths begin) fills up with the
        # first that were drawn.
        best = np.argsort(-total, kind="stable")[:RECONSIDERED]
        poses = planned.candidates[best]
        # One shape whatever was on offer, so that it compiles once.
        views = candidates_along(poses[:, :3, 3], poses[:, :3, 2]).padded(RECONSIDERED)
        if self.scores_by_notes:
            order = np.resize(total[best], RECONSIDERED)
            return self._first_in_reach(state, map_state, grid, T_world_camera, views, order)
        draw = lambda situation, key: Drawn(views, situation.memory)
        return self._choose(state, map_state, grid, T_world_camera, draw, key=key)

    def _first_in_reach(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        views: Candidates,
        total: np.ndarray,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """The view of the greatest `total` [C] that a path leads to now."""
        stopwatch = Stopwatch()
        with stopwatch.part("travel"):
            state, travel, _ = prepare_decision(state, map_state, grid, T_world_camera, self.config)
            limits = self._limits(T_world_camera, travel)
            views = limits.project_to_feasible(views)
            path = limits.path_costs(path_lengths(travel, views), views.direction)
        if not np.isfinite(path).any():
            decision, info = no_decision(travel, self.config, stopwatch)
            return decision, state, info
        utilities = {"total": total, "path": path}
        _, decision, state, info = select_best(state, travel, views, utilities, limits, stopwatch)
        return decision, state, info

    def _choose(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        draw: Callable[[Situation, Array], Drawn],
        *,
        key: Array,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """The best of the views that `draw` offers in a situation."""
        stopwatch = Stopwatch()
        # Two keys: a policy that draws more must not change the lots of its scores.
        draw_key, score_key = jax.random.split(key)
        with stopwatch.part("travel"):
            state, travel, masked = prepare_decision(
                state, map_state, grid, T_world_camera, self.config
            )
        limits = self._limits(T_world_camera, travel)
        with stopwatch.part("candidates"):
            situation = Situation(
                map_state, grid, masked, travel, state.camera, state.memory, limits
            )
            drawn = draw(situation, draw_key)
            # No view on offer is an outcome, not an error: the loop ends with the reason.
            if not drawn.candidates.valid.any():
                decision, info = no_decision(travel, self.config, stopwatch)
                # What drawing noted is kept, so that a resumed run remembers the same.
                return decision, replace(state, memory=drawn.memory), info
            situation = replace(situation, memory=drawn.memory, notes=drawn.notes)
        with stopwatch.part("scoring"):
            # Before scoring, so that what is scored is what is taken; after it, because a score
            # may have turned the views.
            candidates, utilities = self.score(
                situation, limits.project_to_feasible(drawn.candidates), key=score_key
            )
            candidates = limits.project_to_feasible(candidates)
        with stopwatch.part("travel"):
            # After the projection, which may change heights: the paths lead to views on offer.
            lengths = path_lengths(travel, candidates)
            path = limits.path_costs(lengths, candidates.direction)
            # What was drawn is within reach; what was drawn before the last view may not be.
            if not np.isfinite(path).any():
                decision, info = no_decision(travel, self.config, stopwatch)
                return decision, replace(state, memory=situation.memory), info
            utilities = utilities | {"path": path}
        if self.climbs and self.config.refine:
            with stopwatch.part("refining"):
                candidates, utilities = self._climb(situation, candidates, utilities)
        # Last, so that views that have climbed compete with their new utility and path.
        utilities = utilities | {"total": self.weigh(utilities)}
        best, decision, state, info = select_best(
            state, travel, candidates, utilities, limits, stopwatch
        )
        memory = self.conclude(situation, candidates, utilities, best)
        return decision, replace(state, memory=memory), info

    def _climb(
        self, situation: Situation, candidates: Candidates, utilities: dict[str, np.ndarray]
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """The best candidates where climbing has brought them, and what they are worth there."""
        # The sums stay those of the candidates as drawn: a view that rises must not lower the
        # others' shares.
        first = (utilities["utility"], utilities["path"])
        weigh = partial(net_utility, lambda2=self.config.lambda2, among=first)
        return refine_best(situation, candidates, utilities, self.config, weigh)

    def _limits(self, T_world_camera: np.ndarray, travel: Travel) -> Limits:
        """What the robot may do next from a pose [4, 4]."""
        # float64 on the host: waypoints begin exactly where the robot is.
        pose = np.asarray(T_world_camera, dtype=np.float64)
        return Limits(self.config.motion, pose, travel.heights)

    def follow(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> PlannerState:
        """The cells on the way, and what the latest view failed to show."""
        return follow_path(state, map_state, grid, T_world_camera, waypoints, self.config)


def free_views(situation: Situation, num: int, radius: float, *, key: Array) -> Candidates:
    """Draws `num` views from safe places within `radius` of the robot, looking anywhere.

    Returns:
        `num` candidates; none if the robot can stop nowhere.
    """
    position_key, direction_key = jax.random.split(key)
    positions = local_random(situation.travel, num, radius, key=position_key)
    directions = random_directions(len(positions), key=direction_key)
    return candidates_along(positions, directions)


def draw_lots(num: int, *, key: Array) -> dict[str, np.ndarray]:
    """A `lot` for each of `num` candidates, where nothing else tells them apart."""
    return {"lot": host_generator(key).random(num)}


def score_by_pixels(
    situation: Situation,
    value: Value,
    candidates: Candidates,
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
        candidates.poses_on_device(),
        scoring,
        rows,
        reach,
    )
    return [np.asarray(number, dtype=np.float64) for number in numbers]


def random_views(situation: Situation, config: PlannerConfig, *, key: Array) -> Candidates:
    """Draws C views: local ones look anywhere, those drawn for the frontier look at it."""
    position_key, direction_key = jax.random.split(key)
    positions, aims = draw_positions(
        situation.travel, situation.scoring_grid, config, key=position_key
    )
    directions = random_directions(len(positions), key=direction_key)
    # Directions are drawn for all rows, aimed or not: recorded runs hold to this stream.
    is_aimed = np.isfinite(aims[:, :1])
    drawn = candidates_along(positions, np.where(is_aimed, aims - positions, directions))
    # An empty draw cannot be padded: it has no row to repeat.
    return drawn.padded(config.num_candidates) if len(positions) else drawn


def random_places(situation: Situation, config: PlannerConfig, *, key: Array) -> Candidates:
    """Draws the positions of `random_views` for a score that finds the directions."""
    # The same half of the key as there: both draw the same positions.
    position_key, _ = jax.random.split(key)
    positions, _ = draw_positions(
        situation.travel, situation.scoring_grid, config, key=position_key
    )
    drawn = candidates_at(positions)
    return drawn.padded(config.num_candidates) if len(positions) else drawn


def draw_positions(
    travel: Travel, scoring_grid: OccupancyGrid, config: PlannerConfig, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Draws n positions: up to `num_frontier` in sight of the frontier, the others local.

    Args:
        travel: where the robot can go.
        scoring_grid: the grid without hopeless unexplored cells (`mask_unexplorable`).
        config: how many, and how near.
        key: source of randomness.

    Returns:
        Positions [n, 3] and the frontier cell each one is meant for [n, 3] (NaN for local
        ones), float64 [m]; fewer than `num_candidates` if there is no local one, [0, 3] if the
        robot can stop nowhere.
    """
    frontier_key, local_key = jax.random.split(key)
    # Of the masked grid: a frontier that nobody can get beyond is none.
    targets = np.asarray(frontier(scoring_grid))
    positions, aims = region_of_interest(travel, targets, config.num_frontier, key=frontier_key)
    # What the frontier leaves goes to local positions: every decision scores the same number.
    local = local_random(
        travel, config.num_candidates - len(positions), config.radius, key=local_key
    )
    # Local views have no aim; NaN keeps the two arrays row by row alike.
    aims = np.concatenate([aims, np.full_like(local, np.nan)])
    return np.concatenate([positions, local]), aims


ScoreViews = Callable[..., Any]
"""`scoring.batch.score_views` or `score_positions`, or another function of their kind."""
