"""The state of a run, and how it ends."""

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from r3jax.errors import PathError
from r3jax.exploration.captures import CaptureSettings, Leg
from r3jax.exploration.clock import Clock
from r3jax.exploration.config import Budget, ExplorationConfig
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.taken_views import StepRow
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.planner import Planner
from r3jax.planning.policy import Decision, Policy
from r3jax.planning.robot.motion import motion_of


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
