"""The frame that every policy's decision is built in: look round, score, choose, remember."""

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.motion import Motion
from r3jax.planning.robot.travel import Travel, plan_travel
from r3jax.scoring.explain import Explanation, explain_view
from r3jax.scoring.utility import visible_unexplored

ENOUGH_LOOKS = 3
"""So many views that should have shown a cell, and left it unexplored, and it is left alone: it
lies behind a window, where the depth sensor fails, or where hits and passes cancel out."""


class PlannerState(eqx.Module):
    """What a policy of this package remembers between decisions."""

    camera: Camera
    """The camera of every frame to come."""

    trail: Bool[np.ndarray, "X Y Z"] = eqx.field(converter=np.asarray)
    """Cells that the robot has come through: the way back if it finds itself shut in."""

    looks: Int[np.ndarray, "X Y Z"] = eqx.field(converter=np.asarray)
    """Views that should have shown each cell and left it unexplored."""

    start_height: Float[Array, ""] | None = None
    """Height of the first view [m], NaN before it; None for a motion whose heights do not count
    from it."""

    memory: Any = None
    """Arrays that one policy keeps beside the map: a pytree of its own."""


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


def initial_state(
    camera: Camera, grid: OccupancyGrid, memory: Any = None, motion: Motion | None = None
) -> PlannerState:
    """The memory of a robot that has not moved yet."""
    nowhere = np.zeros(grid.log_odds.shape, dtype=bool)
    looks = np.zeros(grid.log_odds.shape, dtype=np.int32)
    is_relative = motion is not None and motion.is_relative
    # NaN, not None, until the first view: the tree of arrays keeps its structure from there on.
    start_height = jnp.asarray(jnp.nan, dtype=jnp.float32) if is_relative else None
    return PlannerState(camera, nowhere, looks, start_height, memory)


def prepare_decision(
    state: PlannerState,
    map_state: MapState,
    grid: OccupancyGrid,
    T_world_camera: np.ndarray,
    config: PlannerConfig,
) -> tuple[PlannerState, Travel, OccupancyGrid]:
    """Where the robot can go from here, and the grid without cells that are not worth a look.

    Args:
        state: the policy's memory.
        map_state: the map, the view from here included.
        grid: the grid, the same.
        T_world_camera: where the latest view was taken.
        config: the safety margin, what carries the camera, and how far it sees.

    Returns:
        The memory with the view from here counted in, the paths, and the grid for scoring: cells
        that no robot can look at, and those that several views left unexplored, are not worth a
        look in it (`mask_unexplorable`).
    """
    # float64: in float32 a robot on a border of cells could stand in either of them.
    position = np.asarray(T_world_camera, dtype=np.float64)[:3, 3]
    state = _with_start(state, position[2])
    motion, start = config.motion, state.start_height
    # Heights count from the first view, or a robot would creep up by its range each time.
    heights = motion.heights_from(0.0 if start is None else float(start))
    travel = plan_travel(grid, position, config.safety_margin, state.trail, heights, motion.body)
    pose = jnp.asarray(T_world_camera, dtype=jnp.float32)
    # What this view should have shown: if it is still unexplored, the look was in vain.
    visible = visible_unexplored(map_state, grid, state.camera, pose, config.scoring)
    state = replace(state, looks=state.looks + np.asarray(visible, dtype=np.int32))
    # Three looks in vain: more would not help, and the utility would call for them for ever.
    is_exhausted = state.looks >= ENOUGH_LOOKS
    return state, travel, mask_unexplorable(grid, travel.reachable, is_exhausted)


def _with_start(state: PlannerState, height: float) -> PlannerState:
    """Notes the height [m] of the first view, if that has not been done."""
    start = state.start_height
    if start is None or not np.isnan(start):
        return state
    return replace(state, start_height=jnp.asarray(height, dtype=jnp.float32))


def follow_path(
    state: PlannerState,
    map_state: MapState,
    grid: OccupancyGrid,
    T_world_camera: np.ndarray,
    waypoints: np.ndarray,
    config: PlannerConfig,
) -> PlannerState:
    """The memory of a robot that goes a way which its policy did not choose."""
    # As for a decision of its own: looks in vain count, whoever chose the way.
    state, travel, _ = prepare_decision(state, map_state, grid, T_world_camera, config)
    return _with_path(state, travel, waypoints)


