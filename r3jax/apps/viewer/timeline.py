"""The map and the grid of a recorded run after any of its views.

They are rebuilt from the frames, one frame after the other. Some states on the way are kept, as
many as fit in a given memory and evenly spaced, so that any view is a few frames away from one.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import jax
import numpy as np

from r3jax.exploration.replay import config_of, grid_before
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState, empty_map
from r3jax.planning.planner import add_frame
from r3jax.trace.errors import RunError
from r3jax.trace.reader import Run

MEMORY = 512 << 20
"""What kept states may take [bytes]."""


@dataclass(frozen=True)
class Moment:
    """What was known after a view."""

    step: int
    """Number of the view; -1 before the first."""

    map_state: MapState
    grid: OccupancyGrid

    @property
    def nbytes(self) -> int:
        """Memory of its arrays [bytes]."""
        return sum(x.nbytes for x in jax.tree.leaves((self.map_state, self.grid)))


class Timeline:
    """The states of a run. For one thread at a time."""

    def __init__(self, run: Run, memory: int = MEMORY):
        """Prepares the state before the first view; reads no frame.

        Args:
            run: with at least one view.
            memory: what kept states may take [bytes]; two are always kept.

        Raises:
            RunError: settings that cannot work, or a run without a view.
        """
        self.run, self._config = run, config_of(run)
        grid = grid_before([run])
        stored = _stored(run, grid)
        # Rows enough for the last state from the start on: what works on maps compiles once.
        capacity = self._config.capacity if stored is None else stored.map_state.capacity
        state = empty_map(capacity, self._config.voxel_size, self._config.num_bins)
        self._start = self._reached = Moment(-1, state, grid)
        kept = max(2, memory // self._start.nbytes)
        self.stride = math.ceil(len(run.rows) / kept)
        """Views from one kept state to the next."""
        self._kept: dict[int, Moment] = {}
        self._stored = self._shown = stored

    def at(self, step: int) -> Moment:
        """The state after view `step`.

        Raises:
            IndexError: the run has no such view.
            RunError: a frame is missing, broken, or not the one that was recorded.
        """
        if not 0 <= step < len(self.run.rows):
            raise IndexError(f"the run has views 0 to {len(self.run.rows) - 1}, not {step}")
        moment = self._before(step)
        while moment.step < step:
            moment = self._after(moment)
        self._shown = moment
        return moment

    def follow(self) -> Iterator[Moment]:
        """Every state in order, each when it is asked for; `at` may be called in between.

        Raises:
            RunError: as `at`.
        """
        moment = self._start
        while moment.step < len(self.run.rows) - 1:
            moment = self._after(moment)
            yield moment

    def _before(self, step: int) -> Moment:
        """The latest known state that is not later than `step`."""
        known = [self._start, self._reached, *self._kept.values(), self._shown, self._stored]
        return max((m for m in known if m is not None and m.step <= step), key=lambda m: m.step)

    def _after(self, moment: Moment) -> Moment:
        """The state one view later."""
        config, frame = self._config, self.run.frame(moment.step + 1)
        after = Moment(moment.step + 1, *add_frame(moment.map_state, moment.grid, frame, config))
        if after.step % self.stride == 0:
            self._kept[after.step] = after
        if after.step > self._reached.step:
            self._reached = after
        return after


def _stored(run: Run, grid: OccupancyGrid) -> Moment | None:
    """The last view's state from its checkpoint, so that it is there at once; None: replay."""
    try:
        step, map_state, stored_grid = run.checkpoint()
    except RunError:
        return None
    config = config_of(run)
    is_ours = (
        step == len(run.rows) - 1
        and map_state.num_bins == config.num_bins
        and map_state.key.shape == (2, map_state.capacity)
        and map_state.mean.shape == (3, map_state.capacity)
        and map_state.capacity & (map_state.capacity - 1) == 0
        and float(map_state.voxel_size) == np.float32(config.voxel_size)
        and stored_grid.log_odds.shape == grid.log_odds.shape
    )
    return Moment(step, map_state, stored_grid) if is_ours else None
