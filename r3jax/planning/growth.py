"""Compiles for the next size of a map before it is needed.

A grown table has another shape, for which everything is recompiled: many seconds in which a robot
stands still. Before that, a thread compiles `observe` and `decide` by running both on a copy of the
map in a larger table, which is then discarded.
"""

import threading
from dataclasses import replace

import jax

from r3jax.frame import Frame
from r3jax.mapping.join import grow
from r3jax.planning.planner import Planner, decide, take_in

_FROM = 0.1
"""Share of used rows at which the next size is prepared; the table grows at 0.7. Early enough for
half a minute of compiling beside the mapping, but small rooms never reach it."""


class GrowthAhead:
    """Prepares each size of a map once."""

    def __init__(self) -> None:
        """Starts with nothing prepared."""
        self._prepared = 0
        self._thread: threading.Thread | None = None

    def look(self, planner: Planner, frame: Frame) -> None:
        """Starts to prepare the next size if the map is full enough. Returns immediately.

        Args:
            planner: after a frame.
            frame: any frame of the camera, such as the latest.
        """
        state = planner.map_state
        capacity = state.capacity
        is_early = int(state.num_occupied) <= _FROM * capacity
        is_fixed = planner.far is not None or not planner.config.allow_growth
        if is_early or self._prepared > capacity or is_fixed:
            return
        self._prepared = 2 * capacity
        task = (planner, frame, 2 * capacity)
        # No daemon: a process that ends while XLA compiles in one is aborted.
        self._thread = threading.Thread(target=_compile, args=task, name="growth")
        self._thread.start()

    def wait(self) -> None:
        """Waits for all preparations to end."""
        if self._thread is not None:
            self._thread.join()


def _compile(planner: Planner, frame: Frame, capacity: int) -> None:
    """Observes and decides once with a larger table."""
    larger = replace(planner, map_state=grow(planner.map_state, capacity))
    larger = take_in(larger, frame)
    decide(larger, frame.T_world_camera, jax.random.key(0))
