"""What a run writes: a view and the state after it, and how it ended."""

import time

from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.resume import state_tables
from r3jax.exploration.state import LoopState, Stop, View
from r3jax.trace.errors import RecordingStopped
from r3jax.trace.writer import RunWriter


def record_view(
    recorder: RunWriter, view: View, state: LoopState, config: ExplorationConfig
) -> None:
    """Writes one view, and begins to write the state after it."""
    begin = time.perf_counter()
    recorder.add(view.row, view.frame)
    if state.views % config.checkpoint_every == 0:
        recorder.checkpoint(view.row.step, state_tables(state))
    seconds = time.perf_counter() - begin
    recorder.add_timings(view.row.step, view.stages | {"record": seconds})


def record_end(recorder: RunWriter, state: LoopState, stop: Stop) -> Stop:
    """Writes the last map and how the run ended; a full disk may refuse even that."""
    try:
        if state.views > 0:
            recorder.checkpoint(state.views - 1, state_tables(state), wait=True)
    except RecordingStopped as error:  # the frames stay, and the map can be made of them again
        if error.reason not in stop.message:
            stop = Stop(stop.reason, f"{stop.message}; the last map is not stored ({error.reason})")
    try:
        recorder.finish(stop.reason.value, stop.message)
    except RecordingStopped as error:
        return Stop(stop.reason, f"{stop.message}; the end is not recorded ({error.reason})")
    return stop
