"""What a run carries from view to view, what it leaves behind, and the mission clock.

The clock counts planning + mapping + flight. The simulator and the disk do not count.
"""

import enum
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np

from r3jax.errors import PathError
from r3jax.exploration.captures import CaptureSettings, Leg
from r3jax.exploration.config import Budget, ExplorationConfig
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.taken_views import StepRow
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.planner import Planner
from r3jax.planning.policy import Decision, Policy
from r3jax.planning.robot.motion import motion_of

T = TypeVar("T")


@runtime_checkable
class Clock(Protocol):
    """Converts the measured time of a stage into the time charged to the mission."""

    @property
    def measures(self) -> bool:
        """True if the charge depends on the measured time."""
        ...

    def charge(self, stage: str, measured: float) -> float:
        """Returns the seconds to charge for one call of a stage that took `measured` [s]."""
        ...


@dataclass(frozen=True)
class WallClock:
    """Charges the measured time."""

    measures: bool = True

    def charge(self, stage: str, measured: float) -> float:
        """Returns the measured time itself."""
        return measured


@dataclass(frozen=True)
class ModelClock:
    """Charges a fixed cost per stage, so that runs are repeatable."""

    costs: dict[str, float]
    """Seconds per call, by stage; `reconsidering` a decision that was made while moving, `gaze` per
    frame that is captured while moving."""

    measures: bool = False

    def charge(self, stage: str, measured: float) -> float:
        """Returns the fixed cost of the stage."""
        return self.costs[stage]


class StopReason(enum.Enum):
    """Why a run ended."""

    BUDGET = "budget"
    """The next view would exceed the budget."""

    FORECAST = "forecast"
    """The views are enough: the forecast has reached the goal."""

    NO_CANDIDATE = "no-candidate"
    """The policy found no candidate."""

    NO_REACHABLE_CANDIDATE = "no-reachable-candidate"
    """The policy found candidates, but no safe path to any of them."""

    SHUT_IN = "shut-in"
    """The robot is shut in: no path leads farther than a step."""

    STUCK = "stuck"
    """The policy is stuck: it has not moved for many views."""

    INTERRUPTED = "interrupted"
    """Ctrl-C."""

    RECORDING_STOPPED = "recording-stopped"
    """The run folder could not be written: disk full, permissions."""

    FAILED = "failed"
    """A simulator or a policy raised an error."""


COMPLETE = frozenset(
    reason.value
    for reason in (
        StopReason.BUDGET,
        StopReason.FORECAST,
        StopReason.NO_CANDIDATE,
        StopReason.NO_REACHABLE_CANDIDATE,
        StopReason.SHUT_IN,
        StopReason.STUCK,
    )
)
"""Reasons after which an exploration is complete; after any other it is not."""


class RecordingStopped(PathError):
    """A run folder could not be written during a run; all earlier views stay readable."""


def describe_counts(rows: Sequence[StepRow]) -> str:
    """Describes the numbers of views and of frames captured while moving."""
    captured = sum(row.captured for row in rows)
    return _counts_of(len(rows) - captured, captured)


def _counts_of(chosen: int, captured: int) -> str:
    return f"{chosen} views" + (f" and {captured} frames captured while moving" if captured else "")


@dataclass(frozen=True)
class PlannedAhead:
    """A decision made while the camera moves, for its arrival."""

    decision: Decision
    """The decision on the predicted map."""

    charge: float
    """Its cost on the mission clock [s]."""

    flight: float
    """Time of the flight meanwhile [s]."""

    @property
    def hidden(self) -> float:
        """Part of the cost that the flight hides [s]."""
        return min(self.charge, self.flight)


