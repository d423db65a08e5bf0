"""The interface of policies: what they get and what they return. Types only."""

import enum
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.travel import Travel


class PolicyError(RuntimeError):
    """A policy cannot decide, for this reason: the run ends, and its record stays."""


class DecisionOutcome(enum.Enum):
    """The outcome of a decision.

    Any other than MOVED ends the run, with the reason in the trace.
    """

    MOVED = "moved"
    """A candidate was chosen."""

    NO_CANDIDATE = "no-candidate"
    """No candidate could be drawn: no free cell within the radius."""

    NO_REACHABLE_CANDIDATE = "no-reachable-candidate"
    """Candidates were drawn, but no safe path leads to any of them."""

    SHUT_IN = "shut-in"
    """The latest goals are all within a step of each other, and no path leads farther."""


@dataclass(frozen=True)
class Decision:
    """The next view, the path to it, and the other candidates. On the host: NumPy."""

    T_world_camera: np.ndarray
    """The chosen pose, [4, 4] float64."""

    waypoints: np.ndarray
    """Path of the camera center [m], [K, 3], from the present position to the chosen one."""

    length: float
    """Length of that path [m]."""

    score: float
    """U_view of the chosen pose."""

    candidates: np.ndarray
    """Every pose that was scored, [C, 4, 4]."""

    utilities: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """Scores per candidate, [C] each: always `total` and `path` [m] (including the cost of
    turning); `utility` if views were scored, and its parts `exploration` and `rendering` if
    computed separately."""

    seconds: float | None = None
    """Time for the path and the turn [s]; None: the length divided by the loop's speed."""


@dataclass(frozen=True)
class PlanInfo:
    """Information on a decision."""

    outcome: DecisionOutcome
    num_candidates: int = 0
    num_reachable: int = 0
    stage_seconds: dict[str, float] = field(default_factory=dict[str, float])
    """Wall time per part of the decision (`candidates`, `travel`, `scoring`) [s]."""

    reason: str = ""
    """Why there is no decision, and what to do; empty if there is one."""

    limited_by: dict[str, int] = field(default_factory=dict[str, int])
    """If there is no decision: numbers of cells near the robot closed by each limit."""

    expected_gain: float | None = None
    """Expected gain of the chosen view in the policy's own measure (R3: the utility U, before paths
    are weighed); None without a decision or without such a measure."""


@dataclass(frozen=True)
class Situation:
    """Everything that a decision may depend on: map, grid, pose and reachable space."""

    map_state: MapState

    grid: OccupancyGrid
    """The grid, for travel."""

    scoring_grid: OccupancyGrid
    """The grid with a mask of the cells that may be unexplored (`look_round`), for utilities."""

    travel: Travel
    """Reachable space."""

    camera: Camera
    """The camera."""

    memory: Any
    """The policy's own memory."""

    limits: Limits = field(default_factory=Limits)
    """Limits of the robot's next view. Candidates may violate them: `decide` projects them."""

    notes: Any = None
    """Notes of `draw` on the candidates."""


@runtime_checkable
class Policy(Protocol):
    """Chooses the next view. Pure: its memory is passed as `state`."""

    name: str

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Any:
        """Returns the state before the first frame."""
        ...

    def observe(self, state: Any, map_state: MapState, frame: Frame) -> Any:
        """Returns the state after a frame, which is already in the map."""
        ...

    def decide(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, Any, PlanInfo]:
        """Chooses the next view; None if there is none, with the reason in the info."""
        ...

    def follow(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> Any:
        """Returns the state after a path that another policy chose (forked runs).

        Args:
            state: the policy's memory.
            map_state: the map, including the latest view.
            grid: the grid, including the latest view.
            T_world_camera: where the latest view was taken.
            waypoints: the path to the next one, [K, 3] [m].
        """
        ...


@runtime_checkable
class PlansAhead(Policy, Protocol):
    """A policy whose decisions can begin before the camera has arrived."""

    def reconsider(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        planned: Decision,
        *,
        key: Array,
    ) -> tuple[Decision | None, Any, PlanInfo]:
        """Decides again among the best candidates of a decision, on the current map.

        The decision is None if no path leads to any of them: the policy must decide again.
        """
        ...


@runtime_checkable
class LivesOutside(Policy, Protocol):
    """A policy whose memory is in an external program: it cannot be stored, and must be closed.

    Resuming its run sends all frames from the first view on to the program, and decides again.
    """

    def close(self) -> None:
        """Ends the programs."""
        ...
