"""What the viewer does: the user's settings and drags become questions, answers go on the page."""

import functools
import threading

import numpy as np
import viser

from r3jax.apps.viewer.blocks import cut_height
from r3jax.apps.viewer.page.canvas import Canvas
from r3jax.apps.viewer.page.layers import PLACES, menu_of
from r3jax.apps.viewer.page.panel import PANEL_WIDTH, Controls, Menu
from r3jax.apps.viewer.page.place import Show
from r3jax.apps.viewer.page.queries import Extras, Query, QueryHandler
from r3jax.apps.viewer.page.worker import LatestWorker
from r3jax.apps.viewer.preview import CameraPreview, fitted
from r3jax.apps.viewer.story import Story
from r3jax.scoring.config import ScoringConfig
from r3jax.trace.errors import RunError

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
        self._num_added = 0
        layers = menu_of(extras.sources.surfaces, with_causes=not story.is_live)
        heights = self._heights(bounds)
        has_truth = extras.photographer is not None
        menu = Menu(title, len(story.rows), layers, heights, story.is_live, has_truth)
        self.controls = Controls(server, subtitle, menu)
        self.canvas = Canvas(server, story.camera)
        self._answers = QueryHandler(
            self.canvas, self.controls, story, config, bounds, extras, self._ask_again
        )
        self.worker: LatestWorker[Query, Show] = LatestWorker(
            self._answers.work,
            lambda question, show: show(),
            lambda question, error: self._tell(error),
            quiet=_QUIET,
            idle=self._prepare,
        )
        low, high = np.asarray(bounds, np.float64)
        self.canvas.place_eye(low, np.minimum(high, [*high[:2], heights[2]]), PANEL_WIDTH)
        if story.is_live:  # those of a recorded run take seconds, and come later
            self._add_views()
        if story.rows:
            self.canvas.place_camera(np.asarray(story.rows[-1].pose, np.float64))
        self.controls.listen(self.ask, self._turn, self._return)
        self.canvas.on_drag(self.ask)
        self.controls.show_busy("Waiting for the first view", 0.0)
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
            is_new_view = before is None or before.settings.step != question.settings.step
            is_new_scene = before is None or before.settings.scene != question.settings.scene
            if _follows_camera(question) and not is_same_pose:
                is_new_scene = True
            mark = functools.partial(
                self._mark_stale,
                question,
                camera=is_new_view or not is_same_pose,
                view=is_new_view,
                scene=is_new_scene,
            )
            self.worker.ask(question, mark)

    def grow(self) -> None:
        """The story has a new view."""
        num_views = len(self.story.rows)
        self._add_views()
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

    def _mark_stale(self, question: Query, *, camera: bool, view: bool, scene: bool) -> None:
        """What is on the page belongs to another question: says so, part by part."""
        step, layer = question.settings.step, question.settings.layer
        if camera:
            self.controls.mark_camera_stale()
            self.canvas.mark_camera_stale()
            self._answers.look = None
        if view:
            self.controls.mark_view_stale(step)
            self._answers.forget_view()
        if scene:
            what = f"View {step + 1}" if view else layer.title
            self.controls.show_busy(f"{what}: being computed", 0.0)

    def _tell(self, error: Exception) -> None:
        """Something went wrong: what was asked for will not come."""
        self.controls.show_ready()
        self.controls.show_note(str(error) or type(error).__name__)

    def _heights(self, bounds: np.ndarray) -> tuple[float, float, float]:
        """Least, greatest and first height of the cut [m]."""
        low, high = (float(z) for z in np.asarray(bounds)[:, 2])
        corners = np.array([[0.0, 0.0, high]])
        rows = self.story.rows
        first = cut_height(rows, corners) if rows else low + 0.6 * (high - low)
        return round(low, 2), round(high + 0.1, 2), round(min(max(first, low), high), 2)

    def _add_views(self) -> None:
        while self._num_added < len(self.story.rows):
            self._add_view()

    def _prepare(self) -> bool:
        """Something for later, while nothing is asked: first the views along the path."""
        if not self.story.is_live and self._num_added < len(self.story.rows):
            self._add_view()
            return True
        return self._answers.prepare()

    def _add_view(self) -> None:
        """Adds the next view along the path, with its picture."""
        camera, step = self.story.camera, self._num_added
        self._num_added += 1
        row = self.story.rows[step]
        height = max(1, round(_THUMBNAIL * camera.height / camera.width))
        try:
            thumbnail = fitted(self.story.image(step), _THUMBNAIL, height)
        except RunError as error:
            self.controls.show_note(str(error))
            return
        pose, go_to = np.asarray(row.pose, np.float64), functools.partial(self._go_to, step)
        self.canvas.add_view(step, pose, thumbnail, go_to, small=row.captured)

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


def _follows_camera(question: Query) -> bool:
    """Whether the map's colors depend on where the dragged camera is."""
    settings = question.settings
    return settings.layer.has_score and settings.place != PLACES[0]
