"""What the viewer does: the user's settings and drags become questions, answers go on the page."""

import functools
import threading
from collections.abc import Iterable

import numpy as np
import viser

from r3jax.apps.viewer.blocks import CAUSE, QUANTITIES, cut_height
from r3jax.apps.viewer.page.canvas import Canvas
from r3jax.apps.viewer.page.panel import Controls, Menu, title_html
from r3jax.apps.viewer.page.place import Show
from r3jax.apps.viewer.page.queries import Extras, Query, QueryHandler
from r3jax.apps.viewer.page.worker import LatestWorker
from r3jax.apps.viewer.preview import CameraPreview, fitted
from r3jax.apps.viewer.story import Story
from r3jax.scoring.config import ScoringConfig

_THUMBNAIL = 64
"""Width of the pictures in the frusta along the path [px]."""

_QUIET = 0.03
"""A drag is answered when it has paused for so long [s]; browsers tell of it every 50 ms."""


class App:
    """One page about one story."""

    def __init__(
        self,
        server: viser.ViserServer,
        story: Story,
        config: ScoringConfig,
        bounds: np.ndarray,
        *,
        title: str,
        subtitle: str,
        extras: Extras | None = None,
    ):
        """Fills the page and starts to answer.

        Args:
            server: with an empty page; it stays the caller's.
            story: what to show; one that is live may have no view yet.
            config: of the scores.
            bounds: of the scene, [2, 3] [m].
            title: what it is.
            subtitle: more about it.
            extras: what else is known.
        """
        extras = extras or Extras()
        self.story = story
        self._lock = threading.Lock()
        self._asked: Query | None = None
        # A running exploration needs the processor: what costs nothing comes first.
        quantities = ("color", *QUANTITIES[:-1]) if story.is_live else (*QUANTITIES, CAUSE)
        surfaces, heights = extras.sources.names, self._heights(bounds)
        menu = Menu(len(story.rows), quantities, surfaces, heights, story.is_live)
        self.controls = Controls(server, title_html(title, subtitle), menu)
        self.canvas = Canvas(server, story.camera)
        self._answers = QueryHandler(
            self.canvas, self.controls, story, config, extras, ask_again=self._ask_again
        )
        self.worker: LatestWorker[Query, Show] = LatestWorker(
            self._answers.work,
            lambda question, show: show(),
            lambda question, error: self.controls.show_note(str(error) or type(error).__name__),
            quiet=_QUIET,
            idle=self._answers.prepare,
        )
        self._place_eye(bounds)
        self._add_views(range(len(story.rows)))
        if story.rows:
            self.canvas.place_camera(np.asarray(story.rows[-1].pose, np.float64))
        self.controls.listen(self.ask, self._turn, self._return)
        self.canvas.on_drag(self.ask)
        if not story.is_live:  # which has no map before its first view
            self.ask()

    @property
    def look(self) -> CameraPreview | None:
        """What stands beside the dragged camera; None while it is worked out."""
        return self._answers.look

    def close(self) -> None:
        """Ends what works in the background."""
        self._answers.close()
        self.worker.close()

    def ask(self) -> None:
        """Has the page show what it is set to, unless it does or is about to."""
        if not self.story.rows:
            return
        with self._lock:
            question, before = Query(self.controls.settings, self.canvas.pose), self._asked
            self._asked = question
            is_same_pose = before is not None and np.array_equal(
                before.T_world_camera, question.T_world_camera
            )
            if before is not None and is_same_pose and before.settings == question.settings:
                return
            is_same_step = before is not None and before.settings.step == question.settings.step
            stays_right = is_same_pose and is_same_step
            self.worker.ask(question, None if stays_right else self._mark_stale)

    def grow(self) -> None:
        """The story has a new view."""
        num_views = len(self.story.rows)
        self._add_views([num_views - 1])
        if self._asked is None:
            self.canvas.place_camera(np.asarray(self.story.rows[-1].pose, np.float64))
        step = num_views - 1 if self.controls.is_following else self.controls.settings.step
        self.controls.set_step(step, num_views)
        with self._lock:
            self._asked = None  # the same question has another answer now
        self.ask()

    def _ask_again(self) -> None:
        """More is known of what is shown; what is shown stays right."""
        with self._lock:
            self._asked = Query(self.controls.settings, self.canvas.pose)
            self.worker.ask(self._asked)

    def _mark_stale(self) -> None:
        """The numbers beside the dragged camera belong to another pose or moment."""
        self.controls.show_pending()
        self.canvas.hide_suggestion()
        self._answers.look = None

    def _heights(self, bounds: np.ndarray) -> tuple[float, float, float]:
        """Least, greatest and first height of the cut [m]."""
        low, high = (float(z) for z in np.asarray(bounds)[:, 2])
        corners = np.array([[0.0, 0.0, high]])
        rows = self.story.rows
        first = cut_height(rows, corners) if rows else low + 0.6 * (high - low)
        return round(low, 2), round(high + 0.1, 2), round(min(max(first, low), high), 2)

    def _add_views(self, steps: Iterable[int]) -> None:
        camera = self.story.camera
        height = max(1, round(_THUMBNAIL * camera.height / camera.width))
        for step in steps:
            thumbnail = fitted(self.story.image(step), _THUMBNAIL, height)
            row = self.story.rows[step]
            self.canvas.add_view(
                step,
                np.asarray(row.pose, np.float64),
                thumbnail,
                functools.partial(self._go_to, step),
                small=row.captured,
            )

    def _place_eye(self, bounds: np.ndarray) -> None:
        """Outside and above, looking at the middle of the scene."""
        low, high = np.asarray(bounds, dtype=np.float64)
        reach = max(4.0, 0.85 * float(np.linalg.norm((high - low)[:2])))
        middle = 0.5 * (low + high)
        self.canvas.place_eye(middle + reach * np.array([-0.2, -0.75, 0.8]), middle)

    def _go_to(self, step: int) -> None:
        """The frustum of a view was clicked."""
        self.controls.set_step(step, len(self.story.rows))

    def _turn(self) -> None:
        look = self._answers.look
        if look is not None and np.array_equal(look.T_world_camera, self.canvas.pose):
            self.canvas.place_camera(np.asarray(look.T_suggested, np.float64))
            self.ask()

    def _return(self) -> None:
        step = min(self.controls.settings.step, len(self.story.rows) - 1)
        self.canvas.place_camera(np.asarray(self.story.rows[step].pose, np.float64))
        self.ask()
