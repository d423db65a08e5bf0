"""Works out what the page is to show, part by part, the quick ones first.

The picture of a view and R of the dragged camera come within milliseconds; then the map, if it has
changed; then the splats and the panorama from where the camera is.
"""

import functools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from r3jax.apps.viewer.color_maps import paint, to_bytes
from r3jax.apps.viewer.decisions import Offer, offer_segments
from r3jax.apps.viewer.overlays import path_segments
from r3jax.apps.viewer.page.canvas import Canvas, Color
from r3jax.apps.viewer.page.panel import (
    PLACES,
    Controls,
    DisplaySettings,
    preview_html,
    reason_html,
    view_html,
)
from r3jax.apps.viewer.page.place import PlaceLayer, Show, Sources
from r3jax.apps.viewer.preview import (
    CameraPreview,
    Photographer,
    QuickPreview,
    Surroundings,
    panorama_image,
    preview_from,
    preview_image,
    quick_preview_from,
    quick_preview_image,
)
from r3jax.apps.viewer.story import Moment, Story
from r3jax.exploration.explain_run import Reason
from r3jax.geometry.cameras import Camera
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.views import fitted_size
from r3jax.trace.errors import RunError

PICTURE_SIZE = 192
"""Longer side of rendered splats and true images [px]."""


@dataclass(frozen=True)
class Extras:
    """What may be known beside the run itself."""

    sources: Sources = field(default_factory=Sources)
    """What can be drawn beside the voxels."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What the splats were trained with."""

    photographer: Photographer | None = None
    """Takes true pictures, with `picture_camera`."""

    decisions: Callable[[], Iterator[tuple[int, Offer | None]]] | None = None
    """Decides the whole run again, for its candidates."""

    remark: Callable[[], str] = lambda: ""
    """What the user should know by now, such as why there is no true image."""


@dataclass(frozen=True)
class Query:
    """What the page should show."""

    settings: DisplaySettings

    T_world_camera: np.ndarray
    """Camera-to-world pose of the dragged camera, [4, 4] float64."""


def picture_camera(camera: Camera) -> Camera:
    """A run's camera at the size of the pictures beside the dragged one."""
    return camera.resized(*fitted_size(camera.width, camera.height, PICTURE_SIZE))


