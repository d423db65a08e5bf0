"""The plug point of the loop: what a policy is asked, and what it answers. Types only."""

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
    """A policy that cannot decide, and why: the run ends, what was recorded stays."""


class DecisionOutcome(enum.Enum):
    """How a decision ended. Anything but MOVED ends the run, with the reason in the trace."""

    MOVED = "moved"
    """A candidate was chosen."""

    NO_CANDIDATE = "no-candidate"
    """No candidate could be drawn: no free cell in reach."""

    NO_REACHABLE_CANDIDATE = "no-reachable-candidate"
    """Candidates were drawn, but no safe path leads to any of them."""

    SHUT_IN = "shut-in"
    """The latest goals all lay within a step of each other, and no path leads farther."""


@dataclass(frozen=True)
class Decision:
    """Where to go next, how, and what else was on offer. On the host: NumPy."""

    T_world_camera: np.ndarray
    """The chosen pose, [4, 4] float64."""

    waypoints: np.ndarray
    """Path of the camera center [m], [K, 3]; first the present position, last the chosen one."""

    length: float
    """Length of that path [m]."""

    score: float
    """U_view of the chosen pose."""

    candidates: np.ndarray
    """Every pose that was scored, [C, 4, 4]."""

    utilities: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """Per candidate, [C] each: always `total`, and `path` [m], what turning costs included;
    `utility` where views were scored, and its parts `exploration` and `rendering` where they were
    told apart."""

    seconds: float | None = None
    """Time for the path and the turn [s]; None: the length over the loop's speed."""


@dataclass(frozen=True)
class PlanInfo:
    """What happened while deciding."""

    outcome: DecisionOutcome
    num_candidates: int = 0
    num_reachable: int = 0
    stage_seconds: dict[str, float] = field(default_factory=dict[str, float])
    """Wall time per part of the decision (`candidates`, `travel`, `scoring`) [s]."""

    reason: str = ""
    """Why there is no decision, and what to do; empty where there is one."""

    limited_by: dict[str, int] = field(default_factory=dict[str, int])
    """Where there is no decision: how many cells near the robot each limit closes."""

    expected_gain: float | None = None
    """What the chosen view is expected to add, in the policy's own measure (of R3: the utility U
    before paths are weighed); None without a decision, and where a policy has no such measure."""


@dataclass(frozen=True)
class Situation:
    """All that a decision may depend on: what is known, where the robot is and can go."""

    map_state: MapState

    grid: OccupancyGrid
    """Grid as it is; for travel."""

    scoring_grid: OccupancyGrid
    """The same with a mask of the cells that count (`look_round`); for
    utilities."""

    travel: Travel
    """Where the robot can go from here."""

    camera: Camera
    """Camera of every frame to come."""

    memory: Any
    """What the policy keeps beside the map."""

    limits: Limits = field(default_factory=Limits)
    """What the robot may do next. Candidates need not lie within them: `decide`
    sees to that."""

    notes: Any = None
    """What `draw` noted of the candidates."""


@runtime_checkable
class Policy(Protocol):
    """Chooses the next view. Pure: what it remembers travels in `state`."""

    name: str

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Any:
        """Returns the state before the first frame."""
        ...

    def observe(self, state: Any, map_state: MapState, frame: Frame) -> Any:
        """Takes note of a frame that has just been integrated into the map."""
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
        """Notes a path that another policy chose, before the robot follows it (forked runs).

        Args:
            state: what the policy remembers.
            map_state: the map, the latest view included.
            grid: the grid, the same.
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
        """Decides again among the best candidates of a decision, on what has come in since.

        The decision is None if no path leads to any of them: the policy must decide again.
        """
        ...


@runtime_checkable
class LivesOutside(Policy, Protocol):
    """A policy whose memory is in a program of its own: it cannot be stored, and must be ended.

    Resuming a run of it shows the program all frames from the first view on, and decides again.
    """

    def close(self) -> None:
        """Ends the programs."""
        ...
