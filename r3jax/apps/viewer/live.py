"""A running exploration on a page: the loop hands over references, another thread does the rest.

The loop never waits for the page, nor for a browser: what it hands over goes into a queue. Nothing
flows back: the run is the one that it would be without a viewer.
"""

import queue
import threading
from types import TracebackType

import jax.numpy as jnp
import numpy as np
import viser

from r3jax.apps.viewer.app import App
from r3jax.apps.viewer.server import url_of
from r3jax.apps.viewer.story import LiveStory
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.taken_views import TakenView
from r3jax.geometry.cameras import Camera
from r3jax.planning.planner import Planner
from r3jax.runs.reader import Run
from r3jax.scoring.config import ScoringConfig

_Item = tuple[TakenView, Planner] | threading.Event | None
"""A view and the planner that has seen it; an event to be set on the way; None: the end."""


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
    """Opens a page for an exploration that is about to begin.

    Args:
        server: with an empty page; it stays the caller's.
        camera: of every view.
        bounds: of the scene, [2, 3] [m].
        config: of the loop.
        title: what it is.
        subtitle: more about it.
        earlier: what was recorded of the run, if it is gone on with.
    """
    story = LiveStory(camera, earlier)
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
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def on_view(self, view: TakenView, planner: Planner) -> None:
        """Puts a view that `explore` reports into the queue."""
        self._queue.put((view, planner))

    def settle(self, timeout: float) -> bool:
        """Waits until every view so far is on the page; returns False after a timeout [s]."""
        is_empty = threading.Event()
        self._queue.put(is_empty)
        return is_empty.wait(timeout) and self.app.worker.wait(timeout)

    def _run(self) -> None:
        while (view := self._queue.get()) is not None:
            if isinstance(view, threading.Event):
                view.set()
                continue
            self._story.add(*view)
            self.app.grow()

    def __enter__(self) -> "LiveFeed":
        """Returns the feed itself."""
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
