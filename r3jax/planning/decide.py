"""The steps of a decision, in order: survey, draw, make feasible, score, weigh, choose.

A policy defines how candidates are drawn and scored; everything else is here, for every policy.
Drawn and turned views are projected to the nearest view that the robot may take, so that policies
need not know the robot.

Shape symbols: X Y Z cells of the grid; C candidates; K waypoints.
"""

import functools
import itertools
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates, candidates_along, path_lengths, random_views
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo, Situation
from r3jax.planning.robot.body import Body
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.motion import Motion
from r3jax.planning.robot.room import PIXELS_PER_CELL, Been, room_for
from r3jax.planning.robot.travel import NEW_PLACE, Travel, fresh_columns, plan_travel
from r3jax.scoring.explain import Explanation, explain_view
from r3jax.scoring.utility import visible_unexplored

MAX_FAILED_LOOKS = 3
"""A cell still unexplored after this many views that should have shown it is given up: it lies
behind a window, where the depth sensor fails, or where hits and passes cancel out."""

NEW_DIRECTION = 45.0
"""A view turned by so much from all others at its place is a new one [degrees]."""

OLD_PLACE = 0.5
"""Novelty of a new view at a place where the robot has been, against one at a new place."""

SHUT_IN_VIEWS, SHUT_IN_STEP = 6, 0.3
"""A robot is shut in if its latest views lie within this distance [m] and no path leads farther."""

RECONSIDERED = 8
"""Number of candidates of an earlier decision that are scored again."""

Scored = tuple[Candidates, dict[str, np.ndarray]]
"""Candidates, turned if the policy turns them, and their scores [C]."""


class PlannerState(eqx.Module):
    """The memory of this package's policies between decisions."""

    camera: Camera
    """The camera."""

    trail: Bool[np.ndarray, "X Y Z"] = eqx.field(converter=np.asarray)
    """Cells that the robot has passed: the path back if it is shut in."""

    looks: Int[np.ndarray, "X Y Z"] = eqx.field(converter=np.asarray)
    """Number of views that should have shown each cell but left it unexplored."""

    start_height: Float[Array, ""] | None = None
    """Height of the first view [m], NaN before it; None for a motion whose heights do not count
    from it."""

    memory: Any = None
    """The policy's own memory, a pytree."""

    taken: Float[np.ndarray, "V 6"] | None = None
    """Positions and viewing directions of the views taken so far; None for a free-flying camera."""

    driven: Float[np.ndarray, "P 2"] | None = None
    """Pixels of the floor plan that a robot on the floor has driven over: their centers [m]; None
    for other motions."""


@dataclass(frozen=True)
class Drawn:
    """The candidates of one decision."""

    candidates: Candidates
    """The candidates; if none is valid, there is nothing to choose from."""

    memory: Any
    """The policy's memory after drawing."""

    notes: Any = None
    """Notes on the candidates for `score`, `weigh` and `conclude`; not stored."""


@dataclass(frozen=True)
class Rule:
    """The functions of a policy: how it draws and compares candidates."""

    draw: Callable[..., Drawn]
    """Draws the candidates in a situation; takes a `key`."""

    score: Callable[..., Scored]
    """Scores candidates: returns them, possibly turned, with their scores; takes a `key`. If none
    is valid any more, the policy has seen enough."""

    weigh: Callable[[dict[str, np.ndarray]], np.ndarray]
    """Computes the totals [C] from the scores and `path` [C]."""

    conclude: Callable[[Situation, Candidates, dict[str, np.ndarray], int], Any] = (
        lambda situation, candidates, utilities, best: situation.memory
    )
    """Returns the memory after a candidate was chosen."""