class QueryHandler:
    """QueryHandler questions in one thread, and remembers what is on the page."""

    def __init__(
        self,
        canvas: Canvas,
        controls: Controls,
        story: Story,
        config: ScoringConfig,
        extras: Extras,
        ask_again: Callable[[], None],
    ):
        """Works out nothing yet.

        Args:
            canvas: where to draw.
            controls: where to write.
            story: what it is about.
            config: of the scores.
            extras: what else is known.
            ask_again: called when more is known than when the last question was asked.
        """
        self._canvas, self._controls, self._story = canvas, controls, story
        self._config, self._extras, self._ask_again = config, extras, ask_again
        self._place = PlaceLayer(canvas, controls, story, config, extras.sources, extras.remark)
        self._view: tuple[object, ...] | None = None
        self._awaited: tuple[int, str] | None = None
        self._candidates: tuple[int, int] | None = None
        self._offers: dict[int, Offer] = {}
        self._deciding: threading.Thread | None = None
        self._closed = threading.Event()
        self.look: CameraPreview | None = None
        """The one that stands on the page; None while it is worked out."""

    def close(self) -> None:
        """Ends the thread that decides again, if there is one."""
        self._closed.set()
        if self._deciding is not None:
            self._deciding.join()

    def prepare(self) -> bool:
        """Something for later, while nothing is asked."""
        try:
            return self._story.advance()
        except RunError as error:
            self._controls.show_note(str(error))
            return False
        finally:
            if (
                self._awaited is not None
                and self._story.reason(self._awaited[0]) != self._awaited[1]
            ):
                self._awaited = None
                self._ask_again()

    def work(self, question: Query) -> Iterator[Show]:
        """The parts of the answer to a question."""
        settings, pose = question.settings, question.T_world_camera
        step = min(settings.step, len(self._story.rows) - 1)
        reason = self._story.reason(step)
        yield self._show_view(step, reason)
        moment = self._story.moment(step)
        around = self._around(moment)
        glance = quick_preview_from(around, pose)
        yield functools.partial(self._show_glance, glance)
        from_free_space = settings.place == PLACES[0]
        if from_free_space:  # drawn anew for another moment only, and then first
            yield from self._place.draw(settings, pose, moment, reason)
        look = preview_from(around, pose, glance)
        yield functools.partial(self._show_look, look, settings.quantity)
        if not from_free_space:
            yield from self._place.draw(settings, pose, moment, reason)
        yield self._show_candidates(step, settings.shows_candidates)

    def _show_view(self, step: int, reason: Reason | str) -> Show:
        """The picture of a view, what the trace says of it, why it was taken, and its path."""
        rows = self._story.rows
        key = (step, len(rows), reason if isinstance(reason, str) else "")
        self._awaited = (step, reason) if isinstance(reason, str) else None
        before = step if self._controls.shows_all_views else 0
        if self._view == key:
            return functools.partial(self._canvas.show_views, before)
        pose = np.asarray(rows[step].pose, np.float64)
        image = self._story.image(step)
        facts = view_html(rows[step], len(rows)) + reason_html(reason)
        segments, colors = path_segments(rows[: step + 1], len(rows))

        def show() -> None:
            self._controls.show_view(facts, image)
            self._canvas.show_view(pose, image)
            self._canvas.show_views(before)
            self._canvas.show_lines("/path", segments, colors, 0.015)
            self._view = key

        return show

    def _around(self, moment: Moment) -> Surroundings:
        return Surroundings(
            moment.map_state,
            moment.grid,
            self._story.camera,
            self._config,
            picture_camera(self._story.camera),
            self._extras.sources.model,
            self._extras.background,
            self._extras.photographer,
        )

    def _show_glance(self, glance: QuickPreview) -> None:
        self._controls.show_numbers(preview_html(glance, None))
        self._canvas.paint_camera(_color_of(glance))

    def _show_look(self, look: CameraPreview, quantity: str) -> None:
        term = quantity if quantity in look.glance.images else "renderability"
        inside = (
            quick_preview_image(look.glance, term) if look.splats is None else to_bytes(look.splats)
        )
        self._controls.show_numbers(preview_html(look.glance, look))
        self._controls.show_pictures(preview_image(look, term), panorama_image(look))
        self._canvas.paint_camera(_color_of(look.glance))
        self._canvas.fill_camera(inside)
        self._canvas.show_suggestion(look.T_world_camera[:3, 3], look.best_direction)
        self.look = look

    def _show_candidates(self, step: int, is_wanted: bool) -> Show:
        """The candidates of a view, colored by score; has them decided on again if need be."""
        segments, colors = np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
        offer, note = None, ""
        if is_wanted:
            offer = self._story.offer(step) or self._offers.get(step)
            if offer is None:
                self._decide_again()
            else:
                segments, colors = offer_segments(self._story.camera, offer)
                reachable = int(np.isfinite(offer.utilities["path"]).sum())
                note = f"{len(offer.poses)} candidates, {reachable} within reach: yellow is best"
        key = (step, len(segments)) if len(segments) else None

        def show() -> None:
            if self._candidates != key:
                self._canvas.show_lines("/candidates", segments, colors, 0.006)
                self._candidates = key
                if note:
                    self._controls.show_note(note)

        return show

    def _decide_again(self) -> None:
        """Starts the thread that decides the run again, once."""
        if self._extras.decisions is not None and self._deciding is None:
            self._deciding = threading.Thread(target=self._decide, name="decisions", daemon=True)
            self._deciding.start()

    def _decide(self) -> None:
        assert self._extras.decisions is not None
        total = len(self._story.rows)
        try:
            for step, offer in self._extras.decisions():
                if self._closed.is_set():
                    return
                if offer is not None:
                    self._offers[step] = offer
                self._controls.show_note(f"asking the policy again: view {step + 1} of {total}")
                if step == self._controls.settings.step:
                    self._ask_again()
        except (RunError, ValueError) as error:
            self._controls.show_note(f"no candidates: {error}")


def _color_of(glance: QuickPreview) -> Color:
    """The color of R, darker than the map's, so that lines stand out before it."""
    red, green, blue = paint(np.asarray([glance.renderability]))[0].tolist()
    return round(0.7 * red), round(0.7 * green), round(0.7 * blue)
