"""What a run writes, and how it goes on where it was cut off: its newest checkpoint, then frames.

Rows and frames alone rebuild the state, from the first view if need be; a checkpoint saves the
time. So a checkpoint that is missing, damaged or of another version costs time, not the run.
"""

import time
from dataclasses import fields, replace
from typing import Any

import numpy as np

from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import LoopState, Mission, Stop, TakenView
from r3jax.exploration.step import relive
from r3jax.planning.policy import LivesOutside
from r3jax.trace.arrays import fill, named_arrays
from r3jax.trace.checkpoints import Tables, map_tables
from r3jax.trace.errors import RecordingStopped, RunError
from r3jax.trace.reader import Run
from r3jax.trace.writer import RunWriter

_APART = ("planner", "leg", "planned")

_LOOP = tuple(field.name for field in fields(LoopState) if field.name not in _APART)
"""Fields of the state in the table `loop`; what the planner holds has tables of its own, and what
is under way is decided again."""

_LATER = {"captured": np.asarray(0)}
"""Fields that came after the first checkpoints, as they were then."""


def record_view(
    recorder: RunWriter, view: TakenView, state: LoopState, config: ExplorationConfig
) -> None:
    """Writes one view, and begins to write the state after it."""
    begin = time.perf_counter()
    # The view first: a resume ignores a checkpoint that has no row, and can do without one.
    recorder.add(view.row, view.frame)
    if not view.row.captured and state.chosen % config.checkpoint_every == 0:
        recorder.checkpoint(view.row.step, state_tables(state))
    seconds = time.perf_counter() - begin
    recorder.add_timings(view.row.step, view.stages | {"record": seconds})


def record_end(recorder: RunWriter, state: LoopState, stop: Stop) -> Stop:
    """Writes the last map and how the run ended; a full disk may refuse even that."""
    try:
        if state.views > 0:
            # Before the end row, whose message can then say that this map is missing.
            recorder.checkpoint(state.views - 1, state_tables(state), wait=True)
    except RecordingStopped as error:  # the frames stay, and the map can be made of them again
        # The full disk that ended the run is not told twice.
        if error.reason not in stop.message:
            stop = Stop(stop.reason, f"{stop.message}; the last map is not stored ({error.reason})")
    try:
        recorder.finish(stop.reason.value, stop.message)
    except RecordingStopped as error:
        # Told to the caller only: on the disk the run looks cut off, and can be resumed.
        return Stop(stop.reason, f"{stop.message}; the end is not recorded ({error.reason})")
    return stop


def state_tables(state: LoopState) -> dict[str, dict[str, np.ndarray]]:
    """The state as a checkpoint holds it."""
    tables = map_tables(state.map_state, state.grid)
    tables["policy"] = named_arrays(state.policy_state)
    return tables | {"loop": {name: np.asarray(getattr(state, name)) for name in _LOOP}}


def state_of(tables: Tables, like: LoopState) -> LoopState:
    """Inverse of `state_tables`.

    Args:
        tables: of a checkpoint.
        like: a state of the same run, such as its first: what is not an array is taken from it.

    Raises:
        ValueError: a table or an array is missing or of another kind.
    """
    # Not `policy`: a policy that remembers nothing has no such table.
    missing = sorted({"map", "grid", "loop"} - set(tables))
    if missing:
        raise ValueError(f"the checkpoint lacks {', '.join(missing)}")
    arrays = dict(tables["map"])
    # No array of the map, so `fill` would not notice: with other bins the visited bits of a row
    # stand for other directions.
    if int(arrays.pop("num_bins", -1)) != like.map_state.num_bins:
        raise ValueError("the checkpoint's map has other direction bins than the run")
    # Through `fill`, so that totals come back as plain numbers and are summed as before.
    rest = {name: getattr(like, name) for name in _LOOP}
    planner = replace(
        like.planner,
        map_state=fill(like.map_state, arrays),
        grid=fill(like.grid, tables["grid"]),
        policy_state=fill(like.policy_state, tables.get("policy", {})),
    )
    return LoopState(planner=planner, **fill(rest, _LATER | dict(tables["loop"])))


def continued(run: Run, mission: Mission, start: LoopState, *, decided_from: int = 0) -> LoopState:
    """The state after the last recorded view.

    Args:
        run: what was recorded; its trace may have been cut off anywhere.
        mission: what the run was asked for.
        start: the state before the first view.
        decided_from: the first view that the mission's policy chose.

    Raises:
        RunError: a frame that is needed is missing, broken, or not the one that was recorded.
    """
    # What began before the checkpoint's view is not in it, nor what a program remembers: all is
    # lived through again.
    anew = mission.config.plan_while_moving or isinstance(mission.policy, LivesOutside)
    state = start if anew else _newest(run, start)
    for row in run.rows[state.views :]:
        mission.on_stage("map")
        decides = row.step >= decided_from
        state, _ = relive(state, mission, row, run.frame(row.step), decides=decides)
    return state


def _newest(run: Run, start: LoopState) -> LoopState:
    """The newest usable checkpoint; the start if there is none."""
    # Newest first: every view after a checkpoint costs one more mapping and decision.
    for step in reversed(run.checkpoint_steps()):
        # The trace was cut before it: its map holds views that the run no longer has. Or a path is
        # under way: it is decided again, from where it begins.
        if step >= len(run.rows) or run.rows[step].captured:
            continue
        try:
            state = state_of(run.load_checkpoint(step), start)
        except (RunError, ValueError):
            continue  # an older one, or the frames, will do
        if _agrees(state, run.rows[step]):
            return state
    return start


def _agrees(state: LoopState, row: Any) -> bool:
    """Whether a checkpoint belongs to a row of the trace."""
    # Exact: JSON and checkpoints hold every float as it is, so any difference is a mismatch.
    return (
        state.views == row.step + 1
        and np.array_equal(np.asarray(state.T_world_camera, np.float32), row.pose)
        and (state.seconds, state.metres) == (row.seconds, row.metres)
    )
