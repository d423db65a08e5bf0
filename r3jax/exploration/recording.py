"""What a run writes: a view and the state after it, and how it ended."""

import time

from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.resume import state_tables
from r3jax.exploration.state import LoopState, Stop, TakenView
from r3jax.trace.errors import RecordingStopped
from r3jax.trace.writer import RunWriter


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