@dataclass(frozen=True)
class LoopState:
    """Everything that the next step depends on."""

    views: int
    """Number of frames in the map."""

    planner: Planner
    """The planner."""

    T_world_camera: np.ndarray
    """Pose of the last view (before the first: the start pose), [4, 4] float64."""

    seconds: float = 0.0
    """Mission clock [s]."""

    metres: float = 0.0
    """Path flown [m]."""

    radians: float = 0.0
    """Angle turned [rad]."""

    still_views: int = 0
    """Number of latest views in a row without moving."""

    captured: int = 0
    """Number of frames in the map captured while moving."""

    leg: Leg | None = None
    """The current path; None if a decision comes next."""

    planned: PlannedAhead | None = None
    """The next decision, if it was made while moving."""

    @property
    def chosen(self) -> int:
        """Number of chosen views, including the initial one."""
        return self.views - self.captured

    @property
    def counts(self) -> str:
        """Numbers of views and of frames captured while moving, in words."""
        return _counts_of(self.chosen, self.captured)

    @property
    def map_state(self) -> MapState:
        """The planner's map."""
        return self.planner.map_state

    @property
    def grid(self) -> OccupancyGrid:
        """The planner's grid."""
        return self.planner.grid

    @property
    def policy_state(self) -> Any:
        """The policy's memory."""
        return self.planner.policy_state


@dataclass(frozen=True)
class Stop:
    """No view was taken: the run ends."""

    reason: StopReason
    message: str
    """The reason in a sentence."""


@dataclass(frozen=True)
class Mission:
    """Everything that is fixed during a run: made by `explore`, read by `step`."""

    simulator: GuardedSimulator
    policy: Policy
    budget: Budget
    # Never advanced: every step folds its number in, so that resuming needs no history.
    key: jax.Array
    config: ExplorationConfig
    clock: Clock
    is_enough: Callable[[LoopState], str | None] | None = None
    """Called every `config.until_every` views; returns why no further view is needed, or None."""

    on_stage: Callable[[str], None] = lambda stage: None
    """Called with each stage: `forecast`, `plan`, `gaze`, `render`, `map`, `measure`, `record`."""

    @property
    def rules(self) -> CaptureSettings:
        """Settings that determine the frames of a path."""
        return CaptureSettings(self.config, motion_of(self.policy), self.simulator.camera)


def model_clock(config: ExplorationConfig) -> ModelClock:
    """Makes the clock of fixed costs; the costs of a decision and of a frame are settings."""
    return ModelClock(
        {
            "planning": config.planning_seconds,
            "reconsidering": 0.05,
            "mapping": config.mapping_seconds,
            "gaze": 0.01,
        }
    )


def make_clock(config: ExplorationConfig) -> Clock:
    """Makes the clock that the settings name: `wall` or `model`."""
    return WallClock() if config.clock == "wall" else model_clock(config)


class _Compilations:
    """Counts compilations of this process, from JAX's own events."""

    def __init__(self):
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.count += 1


compilations = _Compilations()
"""Of this process, so far."""


def timed(
    function: Callable[..., T], *args: Any, repeat_compiled: bool, **kwargs: Any
) -> tuple[T, float]:
    """Calls a pure function and measures its time without compilation.

    Compilation is an artifact of this software (and absent in a second run, thanks to the
    persistent cache), so it is not charged to the mission. If anything was compiled during the
    call, the call is repeated and the second one is timed; the result is the same, because the
    function is pure.

    Args:
        function: a pure function of its arguments.
        *args: its arguments.
        repeat_compiled: False if the exact time is not needed.
        **kwargs: its keyword arguments.

    Returns:
        The result, ready, and its time [s].
    """
    # Events, not a warm-up call: a growing map causes recompilation during the mission.
    before = compilations.count
    result, seconds = _measure(function, *args, **kwargs)
    if repeat_compiled and compilations.count > before:
        result, seconds = _measure(function, *args, **kwargs)
    return result, seconds


def _measure(function: Callable[..., T], *args: Any, **kwargs: Any) -> tuple[T, float]:
    # JAX returns before the device is done: without waiting only the dispatch would be charged.
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args, **kwargs))
    return result, time.perf_counter() - start
