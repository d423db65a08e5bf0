"""Works out what the page is to show, part by part, the quick ones first.

The picture of a view and R of the dragged camera come within milliseconds; then the map, if it has
changed; then the splats and the panorama from where the camera is.
"""

import functools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from r3jax.apps.viewer.colors import paint, to_bytes
from r3jax.apps.viewer.controls import PLACES, Controls, Wishes
from r3jax.apps.viewer.decisions import Offer, offer_segments
from r3jax.apps.viewer.look import Glance, Look, Photographer, Surroundings, glance_from, look_from
from r3jax.apps.viewer.panel import glance_html, reason_html, view_html
from r3jax.apps.viewer.pictures import glance_image, look_image, panorama_image
from r3jax.apps.viewer.shapes import path_segments
from r3jax.apps.viewer.stage import Color, Stage
from r3jax.apps.viewer.story import Story
from r3jax.apps.viewer.surface import Show, Sources, Surface
from r3jax.apps.viewer.timeline import Moment
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
class Question:
    """What the page should show."""

    wishes: Wishes

    T_world_camera: np.ndarray
    """Of the dragged camera, [4, 4] float64."""


def picture_camera(camera: Camera) -> Camera:
    """A run's camera at the size of the pictures beside the dragged one."""
    return camera.resized(*fitted_size(camera.width, camera.height, PICTURE_SIZE))


class Answers:
    """Answers questions in one thread, and remembers what is on the page."""

    def __init__(
        self,
        stage: Stage,
        controls: Controls,
        story: Story,
        config: ScoringConfig,
        extras: Extras,
        ask_again: Callable[[], None],
    ):
        """Works out nothing yet.

        Args:
            stage: where to draw.
            controls: where to write.
            story: what it is about.
            config: of the scores.
            extras: what else is known.
            ask_again: called when more is known than when the last question was asked.
        """
        self._stage, self._controls, self._story = stage, controls, story
        self._config, self._extras, self._ask_again = config, extras, ask_again
        self._surface = Surface(stage, controls, story, config, extras.sources, extras.remark)
        self._view: tuple[object, ...] | None = None
        self._awaited: tuple[int, str] | None = None
        self._candidates: tuple[int, int] | None = None
        self._offers: dict[int, Offer] = {}
        self._deciding: threading.Thread | None = None
        self._closed = threading.Event()
        self.look: Look | None = None
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

    def work(self, question: Question) -> Iterator[Show]:
        """The parts of the answer to a question."""
        wishes, pose = question.wishes, question.T_world_camera
        step = min(wishes.step, len(self._story.rows) - 1)
        reason = self._story.reason(step)
        yield self._show_view(step, reason)
        moment = self._story.moment(step)
        around = self._around(moment)
        glance = glance_from(around, pose)
        yield functools.partial(self._show_glance, glance)
        from_free_space = wishes.place == PLACES[0]
        if from_free_space:  # drawn anew for another moment only, and then first
            yield from self._surface.draw(wishes, pose, moment, reason)
        look = look_from(around, pose, glance)
        yield functools.partial(self._show_look, look, wishes.quantity)
        if not from_free_space:
            yield from self._surface.draw(wishes, pose, moment, reason)
        yield self._show_candidates(step, wishes.shows_candidates)

    def _show_view(self, step: int, reason: Reason | str) -> Show:
        """The picture of a view, what the trace says of it, why it was taken, and the way to it."""
        rows = self._story.rows
        key = (step, len(rows), reason if isinstance(reason, str) else "")
        self._awaited = (step, reason) if isinstance(reason, str) else None
        before = step if self._controls.shows_all_views else 0
        if self._view == key:
            return functools.partial(self._stage.show_views, before)
        pose = np.asarray(rows[step].pose, np.float64)
        image = self._story.image(step)
        facts = view_html(rows[step], len(rows)) + reason_html(reason)
        segments, colors = path_segments(rows[: step + 1], len(rows))

        def show() -> None:
            self._controls.show_view(facts, image)
            self._stage.show_view(pose, image)
            self._stage.show_views(before)
            self._stage.show_lines("/path", segments, colors, 0.015)
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

    def _show_glance(self, glance: Glance) -> None:
        self._controls.show_numbers(glance_html(glance, None))
        self._stage.paint_camera(_color_of(glance))

    def _show_look(self, look: Look, quantity: str) -> None:
        term = quantity if quantity in look.glance.images else "renderability"
        inside = glance_image(look.glance, term) if look.splats is None else to_bytes(look.splats)
        self._controls.show_numbers(glance_html(look.glance, look))
        self._controls.show_pictures(look_image(look, term), panorama_image(look))
        self._stage.paint_camera(_color_of(look.glance))
        self._stage.fill_camera(inside)
        self._stage.show_suggestion(look.T_world_camera[:3, 3], look.best_direction)
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
                self._stage.show_lines("/candidates", segments, colors, 0.006)
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
                if step == self._controls.wishes.step:
                    self._ask_again()
        except (RunError, ValueError) as error:
            self._controls.show_note(f"no candidates: {error}")


def _color_of(glance: Glance) -> Color:
    """The color of R, darker than the map's, so that lines stand out before it."""
    red, green, blue = paint(np.asarray([glance.renderability]))[0].tolist()
    return round(0.7 * red), round(0.7 * green), round(0.7 * blue)
