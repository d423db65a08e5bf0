"""A running exploration on a page: the loop hands over references, another thread does the rest.

The loop never waits for the page, nor for a browser: what it hands over goes into a queue. Nothing
flows back: the run is the one that it would be if nobody watched.
"""

import queue
import threading
from types import TracebackType

import jax.numpy as jnp
import numpy as np
import viser

from r3jax.apps.viewer.decisions import Offer, WatchedPolicy, offer_of
from r3jax.apps.viewer.page.app import App
from r3jax.apps.viewer.page.server import url_of
from r3jax.apps.viewer.story import LiveStory, NewView
from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.policy import Decision, Policy
from r3jax.scoring.config import ScoringConfig
from r3jax.trace.reader import Run
from r3jax.trace.rows import StepRow


def open_live(
    server: viser.ViserServer,
    camera: Camera,
    bounds: np.ndarray,
    config: ExplorationConfig,
    *,
    title: str,
    subtitle: str,
    earlier: Run | None = None,
) -> "LiveFeed":
    """A page for an exploration that is about to begin.

    Args:
        server: with an empty page; it stays the caller's.
        camera: of every view.
        bounds: of the scene, [2, 3] [m].
        config: of the loop.
        title: what it is.
        subtitle: more about it.
        earlier: what was recorded of the run, if it is gone on with.
    """
    story = LiveStory(camera, np.asarray(bounds, np.float64), config, earlier)
    max_range = jnp.asarray(config.max_range, dtype=jnp.float32)
    scoring = ScoringConfig(max_range=max_range)
    app = App(server, story, scoring, bounds, title=title, subtitle=subtitle)
    return LiveFeed(server, app, story)


class LiveFeed:
    """Takes what a loop hands over, view by view. A context manager: leaving it ends the thread."""

    def __init__(self, server: viser.ViserServer, app: App, story: LiveStory):
        """Starts the thread that brings views to the page.

        Args:
            server: of the page; it stays the caller's.
            app: of the page; closed when the feed is left.
            story: the app's.
        """
        self.url = url_of(server)
        """Where the page is."""
        self.app, self._story = app, story
        self._frame: Frame | None = None
        self._map_state: MapState | None = None
        self._grid: OccupancyGrid | None = None
        self._offer: Offer | None = None
        self._queue: queue.SimpleQueue[NewView | threading.Event | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def watch(self, policy: Policy) -> Policy:
        """The policy to explore with: decides as `policy` does, and this feed sees what it sees."""
        return WatchedPolicy(policy, self._on_decision, self._on_frame)

    def on_step(self, row: StepRow) -> None:
        """A view is done: it goes into the queue."""
        if self._frame is None or self._map_state is None:
            return
        self._queue.put(NewView(row, self._frame, self._map_state, self._grid, self._offer))
        self._offer = None

    def settle(self, timeout: float) -> bool:
        """Returns when every view so far is on the page; False if that takes longer [s]."""
        is_empty = threading.Event()
        self._queue.put(is_empty)
        return is_empty.wait(timeout) and self.app.worker.wait(timeout)

    def _on_decision(self, decision: Decision, grid: OccupancyGrid) -> None:
        self._grid, self._offer = grid, offer_of(decision)

    def _on_frame(self, map_state: MapState, frame: Frame) -> None:
        self._map_state, self._frame = map_state, frame

    def _run(self) -> None:
        while (view := self._queue.get()) is not None:
            if isinstance(view, threading.Event):
                view.set()
                continue
            self._story.add(view)
            self.app.grow()

    def __enter__(self) -> "LiveFeed":
        """The feed itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Takes in what is in the queue, then ends all threads."""
        self._queue.put(None)
        self._thread.join()
        self.app.close()
