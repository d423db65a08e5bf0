"""The logic of the viewer: settings and drags become queries, whose results are shown on the page.

One thread computes the newest query, and results of older ones are never shown.
"""

import functools
import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import numpy as np
import viser
from PIL import Image

from r3jax.apps.viewer.blocks import cut_height
from r3jax.apps.viewer.canvas import Canvas
from r3jax.apps.viewer.facts import PLACES, menu_of
from r3jax.apps.viewer.panel import PANEL_WIDTH, Controls, Menu
from r3jax.apps.viewer.pictures import CameraPreview
from r3jax.apps.viewer.queries import Extras, Query, QueryHandler, Show
from r3jax.apps.viewer.story import Story
from r3jax.runs.header import RunError
from r3jax.scoring.config import ScoringConfig

Question = TypeVar("Question")
Answer = TypeVar("Answer")


class LatestWorker(Generic[Question, Answer]):
    """Computes queries one at a time, in its own thread; the latest query wins.

    A result may come in parts, the quick ones first. A query that is replaced while it waits is
    never computed; if it is replaced during its computation, no further part is computed or shown.
    So everything shown belongs to the latest query.
    """

    def __init__(
        self,
        answer: Callable[[Question], Iterator[Answer]],
        show: Callable[[Question, Answer], None],
        fail: Callable[[Question, Exception], None],
        *,
        quiet: float = 0.05,
        idle: Callable[[], bool] | None = None,
    ):
        """Starts the thread.

        Args:
            answer: computes the parts of a result; called without a lock.
            show: called with each part of the newest query's result. A new query waits until it
                returns, so that it should be quick; it may submit queries itself.
            fail: called in the same way with an error raised by `answer`.
            quiet: a query starts when no other has followed for this time [s].
            idle: called repeatedly without a query, until it returns False.
        """
        self._answer, self._show, self._fail = answer, show, fail
        self._quiet, self._idle = quiet, idle
        self._changed = threading.Condition(threading.RLock())
        self._question: Question | None = None
        self._asked = self._done = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def ask(self, question: Question, mark: Callable[[], None] | None = None) -> None:
        """Replaces the query that is waiting or being computed, if any.

        Args:
            question: the new query.
            mark: called immediately; from then on no earlier result is shown, and nothing of the
                new one has been shown yet.
        """
        with self._changed:
            if mark is not None:
                mark()
            self._question = question
            self._asked += 1
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Waits until the newest query is done; returns False after a timeout [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._done == self._asked, timeout)

    def close(self) -> None:
        """Ends the thread, after its current computation."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (taken := self._take()) is not None:
            number, question = taken
            try:
                for part in self._answer(question):
                    if not self._tell(number, functools.partial(self._show, question, part)):
                        break
            except Exception as error:  # shown, whatever it is; the thread must continue
                self._tell(number, functools.partial(self._fail, question, error))
            with self._changed:
                if number == self._asked:
                    self._done = number
                self._changed.notify_all()

    def _take(self) -> tuple[int, Question] | None:
        """Waits for a query, and until none has followed for a while; None: closed."""
        while True:
            with self._changed:
                if self._closed:
                    return None
                if self._asked != self._done:
                    return self._settled()
                if self._idle is None:
                    self._changed.wait()
                    continue
            if not self._idle():
                self._idle = None

    def _settled(self) -> tuple[int, Question] | None:
        """Waits until no query has followed the newest for a while; the lock is held.

        Returns None if there is no query, or the worker is closed.
        """
        newest = -1
        while newest != self._asked and not self._closed:
            newest = self._asked
            self._changed.wait_for(functools.partial(self._is_past, newest), self._quiet)
        question = self._question
        return None if self._closed or question is None else (newest, question)

    def _is_past(self, number: int) -> bool:
        return self._closed or self._asked != number

    def _tell(self, number: int, tell: Callable[[], None]) -> bool:
        """Reports the result; returns False if there is a newer query."""
        with self._changed:
            is_newest = number == self._asked and not self._closed
            if is_newest:
                tell()
            return is_newest


_THUMBNAIL = 64
"""Width of the pictures in the frusta along the path [px]."""

_QUIET = 0.03
"""A drag is computed after a pause of this length [s]; browsers report it every 50 ms."""


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
        """Fills the page and starts the worker.

        Args:
            server: with an empty page; owned by the caller.
            story: the story; a live one may have no view yet.
            config: of the scores.
            bounds: of the scene, [2, 3] [m].
            title: of the page.

            subtitle: below the title.

            extras: further data to show.
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
        if story.is_live:  # for a recorded run they take seconds, and come later
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
        """Numbers for the dragged camera; None while they are computed."""
        return self._answers.look

    def close(self) -> None:
        """Ends the background threads."""
        self._answers.close()
        self.worker.close()

    def ask(self) -> None:
        """Updates the page to its settings, unless it shows them already or is about to."""
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
        """Updates the page for a new view of the story."""
        num_views = len(self.story.rows)
        self._add_views()
        if self._asked is None:
            self.canvas.place_camera(np.asarray(self.story.rows[-1].pose, np.float64))
        step = num_views - 1 if self.controls.is_following else self.controls.settings.step
        self.controls.set_step(step, num_views)
        with self._lock:
            self._asked = None  # the same query now has another result
        self.ask()

    def _ask_again(self) -> None:
        """Repeats the query on the larger map; what is shown stays valid."""
        with self._lock:
            self._asked = Query(self.controls.settings, self.canvas.pose)
            self.worker.ask(self._asked)

    def _mark_stale(self, question: Query, *, camera: bool, view: bool, scene: bool) -> None:
        """Marks each part of the page as belonging to another query."""
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
        """Reports an error: the requested view will not appear."""
        self.controls.show_ready()
        self.controls.show_note(str(error) or type(error).__name__)

    def _heights(self, bounds: np.ndarray) -> tuple[float, float, float]:
        """Returns the lowest, highest and initial height of the cut [m]."""
        low, high = (float(z) for z in np.asarray(bounds)[:, 2])
        corners = np.array([[0.0, 0.0, high]])
        rows = self.story.rows
        first = cut_height(rows, corners) if rows else low + 0.6 * (high - low)
        return round(low, 2), round(high + 0.1, 2), round(min(max(first, low), high), 2)

    def _add_views(self) -> None:
        while self._num_added < len(self.story.rows):
            self._add_view()

    def _prepare(self) -> bool:
        """Prepares something for later while the page is idle, first the views along the path.

        Returns False if there is nothing left to prepare.
        """
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
            image = Image.fromarray(self.story.image(step))
        except RunError as error:
            self.controls.show_note(str(error))
            return
        thumbnail = np.asarray(image.resize((_THUMBNAIL, height), Image.Resampling.BOX))
        pose, go_to = np.asarray(row.pose, np.float64), functools.partial(self._go_to, step)
        self.canvas.add_view(step, pose, thumbnail, go_to, small=row.captured)

    def _go_to(self, step: int) -> None:
        """Selects a view whose frustum was clicked."""
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
    """Returns True if the map's colors depend on the position of the dragged camera."""
    settings = question.settings
    return settings.layer.has_score and settings.place != PLACES[0]