def explain_path(
    state: PlannerState,
    map_state: MapState,
    grid: OccupancyGrid,
    T_world_camera: np.ndarray,
    T_chosen: np.ndarray,
    waypoints: np.ndarray,
    config: PlannerConfig,
) -> tuple[PlannerState, Explanation]:
    """As `follow_path`, and what the view at the end of the path promises when it is chosen.

    Args:
        state: the policy's memory.
        map_state: the map, the view from here included.
        grid: the grid, the same.
        T_world_camera: where the latest view was taken.
        T_chosen: the view that was chosen, by whatever rule.
        waypoints: the path to it, [K, 3] [m].
        config: of the policy.

    Returns:
        The memory with the path counted in, and the utility by cause; of the unexplored cells those
        count that decisions are scored on (`prepare_decision`).
    """
    state, travel, scoring_grid = prepare_decision(state, map_state, grid, T_world_camera, config)
    pose = jnp.asarray(T_chosen, dtype=jnp.float32)
    explanation = explain_view(map_state, scoring_grid, state.camera, pose, config.scoring)
    return _with_path(state, travel, waypoints), explanation


def no_decision(
    travel: Travel, config: PlannerConfig, stopwatch: Stopwatch
) -> tuple[None, PlanInfo]:
    """The answer of a policy that found no candidate: safe places exist, or not even those."""
    centers = travel.centers(np.argwhere(travel.safe))
    # Safe places in reach of the arm that no path leads to: said apart from none at all.
    near = np.linalg.norm(centers - travel.start, axis=1) <= config.radius
    reason = DecisionOutcome.NO_REACHABLE_CANDIDATE if near.any() else DecisionOutcome.NO_CANDIDATE
    info = PlanInfo(reason, num_candidates=int(near.sum()), stage_seconds=stopwatch.seconds)
    return None, info


def select_best(
    state: PlannerState,
    travel: Travel,
    candidates: Candidates,
    utilities: dict[str, np.ndarray],
    limits: Limits,
    stopwatch: Stopwatch,
) -> tuple[int, Decision, PlannerState, PlanInfo]:
    """Takes the candidate of the greatest `total` and finds the path to it.

    Args:
        state: the policy's memory.
        travel: what can be reached.
        candidates: at least one of them reachable.
        utilities: per candidate, [C] each; `total` and `path` among them. A candidate whose
            path is infinite is never taken.
        limits: what the path and the turn cost.
        stopwatch: what took how long.

    Returns:
        Which candidate it is, the decision, the memory with the path counted in, and the info.
    """
    with stopwatch.part("travel"):
        is_reachable = np.isfinite(utilities["path"])
        # Padding has an infinite path too, so that it can never win.
        best = int(np.argmax(np.where(is_reachable, utilities["total"], -np.inf)))
        waypoints = travel.path(candidates.position[best])
    # Measured anew: shortcuts may have made the path shorter than the length that was weighed.
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    # The edge: matrices for whoever renders or records, without the padding.
    poses, on_offer = candidates.T_world_camera, candidates.valid
    decision = Decision(
        T_world_camera=poses[best],
        waypoints=waypoints,
        length=length,
        seconds=limits.seconds(length, candidates.direction[best]),
        score=float(utilities["total"][best]),
        candidates=poses[on_offer],
        utilities={name: values[on_offer] for name, values in utilities.items()},
    )
    num_reachable = int(is_reachable.sum())
    info = PlanInfo(DecisionOutcome.MOVED, candidates.num_valid, num_reachable, stopwatch.seconds)
    return best, decision, _with_path(state, travel, waypoints), info


def _with_path(state: PlannerState, travel: Travel, waypoints: np.ndarray) -> PlannerState:
    # All cells that the lines cross, not the waypoints alone: the way back must be connected.
    return replace(state, trail=state.trail | travel.cells_along(waypoints))


def net_utility(
    utility: np.ndarray,
    path: np.ndarray,
    lambda2: float,
    among: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """U_view of each candidate, from its utility and path length [C].

    U_view = utility / sum(utility) - lambda2 * path / sum(path), both sums over the reachable
    candidates; a sum of 0 leaves its term out. Unreachable: -inf. (Active-GS sums utilities over
    all candidates, paths over the reachable ones.)

    Args:
        utility: of each candidate.
        path: length of the path to it, or what it costs; inf: unreachable.
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
        # A sum of 0 says nothing about anybody: its term is left out, not infinite.
        shares.append(values / (total or 1.0))
    return np.where(is_reachable, shares[0] - lambda2 * shares[1], -np.inf)
