"""What a run carries from view to view, and what it leaves behind."""

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
    """The robot cannot leave its place: no path leads farther than a step."""

    STUCK = "stuck"
    """The policy has not moved for many views."""

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
"""Ends that belong to the result; after any other an exploration is not over."""


class RecordingStopped(PathError):
    """A run folder refused a write in the middle of a run; everything before it stays readable."""


def describe_counts(rows: Sequence[StepRow]) -> str:
    """Says how many views and how many frames captured while moving the rows of a run hold."""
    captured = sum(row.captured for row in rows)
    return _counts_of(len(rows) - captured, captured)


def _counts_of(chosen: int, captured: int) -> str:
    return f"{chosen} views" + (f" and {captured} frames captured while moving" if captured else "")


@dataclass(frozen=True)
class PlannedAhead:
    """A decision that is made while the camera flies, for when it arrives."""

    decision: Decision
    """What the policy decided, on the map as it was expected to be."""

    charge: float
    """What it takes on the mission clock [s]."""

    flight: float
    """How long the camera flies meanwhile [s]."""

    @property
    def hidden(self) -> float:
        """Part of the charge that the flight hides [s]."""
        return min(self.charge, self.flight)


@dataclass(frozen=True)
class LoopState:
    """Everything that the next step depends on."""

    views: int
    """Frames in the map."""

    planner: Planner
    """What is known, and what the policy remembers."""

    T_world_camera: np.ndarray
    """Pose of the last view (before the first: the start pose), [4, 4] float64."""

    seconds: float = 0.0
    """Mission clock [s]."""

    metres: float = 0.0
    """Path flown [m]."""

    radians: float = 0.0
    """Angle turned [rad]."""

    still_views: int = 0
    """Views in a row that were taken without moving."""

    captured: int = 0
    """Frames in the map that were captured while moving."""

    leg: Leg | None = None
    """The path under way; None where a decision comes next."""

    planned: PlannedAhead | None = None
    """The decision that comes next, as far as it was made while moving."""

    @property
    def chosen(self) -> int:
        """Views that were chosen, and the one at the start."""
        return self.views - self.captured

    @property
    def counts(self) -> str:
        """Number of views, and of frames captured while moving where there are any, in words."""
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
        """What the policy remembers."""
        return self.planner.policy_state


@dataclass(frozen=True)
class Stop:
    """No view was taken: the run ends."""

    reason: StopReason
    message: str
    """The reason in a sentence."""


@dataclass(frozen=True)
class Mission:
    """What stays the same over a run: `explore` makes it, `step` reads it."""

    simulator: GuardedSimulator
    policy: Policy
    budget: Budget
    # Never advanced: every step folds its number in, so a resume needs none of its history.
    key: jax.Array
    config: ExplorationConfig
    clock: Clock
    is_enough: Callable[[LoopState], str | None] | None = None
    """Called every `config.until_every` views: why no further view is needed, or None."""

    on_stage: Callable[[str], None] = lambda stage: None
    """Told what happens next: `forecast`, `plan`, `gaze`, `render`, `map`, `measure`, `record`."""

    @property
    def rules(self) -> CaptureSettings:
        """Settings that determine the frames of a path."""
        return CaptureSettings(self.config, motion_of(self.policy), self.simulator.camera)
