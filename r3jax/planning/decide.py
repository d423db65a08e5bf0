"""A decision in the order of time: look round, draw, make feasible, score, weigh, choose.

A policy is how it draws and how it scores; all else of a decision is here, for every policy. What
is drawn, and what scoring turns, becomes the nearest view that the robot may take: no policy has to
know the robot.

Shape symbols: X Y Z cells of the grid; C candidates; K waypoints.
"""

import functools
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
from r3jax.planning.robot.room import room_for
from r3jax.planning.robot.travel import Travel, plan_travel
from r3jax.scoring.explain import Explanation, explain_view
from r3jax.scoring.utility import visible_unexplored

MAX_FAILED_LOOKS = 3
"""A cell still unexplored after this many views that should have shown it is given up: it lies
behind a window, where the depth sensor fails, or where hits and passes cancel out."""

NEW_PLACE, NEW_DIRECTION = 1.0, 45.0
"""A view this far from all others [m], or turned by so much [degrees], is a new one."""

SHUT_IN_VIEWS, SHUT_IN_STEP = 6, 0.3
"""A robot whose latest views all lie within such a step [m] is shut in, if no path leads out."""

RECONSIDERED = 8
"""Candidates of an earlier decision that are scored again."""

Scored = tuple[Candidates, dict[str, np.ndarray]]
"""Candidates, turned if the policy turns them, and numbers of each [C]."""


class PlannerState(eqx.Module):
    """What a policy of this package remembers between decisions."""

    camera: Camera
    """The camera of every frame to come."""

    trail: Bool[np.ndarray, "X Y Z"] = eqx.field(converter=np.asarray)
    """Cells that the robot has come through: the path back if it finds itself shut in."""

    looks: Int[np.ndarray, "X Y Z"] = eqx.field(converter=np.asarray)
    """Views that should have shown each cell and left it unexplored."""

    start_height: Float[Array, ""] | None = None
    """Height of the first view [m], NaN before it; None for a motion whose heights do not count
    from it."""

    memory: Any = None
    """Arrays that one policy keeps beside the map: a pytree of its own."""

    taken: Float[np.ndarray, "V 6"] | None = None
    """Positions and lines of sight of the views that were taken; None for a free-flying camera."""


@dataclass(frozen=True)
class Drawn:
    """The candidates of one decision."""

    candidates: Candidates
    """Views on offer; none of them valid: there is nothing to choose from."""

    memory: Any
    """What the policy keeps beside the map, after drawing."""

    notes: Any = None
    """What `score`, `weigh` and `conclude` need of the candidates; not kept."""


@dataclass(frozen=True)
class Rule:
    """How a policy decides: what it offers, and how it compares."""

    draw: Callable[..., Drawn]
    """The candidates in a situation; takes a `key`."""

    score: Callable[..., Scored]
    """From a situation and candidates to those, turned or not, and numbers of each; takes a
    `key`. None valid any more: the policy has seen enough."""

    weigh: Callable[[dict[str, np.ndarray]], np.ndarray]
    """From those numbers, and `path` [C], to the totals [C]."""

    conclude: Callable[[Situation, Candidates, dict[str, np.ndarray], int], Any] = (
        lambda situation, candidates, utilities, best: situation.memory
    )
    """The memory after a candidate was chosen."""