@dataclass(frozen=True)
class GreedyPolicy(ABC):
    """Draws candidates, scores them, weighs the path, takes the best.

    Subclasses define `score`, and if needed `draw`, `weigh` and `conclude`.
    """

    config: PlannerConfig = field(default_factory=PlannerConfig)

    name: ClassVar[str]
    """Its name on the command line."""

    source: ClassVar[str]
    """Source of the rule."""

    Config: ClassVar[type[PlannerConfig]] = PlannerConfig
    """Its settings."""

    memory_by_cell: ClassVar[bool] = False
    """True if its memory marks frontier cells that need no further view, [X, Y, Z] bool."""

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """Returns the policy's memory before the first frame: none."""
        del camera, grid

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws the candidates: those of R3, unless the policy has its own."""
        travel, grid = situation.travel, situation.scoring_grid
        return Drawn(random_views(travel, grid, self.config, key=key), situation.memory)

    @abstractmethod
    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Scores the candidates, turned if the policy does so: `utility` [C] and others."""

    def score_again(
        self, situation: Situation, candidates: Candidates, *, before: np.ndarray, key: Array
    ) -> Scored:
        """Scores candidates of an earlier decision, whose totals [C] were `before`."""
        del before
        return self.score(situation, candidates, key=key)

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Computes the `total` of each candidate from `utility` and `path` [C]: U_view."""
        return net_utility(utilities["utility"], utilities["path"], self.config.lambda2)

    def weigh_far(self, near: dict[str, np.ndarray], far: dict[str, np.ndarray]) -> np.ndarray:
        """Computes the totals of C candidates and of f goals far away, [C + f].

        Args:
            near: scores of the candidates and `path`, [C]; empty if there are none.
            far: `utility` and others that were computed when the goals were left, and `path`, [f].
        """
        names = near.keys() & far.keys() if near else far.keys()
        both = {name: np.concatenate([near[name], far[name]]) if near else far[name]
                for name in names}  # fmt: skip
        return self.weigh(both)

    def conclude(
        self,
        situation: Situation,
        candidates: Candidates,
        utilities: dict[str, np.ndarray],
        best: int,
    ) -> Any:
        """Returns the memory after candidate `best` was chosen."""
        del candidates, utilities, best
        return situation.memory

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """Returns the state before the first frame; nothing in it is random."""
        del key
        memory = self.first_memory(camera, grid)
        return initial_state(camera, grid, memory, self.config.motion)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Returns the state unchanged: most policies need nothing of a frame but the map."""
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
        """Chooses the feasible candidate with the greatest total."""
        rule = Rule(self.draw, self.score, self.weigh, self.conclude)
        return decide(rule, (state, map_state, grid, T_world_camera), self.config, key=key)

    def reconsider(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        planned: Decision,
        *,
        key: Array,
        notes: Any = None,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """Decides again among the best candidates of a decision that was made on an earlier map.

        The decision is None if no path leads to any of them. `notes` are those of `draw`.
        """
        views, before = best_of(planned)
        rule = Rule(
            lambda situation, *, key: Drawn(views, situation.memory, notes),
            functools.partial(self.score_again, before=before),
            self.weigh,
            self.conclude,
        )
        return decide(rule, (state, map_state, grid, T_world_camera), self.config, key=key)

    def follow(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> PlannerState:
        """Records the cells on the path, and counts cells that the latest view failed to show."""
        state, situation = look_round(state, map_state, grid, T_world_camera, self.config)
        return with_path(state, situation.travel, waypoints)


Known = tuple[PlannerState, MapState, OccupancyGrid, np.ndarray]
"""The policy's memory, the map, the grid, and where the latest view was taken [4, 4]."""


def decide(
    rule: Rule, known: Known, config: PlannerConfig, *, key: Array
) -> tuple[Decision | None, PlannerState, PlanInfo]:
    """Makes one decision, from drawing to choice.

    Args:
        rule: functions of the policy.
        known: memory, map, grid and pose.
        config: its settings.
        key: randomness of this decision.

    Returns:
        The decision, or None if no view can be reached; the memory; and information on the
        decision.
    """
    stopwatch = Stopwatch()
    # Two keys: a policy that draws more must not change the random numbers of its scores.
    draw_key, score_key = jax.random.split(key)
    with stopwatch.part("travel"):
        state, situation = look_round(*known, config)
    limits, travel = situation.limits, situation.travel
    if state.taken is not None and is_shut_in(travel, state.taken):
        return None, state, _nothing_in_reach(situation, config, stopwatch, is_shut_in=True)

    with stopwatch.part("candidates"):
        drawn = rule.draw(situation, key=draw_key)
        situation = replace(situation, memory=drawn.memory, notes=drawn.notes)
    # The memory after drawing is kept in any case, so that a resumed run is the same.
    state = replace(state, memory=drawn.memory)
    # Having no candidates is an outcome, not an error: the loop ends with the reason.
    if not drawn.candidates.valid.any():
        return None, state, _nothing_in_reach(situation, config, stopwatch)

    with stopwatch.part("scoring"):
        # Projected before scoring, so that the scored view is the one taken; and after it, because
        # scoring may have turned the views.
        feasible = limits.project_to_feasible(drawn.candidates)
        candidates, utilities = rule.score(situation, feasible, key=score_key)
        candidates = limits.project_to_feasible(candidates)
    if not candidates.valid.any():  # the policy has seen enough
        num = drawn.candidates.num_valid
        reason = f"none of {num} candidates adds anything: the policy has seen enough"
        info = PlanInfo(DecisionOutcome.NO_CANDIDATE, num, num, stopwatch.seconds, reason)
        return None, state, info

    with stopwatch.part("travel"):
        # After the projection, which may change heights: paths must lead to the final views.
        path = limits.path_costs(path_lengths(travel, candidates), candidates.direction)
    # New candidates are feasible; those drawn before the last view may not be.
    if not np.isfinite(path).any():
        return None, state, _nothing_in_reach(situation, config, stopwatch)
    utilities = utilities | {"path": path}
    gain = utilities.get("utility")
    if stands(config.motion) and state.taken is not None and gain is not None:
        # Camera and floor tie such a robot to few views of a place: what they cannot show would
        # draw it to where it is for as long as it runs.
        new = novelty(candidates, state.taken)
        is_fresh = travel.is_fresh(candidates.position)
        utilities["utility"] = gain * np.where(is_fresh, 1.0, OLD_PLACE * new)
    utilities = utilities | {"total": rule.weigh(utilities)}

    with stopwatch.part("travel"):
        # Padding has an infinite path, so that it is never chosen.
        best = int(np.argmax(np.where(np.isfinite(path), utilities["total"], -np.inf)))
        decision = _decision_for(best, candidates, utilities, travel, limits)
    memory = rule.conclude(situation, candidates, utilities, best)
    state = with_path(replace(state, memory=memory), travel, decision.waypoints)
    num_reachable = int(np.isfinite(path).sum())
    moved = (DecisionOutcome.MOVED, candidates.num_valid, num_reachable, stopwatch.seconds)
    expected = None if gain is None else float(gain[best])
    return decision, state, PlanInfo(*moved, expected_gain=expected)


def look_round(
    state: PlannerState,
    map_state: MapState,
    grid: OccupancyGrid,
    T_world_camera: np.ndarray,
    config: PlannerConfig,
) -> tuple[PlannerState, Situation]:
    """Finds the reachable space, the allowed views, and the cells that can be explored.

    Args:
        state: the policy's memory.
        map_state: the map, including the latest view.
        grid: the grid,
            including the latest view.
        T_world_camera: where the latest view was taken.
        config: the safety margin, the robot, and the range of its sensor.

    Returns:
        The memory, updated by the latest view, and the situation. Its `scoring_grid` leaves out
        cells that the robot can never see, and those that several views left unexplored.
    """
    # float64: in float32 a robot on a border of cells could be in either, and waypoints begin
    # exactly at the robot.
    pose = np.asarray(T_world_camera, dtype=np.float64)
    state = _with_start(state, pose[2, 3])
    motion, start = config.motion, state.start_height
    # Heights count from the first view, or a robot would creep up by its range each time.
    heights = motion.heights_from(0.0 if start is None else float(start))
    if stands(motion) and motion.is_relative and heights[0] == heights[1]:
        heights = float(pose[2, 3]), float(pose[2, 3])  # on a ramp the floor changes its height
    travel = travel_of(motion.body, grid, map_state, pose, config, state, heights)
    # Cells that this view should have shown, but that are still unexplored.
    visible = visible_unexplored(
        map_state, grid, state.camera, jnp.asarray(T_world_camera, jnp.float32), config.scoring
    )
    state = replace(state, looks=state.looks + np.asarray(visible, dtype=np.int32))
    if state.taken is not None:
        view = np.concatenate([pose[:3, 3], pose[:3, 2]]).astype(np.float32)[None]
        state = replace(state, taken=np.concatenate([state.taken, view]))
    # More views would not help, and the cells would keep their utility forever.
    is_exhausted = state.looks >= MAX_FAILED_LOOKS
    scoring_grid = mask_unexplorable(grid, travel.reachable, is_exhausted)
    limits = Limits(motion, pose, travel.heights)
    return state, Situation(
        map_state, grid, scoring_grid, travel, state.camera, state.memory, limits
    )


def novelty(candidates: Candidates, taken: np.ndarray) -> np.ndarray:
    """Measures the novelty of candidates against all views taken, [C]: 0 (the same) to 1.

    Args:
        candidates: the candidates.
        taken: positions and unit viewing directions, [V, 6].
    """
    gap = np.linalg.norm(candidates.position[:, None] - taken[None, :, :3], axis=2) / NEW_PLACE
    cosine = np.clip(candidates.axis @ taken[:, 3:].T.astype(np.float64), -1.0, 1.0)
    turn = np.degrees(np.arccos(cosine)) / NEW_DIRECTION
    return np.clip(np.hypot(gap, turn).min(axis=1, initial=1.0), 0.0, 1.0)


def travel_of(
    body: float | Body,
    grid: OccupancyGrid,
    map_state: MapState,
    pose: np.ndarray,
    config: PlannerConfig,
    state: PlannerState,
    heights: tuple[float, float],
) -> Travel:
    """Plans travel from a pose [4, 4], for a sphere or a footprint."""
    position, trail = pose[:3, 3], state.trail
    if not isinstance(body, Body):
        return plan_travel(grid, position, config.safety_margin, trail, heights, body)
    if body.heights is None:
        return plan_travel(grid, position, body.needed, trail, heights)
    # Voxels above the body are left where they are: in a hall they are most of all.
    center = np.asarray(map_state.center)
    tallest = position[2] + (body.heights[1] or 0.0) + float(grid.cell_size)
    near = np.asarray(map_state.present) & (center[2] < tallest)
    voxels = center[:, near].T.astype(np.float64, order="C")
    size = float(map_state.voxel_size)
    been = Been(trail, state.taken, state.driven)
    room = room_for(body, grid, voxels, size, pose, state.camera, been)
    travel = plan_travel(grid, position, trail=trail, heights=heights, room=room)
    stood = np.zeros((0, 2)) if state.taken is None else state.taken[:, :2]
    places = np.concatenate([position[None, :2], stood])
    return replace(travel, fresh=fresh_columns(travel, trail, places))


def explain_path(
    state: PlannerState,
    map_state: MapState,
    grid: OccupancyGrid,
    T_world_camera: np.ndarray,
    T_chosen: np.ndarray,
    waypoints: np.ndarray,
    config: PlannerConfig,
) -> tuple[PlannerState, Explanation]:
    """Explains the utility of the view at the end of a path [K, 3], as of its choice."""
    state, situation = look_round(state, map_state, grid, T_world_camera, config)
    pose = jnp.asarray(T_chosen, dtype=jnp.float32)
    explanation = explain_view(
        map_state, situation.scoring_grid, state.camera, pose, config.scoring
    )
    return with_path(state, situation.travel, waypoints), explanation


def best_of(planned: Decision) -> tuple[Candidates, np.ndarray]:
    """Selects the best candidates of an earlier decision, with their totals.

    Their number is fixed, so that scoring compiles once.
    """
    order, total = _ranked(planned)
    # A policy that ranks fewer (`r3-ahead`: the beginnings of its best paths) is padded with the
    # first drawn.
    best = order[:RECONSIDERED]
    poses = planned.candidates[best]
    views = candidates_along(poses[:, :3, 3], poses[:, :3, 2]).padded(RECONSIDERED)
    return views, np.resize(total[best], RECONSIDERED)


def with_others(decision: Decision, planned: Decision) -> Decision:
    """Adds the candidates of an earlier decision that were not scored again, as of then."""
    others = _ranked(planned)[0][RECONSIDERED:]
    utilities = {
        name: np.concatenate([decision.utilities[name], values[others]])
        for name, values in planned.utilities.items()
    }
    candidates = np.concatenate([decision.candidates, planned.candidates[others]])
    return replace(decision, candidates=candidates, utilities=utilities)


def _ranked(planned: Decision) -> tuple[np.ndarray, np.ndarray]:
    """Returns the order of a decision's candidates, best first, and their totals, [C] each."""
    finite = np.isfinite(planned.utilities["path"])
    total = np.where(finite, planned.utilities["total"], -np.inf)
    return np.argsort(-total, kind="stable"), total


def net_utility(
    utility: np.ndarray,
    path: np.ndarray,
    lambda2: float,
    among: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Computes U_view of each candidate from its utility and path length [C].

    U_view = utility / sum(utility) - lambda2 * path / sum(path), both sums over the reachable
    candidates; a sum of 0 leaves its term out. Unreachable: -inf. (Active-GS sums utilities over
    all candidates, paths over the reachable ones.)

    Args:
        utility: of each candidate.
        path: length of the path to it, or its cost; inf: unreachable.
        lambda2: weight of the path.
        among: utilities and paths of the candidates to sum over; None: these.
    """
    # Shares of sums make utility and path comparable, without units.
    wholes = (utility, path) if among is None else among
    counts, is_reachable = np.isfinite(wholes[1]), np.isfinite(path)
    shares: list[np.ndarray] = []
    for values, whole in zip((utility, path), wholes, strict=True):
        values = np.where(is_reachable, np.asarray(values, dtype=np.float64), 0.0)
        # An infinite path in the sum would make every share 0.
        total = np.where(counts, np.asarray(whole, dtype=np.float64), 0.0).sum()
        # A sum of 0 does not distinguish candidates: its term is left out, not infinite.
        shares.append(values / (total or 1.0))
    return np.where(is_reachable, shares[0] - lambda2 * shares[1], -np.inf)


def initial_state(
    camera: Camera, grid: OccupancyGrid, memory: Any = None, motion: Motion | None = None
) -> PlannerState:
    """Returns the memory of a robot that has not moved yet."""
    nowhere = np.zeros(grid.log_odds.shape, dtype=bool)
    looks = np.zeros(grid.log_odds.shape, dtype=np.int32)
    is_relative = motion is not None and motion.is_relative
    # NaN, not None, until the first view, so that the structure of the pytree stays the same.
    start_height = jnp.asarray(jnp.nan, dtype=jnp.float32) if is_relative else None
    # None for a free camera, as stored by earlier versions.
    taken = None if motion is None or motion == Motion() else np.zeros((0, 6), np.float32)
    is_standing = motion is not None and stands(motion)
    driven = np.zeros((0, 2), np.float32) if is_standing else None
    return PlannerState(camera, nowhere, looks, start_height, memory, taken, driven)


def with_path(state: PlannerState, travel: Travel, waypoints: np.ndarray) -> PlannerState:
    """Adds a path over waypoints [K, 3] [m] to the trail."""
    # All cells that the lines cross, not only the waypoints: the path back must be connected.
    state = replace(state, trail=state.trail | travel.cells_along(waypoints))
    if state.driven is None:
        return state
    places = np.concatenate([state.driven, driven_pixels(travel, waypoints)])
    return replace(state, driven=np.unique(places, axis=0))


def driven_pixels(travel: Travel, waypoints: np.ndarray) -> np.ndarray:
    """Finds the pixels of the floor plan that a path crosses: their centers, [n, 2] float32 [m].

    Args:
        travel: it has the plan's lattice.
        waypoints: corners of the path, [K, 3] [m].
    """
    from r3jax.kernels.robot.cells import segment_cells

    low, size = travel.origin[:2], travel.cell_size / PIXELS_PER_CELL
    corners = np.column_stack([(waypoints[:, :2] - low) / size, np.full(len(waypoints), 0.5)])
    cells = [segment_cells(a, b)[:, :2] for a, b in itertools.pairwise(corners)]
    pixels = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *cells]), axis=0)
    return (low + (pixels + 0.5) * size).astype(np.float32)


def _with_start(state: PlannerState, height: float) -> PlannerState:
    """Records the height [m] of the first view, if it is not known yet."""
    start = state.start_height
    if start is None or not np.isnan(start):
        return state
    return replace(state, start_height=jnp.asarray(height, dtype=jnp.float32))


def _decision_for(
    best: int,
    candidates: Candidates,
    utilities: dict[str, np.ndarray],
    travel: Travel,
    limits: Limits,
) -> Decision:
    """Builds the decision for candidate `best`: the path to it, and the other candidates."""
    waypoints = travel.path(candidates.position[best])
    # Computed again: shortcuts may have shortened the path.
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    # Matrices for rendering and recording, without the padding.
    poses, on_offer = candidates.T_world_camera, candidates.valid
    return Decision(
        T_world_camera=poses[best],
        waypoints=waypoints,
        length=length,
        seconds=limits.seconds(length, candidates.direction[best]),
        score=float(utilities["total"][best]),
        candidates=poses[on_offer],
        utilities={name: values[on_offer] for name, values in utilities.items()},
    )


def stands(motion: Motion) -> bool:
    """Returns True for a body that stands on the floor, False for a flying camera."""
    return isinstance(motion.body, Body) and motion.body.heights is not None


def is_shut_in(travel: Travel, taken: np.ndarray) -> bool:
    """Checks if the latest views are all within a step, and no path leads farther.

    Args:
        travel: where the robot can go.
        taken: positions and viewing directions of the views so far, [V, 6].
    """
    if len(taken) < SHUT_IN_VIEWS:
        return False
    latest = taken[-SHUT_IN_VIEWS:, :3]
    if np.linalg.norm(latest - travel.start, axis=1).max() > SHUT_IN_STEP:
        return False
    stops = travel.stops(np.argwhere(travel.goals))
    return bool(np.all(np.linalg.norm(stops - travel.start, axis=1) <= 2.0 * SHUT_IN_STEP))


def _nothing_in_reach(
    situation: Situation, config: PlannerConfig, stopwatch: "Stopwatch", *, is_shut_in: bool = False
) -> PlanInfo:
    """Reports why there is no candidate: no path to the safe positions, or no safe position."""
    travel = situation.travel
    centers = travel.centers(np.argwhere(travel.safe))
    # Distinguishes safe but unreachable positions within the radius from none at all.
    near = np.linalg.norm(centers - travel.start, axis=1) <= config.radius
    outcome = DecisionOutcome.NO_REACHABLE_CANDIDATE if near.any() else DecisionOutcome.NO_CANDIDATE
    if is_shut_in:
        outcome = DecisionOutcome.SHUT_IN
    reason, counts = explain_confinement(situation, config)
    return PlanInfo(outcome, int(near.sum()), 0, stopwatch.seconds, reason, counts)


def explain_confinement(situation: Situation, config: PlannerConfig) -> tuple[str, dict[str, int]]:
    """Explains what closes the space around the robot; also returns numbers of cells or columns."""
    travel, grid, body = situation.travel, situation.grid, config.motion.body
    if not travel.contains(travel.start_cell):
        counts = {"outside": 1}
        return (
            f"the camera at {travel.start.round(2).tolist()} m is outside of the bounds of the "
            "planner: give `start` a box that contains the robot", counts,
        )  # fmt: skip
    extra: dict[str, int] = {}
    reach = travel.room.needed if travel.room is not None else config.safety_margin
    centers = np.moveaxis(np.indices(travel.free.shape), 0, -1)
    gap = travel.origin + (centers + 0.5) * travel.cell_size - travel.start
    near = np.linalg.norm(gap[..., :2], axis=-1) <= reach + 0.5
    for name, cells in (("keep_out", grid.closed), ("refused_goals", grid.refused)):
        if cells is not None and (near & cells).any():
            extra[name] = int((near & cells).any(axis=2).sum())
    if travel.room is not None:
        counts = travel.room.counts | extra
        assert isinstance(body, Body)
        advice = (
            "the camera does not show the floor near the robot: tilt it down, allow "
            "`Body(unknown_below=...)`, raise the lowest part (`Body(heights=...)`), or trust a "
            "LiDAR's costmap (`with_costmap(..., trust_free=True)`)"
            if counts["unknown"] > counts["obstacle"]
            else "give a smaller footprint or margin, or move the robot to an open place"
        )
        reason = (
            f"of {counts['near']} columns of cells within {reach + 0.5:.1f} m of the robot "
            f"{counts['unknown']} are not known down to the floor and {counts['obstacle']} hold "
            f"obstacles between {body.step:g} m above the floor and the top of its body; "
            f"{counts['open']} are open: {advice}"
        )  # fmt: skip
        return _with_extra(reason, extra), counts
    ball = np.linalg.norm(gap, axis=-1) <= reach + travel.cell_size
    closed = ball & ~travel.free
    occupied = int((closed & np.asarray(grid.occupied)).sum())
    below = int((closed & (gap[..., 2] < -0.5 * travel.cell_size)).sum())
    above = int((closed & (gap[..., 2] > 0.5 * travel.cell_size)).sum())
    counts = {"near": int(ball.sum()), "not_free": int(closed.sum()), "occupied": occupied,
              "below": below, "above": above} | extra  # fmt: skip
    reason = (
        f"of {counts['near']} cells within {reach:g} m of the camera {counts['not_free']} are not "
        f"known to be free ({occupied} occupied, {below} below the camera, {above} above): is the "
        "camera tilted, or low above the floor? Give the robot a footprint "
        "(motion body=r3jax.Body(...)), or a smaller safety_margin"
    )
    return _with_extra(reason, extra), counts


def _with_extra(reason: str, extra: dict[str, int]) -> str:
    names = {"keep_out": "in keep-out zones or the costmap", "refused_goals": "near refused goals"}
    return reason + "".join(f"; {num} columns are {names[name]}" for name, num in extra.items())


@dataclass
class Stopwatch:
    """Wall time of the parts of one decision."""

    seconds: dict[str, float] = field(default_factory=dict[str, float])
    """Per part [s]."""

    @contextmanager
    def part(self, name: str) -> Generator[None]:
        """Adds the time spent in a `with` block to a part."""
        begin = time.perf_counter()
        yield
        # Added, not set: travel is timed both before and after scoring.
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin
