"""The exploration loop: step until the budget is spent, and record every view.

An interrupted run, or one with a full disk, ends like any other: with a reason, and with a complete
record of all earlier views. It can be resumed with the same result as without the interruption.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax

from r3jax.errors import InputError
from r3jax.exploration.config import Budget, ExplorationConfig, parse_budget
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.state import (
    LoopState,
    Mission,
    RecordingStopped,
    Stop,
    StopReason,
    describe_counts,
    make_clock,
)
from r3jax.exploration.step import relive, start_state, step
from r3jax.exploration.taken_views import StepRow, TakenView
from r3jax.frame import Frame
from r3jax.planning.planner import Planner
from r3jax.planning.policy import LivesOutside, Policy
from r3jax.simulators.base import Simulator


@runtime_checkable
class Recorder(Protocol):
    """The interface for recording a run; implemented by `runs.writer.RunWriter`."""

    def record_view(self, view: TakenView, state: LoopState, config: ExplorationConfig) -> None:
        """Writes one view, and starts writing the state after it.

        Raises:
            RecordingStopped: it cannot be written; the views before it are complete.
        """
        ...

    def record_end(self, state: LoopState, stop: Stop) -> Stop:
        """Writes the last state and how the run ended; returns the end, with failures added."""
        ...


@runtime_checkable
class RecordedViews(Protocol):
    """The interface for the record of an interrupted run; implemented by `runs.reader.Run`."""

    @property
    def rows(self) -> Sequence[StepRow]:
        """One per view, in order."""
        ...

    def frame(self, step: int) -> Frame:
        """Returns the frame of one view, as it entered the map."""
        ...

    def newest_state(self, start: LoopState) -> LoopState:
        """Returns the newest usable checkpoint, or `start` if there is none."""
        ...


@dataclass(frozen=True)
class Result:
    """A finished exploration."""

    state: LoopState
    rows: tuple[StepRow, ...]
    reason: StopReason
    message: str


def explore(
    simulator: Simulator,
    policy: Policy,
    *,
    budget: Budget | str,
    seed: int = 0,
    config: ExplorationConfig | None = None,
    recorder: Recorder | None = None,
    resume: RecordedViews | None = None,
    decided_from: int = 0,
    is_enough: Callable[[LoopState], str | None] | None = None,
    on_view: Callable[[TakenView, Planner], None] | None = None,
    on_stage: Callable[[str], None] | None = None,
) -> Result:
    """Explores an unknown scene until the budget is spent or no view is left.

    Args:
        simulator: the world, used only to render images at the camera's poses.
        policy: the policy that chooses the views.
        budget: a limit, or its text such as `views:100`.
        seed: random seed; step k uses `fold_in(key, k)`.
        config: settings of the loop.
        recorder: writes the run; None: nothing is written.
        resume: the record of an interrupted run to resume; None for a new run. With the model clock
            the result is bit-identical to that of an uninterrupted run.
        decided_from: the first recorded view that this policy chose. For earlier views it gets the
            frames, but makes no decisions.
        is_enough: called every `config.until_every` views; returns the reason why no further view
            is needed, which ends the run, or None. Requires `config.until`, which records it.
        on_view: called with every recorded view and the planner after it; both are immutable.
        on_stage: called with the name of each stage when it begins.

    Returns:
        The last state, the rows, and why the run ended. An interrupt (Ctrl-C) or a full disk also
        ends the run; the record of earlier views is complete.

    Raises:
        ValueError: an invalid budget, a start outside the scene's box, `config.until` without
            `is_enough`.
        RunError: a recorded frame that is needed to resume is missing or broken.
        PolicyError: an external policy program has died, hangs, or sends invalid replies.
        OracleReadError: an image was rendered outside the loop.
    """
    config = config or ExplorationConfig()
    # run.json records the goal as text: without it the rule could not be resumed.
    if (config.until is None) != (is_enough is None):
        raise InputError(
            f"config.until is {config.until!r}, is_enough is "
            f"{'given' if is_enough else 'not given'}: r3jax.apps.forecast.forecast.stopping_rule "
            "makes the one of the other"
        )
    budget = parse_budget(budget) if isinstance(budget, str) else budget
    # Separate keys: initializing a policy must not change its later random numbers.
    init_key, key = jax.random.split(jax.random.key(seed))
    mission = Mission(
        # A resumed run reads its earlier images from disk: the guard counts them as taken.
        GuardedSimulator(simulator, views=0 if resume is None else len(resume.rows)),
        policy,
        budget,
        key,
        config,
        make_clock(config),
        is_enough,
        on_stage=on_stage or (lambda stage: None),
    )
    rows: list[StepRow] = []
    try:
        # Also for a resumed run: it gives a checkpoint's arrays their structure, and is the
        # fallback if no checkpoint can be used.
        state = start_state(mission, init_key)
        if resume is not None:
            state = _continued(resume, mission, state, decided_from=decided_from)
            rows = list(resume.rows)
        state, stop = _go(state, mission, rows, recorder, on_view or (lambda view, planner: None))
    finally:
        if isinstance(policy, LivesOutside):
            policy.close()
    return Result(state, tuple(rows), stop.reason, stop.message)


def _continued(
    run: RecordedViews, mission: Mission, start: LoopState, *, decided_from: int
) -> LoopState:
    """Rebuilds the state after the last recorded view, from the newest checkpoint.

    Rows and frames suffice to rebuild the state, if needed from the first view on; checkpoints save
    time. So a checkpoint that is missing, damaged or of another version only costs time.

    Raises:
        RunError: a frame that is needed is missing, broken, or not the one that was recorded.
    """
    # Checkpoints contain neither decisions made while moving nor the memory of external programs:
    # all views are processed again.
    is_stored = not (mission.config.plan_while_moving or isinstance(mission.policy, LivesOutside))
    state = run.newest_state(start) if is_stored else start
    for row in run.rows[state.views :]:
        mission.on_stage("map")
        decides = row.step >= decided_from
        state, _ = relive(state, mission, row, run.frame(row.step), decides=decides)
    return state


def _go(
    state: LoopState,
    mission: Mission,
    rows: list[StepRow],
    recorder: Recorder | None,
    on_view: Callable[[TakenView, Planner], None],
) -> tuple[LoopState, Stop]:
    """Steps until the run ends; appends to `rows`, and records the end."""
    try:
        stop: Stop | None = None
        while stop is None:
            after, output = step(state, mission)
            if isinstance(output, Stop):
                # The state after a stop is dropped: when resumed with a larger budget, the policy
                # decides again from the last view, as in a run with that budget.
                stop = output
                continue
            if recorder is not None:
                mission.on_stage("record")
                recorder.record_view(output, after, mission.config)
            # Only once it is recorded: with a full disk the run ends at the last recorded view.
            state = after
            rows.append(output.row)
            on_view(output, state.planner)
    # The current view is dropped; if its row is on disk already, it is used when resuming.
    except KeyboardInterrupt:
        stop = Stop(
            StopReason.INTERRUPTED, f"interrupted by the user after {describe_counts(rows)}"
        )
    # Before `Exception`, its base class: a full disk ends a run, but is not a failure of it.
    except RecordingStopped as error:
        stop = Stop(StopReason.RECORDING_STOPPED, str(error))
    # The record of a failure ends properly, too; the error itself is raised to the caller.
    except Exception as error:
        if recorder is not None:
            failure = Stop(StopReason.FAILED, f"{type(error).__name__}: {error}")
            recorder.record_end(state, failure)
        raise
    return state, stop if recorder is None else recorder.record_end(state, stop)