@dataclass(frozen=True)
class GreedyPolicy(ABC):
    """Draws candidates, scores them, weighs the path, takes the best.

    A policy says how it scores, and if need be how it draws, weighs and concludes.
    """

    config: PlannerConfig = field(default_factory=PlannerConfig)

    name: ClassVar[str]
    """As users write it."""

    source: ClassVar[str]
    """Where the rule comes from."""

    Config: ClassVar[type[PlannerConfig]] = PlannerConfig
    """Its settings."""

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
        """Leaves the state unchanged: the map contains all that most policies need of a frame."""
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
        """Chooses the candidate with the greatest total, of those that the robot may take."""
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
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """Decides again among the best candidates of a decision that was made on less.

        The decision is None if no path leads to any of them.
        """
        views, before = best_of(planned)
        rule = Rule(
            lambda situation, *, key: Drawn(views, situation.memory),
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
        """Records the cells on the path, and counts those that the latest view failed to show."""
        state, situation = look_round(state, map_state, grid, T_world_camera, self.config)
        return with_path(state, situation.travel, waypoints)


Known = tuple[PlannerState, MapState, OccupancyGrid, np.ndarray]
"""The policy's memory, the map, the grid, and where the latest view was taken [4, 4]."""


def decide(
    rule: Rule, known: Known, config: PlannerConfig, *, key: Array
) -> tuple[Decision | None, PlannerState, PlanInfo]:
    """Makes one decision, from drawing to choice.

    Args:
        rule: of the policy.
        known: what it decides on.
        config: its settings.
        key: randomness of this decision.

    Returns:
        The decision, or None where no view can be reached; the memory, and what happened.
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
    # What drawing noted is kept in any case, so that a resumed run remembers the same.
    state = replace(state, memory=drawn.memory)
    # No view on offer is an outcome, not an error: the loop ends with the reason.
    if not drawn.candidates.valid.any():
        return None, state, _nothing_in_reach(situation, config, stopwatch)

    with stopwatch.part("scoring"):
        # Before scoring, so that what is scored is what is taken; after it, because a score may
        # have turned the views.
        feasible = limits.project_to_feasible(drawn.candidates)
        candidates, utilities = rule.score(situation, feasible, key=score_key)
        candidates = limits.project_to_feasible(candidates)
    if not candidates.valid.any():  # the policy has seen enough
        num = drawn.candidates.num_valid
        reason = f"the policy has no use for any of {num} candidates: it has seen enough"
        info = PlanInfo(DecisionOutcome.NO_CANDIDATE, num, num, stopwatch.seconds, reason)
        return None, state, info

    with stopwatch.part("travel"):
        # After the projection, which may change heights: the paths lead to views on offer.
        path = limits.path_costs(path_lengths(travel, candidates), candidates.direction)
    # What was drawn is within reach; what was drawn before the last view may not be.
    if not np.isfinite(path).any():
        return None, state, _nothing_in_reach(situation, config, stopwatch)
    utilities = utilities | {"path": path}
    gain = utilities.get("utility")
    if stands(config.motion) and state.taken is not None and gain is not None:
        # Camera and floor tie such a robot to few views of a place: what they cannot show would
        # draw it to where it is for as long as it runs.
        utilities["utility"] = gain * novelty(candidates, state.taken)
    utilities = utilities | {"total": rule.weigh(utilities)}

    with stopwatch.part("travel"):
        # Padding has an infinite path too, so that it can never win.
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
    """Finds where the robot can go, its possible moves, and which cells can be explored.

    Args:
        state: the policy's memory.
        map_state: the map, the view from here included.
        grid: the grid, the same.
        T_world_camera: where the latest view was taken.
        config: the safety margin, the robot, and how far it sees.

    Returns:
        The memory with the view from here counted in, and the situation. Cells that no robot can
        look at, and those that several views left unexplored, do not count in its `scoring_grid`.
    """
    # float64: in float32 a robot on a border of cells could stand in either of them, and waypoints
    # begin exactly where the robot is.
    pose = np.asarray(T_world_camera, dtype=np.float64)
    state = _with_start(state, pose[2, 3])
    motion, start = config.motion, state.start_height
    # Heights count from the first view, or a robot would creep up by its range each time.
    heights = motion.heights_from(0.0 if start is None else float(start))
    if stands(motion) and motion.is_relative and heights[0] == heights[1]:
        heights = float(pose[2, 3]), float(pose[2, 3])  # on a ramp the floor carries it
    travel = travel_of(motion.body, grid, map_state, pose, config, state, heights)
    # What this view should have shown: if it is still unexplored, the look has failed.
    visible = visible_unexplored(
        map_state, grid, state.camera, jnp.asarray(T_world_camera, jnp.float32), config.scoring
    )
    state = replace(state, looks=state.looks + np.asarray(visible, dtype=np.int32))
    if state.taken is not None:
        view = np.concatenate([pose[:3, 3], pose[:3, 2]]).astype(np.float32)[None]
        state = replace(state, taken=np.concatenate([state.taken, view]))
    # After that many, more would not help, and the utility would never stop calling for them.
    is_exhausted = state.looks >= MAX_FAILED_LOOKS
    scoring_grid = mask_unexplorable(grid, travel.reachable, is_exhausted)
    limits = Limits(motion, pose, travel.heights)
    return state, Situation(
        map_state, grid, scoring_grid, travel, state.camera, state.memory, limits
    )


def novelty(candidates: Candidates, taken: np.ndarray) -> np.ndarray:
    """Measures how new candidates are beside all views that were taken, [C]: 0 (the same) to 1.

    Args:
        candidates: views on offer.
        taken: positions and unit lines of sight, [V, 6].
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
    """Finds where a body can go from a pose [4, 4], in the form that its kind needs."""
    position, trail = pose[:3, 3], state.trail
    if not isinstance(body, Body):
        return plan_travel(grid, position, config.safety_margin, trail, heights, body)
    if body.heights is None:
        return plan_travel(grid, position, body.needed, trail, heights)
    present = np.asarray(map_state.present)
    voxels = np.asarray(map_state.center).T[present].astype(np.float64)
    size = float(map_state.voxel_size)
    room = room_for(body, grid, voxels, size, pose, state.camera, trail)
    return plan_travel(grid, position, trail=trail, heights=heights, room=room)


def explain_path(
    state: PlannerState,
    map_state: MapState,
    grid: OccupancyGrid,
    T_world_camera: np.ndarray,
    T_chosen: np.ndarray,
    waypoints: np.ndarray,
    config: PlannerConfig,
) -> tuple[PlannerState, Explanation]:
    """Follows a path [K, 3], and explains the utility of the view at its end when it was chosen."""
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
    finite = np.isfinite(planned.utilities["path"])
    total = np.where(finite, planned.utilities["total"], -np.inf)
    # A policy that ranks fewer (`r3-ahead`: where its best paths begin) fills up with the first
    # that were drawn.
    best = np.argsort(-total, kind="stable")[:RECONSIDERED]
    poses = planned.candidates[best]
    views = candidates_along(poses[:, :3, 3], poses[:, :3, 2]).padded(RECONSIDERED)
    return views, np.resize(total[best], RECONSIDERED)


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
        among: utilities and paths of the candidates that the sums are over; None: these.
    """
    # Shares of sums: utility and path become comparable without units.
    wholes = (utility, path) if among is None else among
    counts, is_reachable = np.isfinite(wholes[1]), np.isfinite(path)
    shares: list[np.ndarray] = []
    for values, whole in zip((utility, path), wholes, strict=True):
        values = np.where(is_reachable, np.asarray(values, dtype=np.float64), 0.0)
        # One infinite path in the sum would take the share of every other to 0.
        total = np.where(counts, np.asarray(whole, dtype=np.float64), 0.0).sum()
        # A sum of 0 tells no candidate from another: its term is left out, not infinite.
        shares.append(values / (total or 1.0))
    return np.where(is_reachable, shares[0] - lambda2 * shares[1], -np.inf)


def initial_state(
    camera: Camera, grid: OccupancyGrid, memory: Any = None, motion: Motion | None = None
) -> PlannerState:
    """Returns the memory of a robot that has not moved yet."""
    nowhere = np.zeros(grid.log_odds.shape, dtype=bool)
    looks = np.zeros(grid.log_odds.shape, dtype=np.int32)
    is_relative = motion is not None and motion.is_relative
    # NaN, not None, until the first view: the tree of arrays keeps its structure from there on.
    start_height = jnp.asarray(jnp.nan, dtype=jnp.float32) if is_relative else None
    # A free camera has none, so that its memory stays as earlier versions stored it.
    taken = None if motion is None or motion == Motion() else np.zeros((0, 6), np.float32)
    return PlannerState(camera, nowhere, looks, start_height, memory, taken)


def with_path(state: PlannerState, travel: Travel, waypoints: np.ndarray) -> PlannerState:
    """Adds the cells of a path over waypoints [K, 3] [m] to the trail."""
    # All cells that the lines cross, not the waypoints alone: the path back must be connected.
    return replace(state, trail=state.trail | travel.cells_along(waypoints))


def _with_start(state: PlannerState, height: float) -> PlannerState:
    """Notes the height [m] of the first view, if that has not been done."""
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
    # Measured again: shortcuts may have made the path shorter than the length that was weighed.
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    # The edge: matrices for rendering and recording, without the padding.
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
    """Tells a robot or a person with a footprint on the floor from what flies."""
    return isinstance(motion.body, Body) and motion.body.heights is not None


def is_shut_in(travel: Travel, taken: np.ndarray) -> bool:
    """Checks if the latest views were all taken within a step, and no path leads farther.

    Args:
        travel: where the robot can go.
        taken: positions and lines of sight of the views so far, [V, 6].
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
    """Reports that no candidate was found: safe places exist, or not even those."""
    travel = situation.travel
    centers = travel.centers(np.argwhere(travel.safe))
    # Safe places within the radius that no path leads to are told from none at all.
    near = np.linalg.norm(centers - travel.start, axis=1) <= config.radius
    outcome = DecisionOutcome.NO_REACHABLE_CANDIDATE if near.any() else DecisionOutcome.NO_CANDIDATE
    if is_shut_in:
        outcome = DecisionOutcome.SHUT_IN
    reason, counts = explain_confinement(situation, config)
    return PlanInfo(outcome, int(near.sum()), 0, stopwatch.seconds, reason, counts)


def explain_confinement(situation: Situation, config: PlannerConfig) -> tuple[str, dict[str, int]]:
    """Says what closes the space round the robot, in words and in numbers of cells or columns."""
    travel, grid, body = situation.travel, situation.grid, config.motion.body
    if not travel.contains(travel.start_cell):
        counts = {"outside": 1}
        return (
            f"the camera at {travel.start.round(2).tolist()} m is outside of the bounds of the "
            "planner: give `start` a box that holds the robot", counts,
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
            "the camera never shows the floor: tilt it down, or allow "
            "`Body(unknown_below=...)`, or raise the lowest part (`Body(heights=...)`)"
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
        # Added, not set: travel is timed before the scores and once more after them.
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin
