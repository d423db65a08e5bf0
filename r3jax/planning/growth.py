"""Compiles for the next size of a map before it is needed.

A table that grows has another shape, and everything is recompiled for it: many seconds in which
a robot stands still. While there is room yet, the programs of `observe` and `decide` are compiled
in a thread, by running both on a copy of the map in a larger table; the copy is thrown away.
"""

import threading
from dataclasses import replace

import jax

from r3jax.frame import Frame
from r3jax.mapping.join import grow
from r3jax.planning.planner import Planner, decide, take_in

_FROM = 0.1
"""Share of the rows in use from which on the next size is prepared; at 0.7 the table grows. Early:
half a minute of compiling beside the mapping is soon over, and a small room never comes to it."""


class GrowthAhead:
    """Prepares each size of a map once."""

    def __init__(self) -> None:
        """Has prepared nothing."""
        self._prepared = 0
        self._thread: threading.Thread | None = None

    def look(self, planner: Planner, frame: Frame) -> None:
        """Begins to prepare the next size if the map has come that far. Returns at once.

        Args:
            planner: after a frame.
            frame: any frame of the camera, such as the latest.
        """
        state = planner.map_state
        capacity = state.capacity
        is_early = int(state.num_occupied) <= _FROM * capacity
        if is_early or self._prepared > capacity or not planner.config.allow_growth:
            return
        self._prepared = 2 * capacity
        task = (planner, frame, 2 * capacity)
        self._thread = threading.Thread(target=_compile, args=task, name="growth", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Waits until all that was begun is prepared."""
        if self._thread is not None:
            self._thread.join()


def _compile(planner: Planner, frame: Frame, capacity: int) -> None:
    """Observes and decides once with a larger table."""
    larger = replace(planner, map_state=grow(planner.map_state, capacity))
    larger = take_in(larger, frame)
    decide(larger, frame.T_world_camera, jax.random.key(0))
