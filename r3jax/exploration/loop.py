"""The exploration loop: step until the budget is spent, and record every view.

A run that is interrupted, or whose disk is full, ends like any other: with the reason, and with
everything recorded before complete. It goes on from there as if nothing had happened.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax

from r3jax.errors import InputError
from r3jax.exploration.clock import make_clock
from r3jax.exploration.config import Budget, ExplorationConfig, parse_budget
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.state import (
    LoopState,
    Mission,
    RecordingStopped,
    Stop,
    StopReason,
    describe_counts,
)
from r3jax.exploration.step import relive, start_state, step
from r3jax.exploration.taken_views import StepRow, TakenView
from r3jax.frame import Frame
from r3jax.planning.planner import Planner
from r3jax.planning.policy import LivesOutside, Policy
from r3jax.simulators.base import Simulator


@runtime_checkable
class Recorder(Protocol):
    """Writes a run while it is under way: `runs.writer.RunWriter` is one."""

    def record_view(self, view: TakenView, state: LoopState, config: ExplorationConfig) -> None:
        """Writes one view, and begins to write the state after it.

        Raises:
            RecordingStopped: it cannot be written; the views before it are complete.
        """
        ...

    def record_end(self, state: LoopState, stop: Stop) -> Stop:
        """Writes the last state and how the run ended; returns the end with what failed in it."""
        ...


@runtime_checkable
class RecordedViews(Protocol):
    """The views of a run that was cut off: `runs.reader.Run` has them."""

    @property
    def rows(self) -> Sequence[StepRow]:
        """One per view, in order."""
        ...

    def frame(self, step: int) -> Frame:
        """Returns the frame of one view, as it entered the map."""
        ...

    def newest_state(self, start: LoopState) -> LoopState:
        """Returns the newest stored state that can be used, or `start` if there is none."""
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
        simulator: the world; it renders images from where the camera is, and nothing else.
        policy: chooses the views.
        budget: a limit, or its text such as `views:100`.
        seed: all randomness follows from it: step k uses `fold_in(key, k)`.
        config: settings of the loop.
        recorder: where the run is written; None keeps nothing.
        resume: what was recorded of this run before it was cut off; None for a new run. Under
            the model clock the result is the one of a run that was never cut off, bit for bit.
        decided_from: the first of the recorded views that this policy chose. Of those before it
            is shown the frames, but makes no decision.
        is_enough: called every `config.until_every` views; the reason why no further view is needed
            ends the run, None lets it go on. Must come with `config.until`, which records it.
        on_view: called with every view once it is recorded, and with the planner that has seen it;
            both may be kept, as they never change.
        on_stage: called with the name of what happens next.

    Returns:
        The last state, the rows, and why it ended. An interrupt (Ctrl-C) and a disk that
        refuses to be written end the run too; what was recorded before is complete.

    Raises:
        ValueError: a budget that is not understood, a start outside the scene's box, a goal in the
            config without an `is_enough` that judges it.
        RunError: a recorded frame that is needed to go on is missing or broken.
        PolicyError: a program that chooses the views has died, hangs, or answers nonsense.
        OracleReadError: something beside the loop took an image from the simulator.
    """
    config = config or ExplorationConfig()
    # run.json records the goal as text: a rule without it could not be repeated by a resume.
    if (config.until is None) != (is_enough is None):
        raise InputError(
            f"config.until is {config.until!r}, is_enough is "
            f"{'given' if is_enough else 'not given'}: r3jax.apps.forecast.forecast.stopping_rule "
            "makes the one of the other"
        )
    budget = parse_budget(budget) if isinstance(budget, str) else budget
    # Apart: how a policy starts must not change what it draws later.
    init_key, key = jax.random.split(jax.random.key(seed))
    mission = Mission(
        # A resumed run reads its old images from the disk: the guard counts them as taken.
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
        # Also for a resume: it gives the arrays of a checkpoint their structure, and is where to
        # begin again if no checkpoint can be used.
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
    """Rebuilds the state after the last recorded view, from the newest stored state.

    Rows and frames alone rebuild the state, from the first view if need be; a stored state saves
    the time. So one that is missing, damaged or of another version costs time, not the run.

    Raises:
        RunError: a frame that is needed is missing, broken, or not the one that was recorded.
    """
    # A stored state has neither the decision that was made while moving, nor the memory of an
    # external program: all views are processed again.
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
    """Steps until something ends the run; adds to `rows`, and records the end."""
    try:
        stop: Stop | None = None
        while stop is None:
            after, output = step(state, mission)
            if isinstance(output, Stop):
                # The state after a stop is dropped: with a larger budget a resume asks the policy
                # again from the last view, as a run with that budget would have done.
                stop = output
                continue
            if recorder is not None:
                mission.on_stage("record")
                recorder.record_view(output, after, mission.config)
            # Only once it is recorded: a disk that is full ends the run at what is on it.
            state = after
            rows.append(output.row)
            on_view(output, state.planner)
    # The view under way is dropped; if its row is on the disk already, a resume finds it there.
    except KeyboardInterrupt:
        stop = Stop(
            StopReason.INTERRUPTED, f"interrupted by the user after {describe_counts(rows)}"
        )
    # Before `Exception`, of which it is one: a full disk ends a run without being its failure.
    except RecordingStopped as error:
        stop = Stop(StopReason.RECORDING_STOPPED, str(error))
    # The record of a failure ends properly, too; the error itself goes on to the caller.
    except Exception as error:
        if recorder is not None:
            failure = Stop(StopReason.FAILED, f"{type(error).__name__}: {error}")
            recorder.record_end(state, failure)
        raise
    return state, stop if recorder is None else recorder.record_end(state, stop)
