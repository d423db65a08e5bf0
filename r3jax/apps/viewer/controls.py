"""The panel of the page: what the user can set, and the numbers and pictures beside it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from r3jax.apps.viewer.panel import note_html, pending_html, stale_html

PLACES = ("free space", "the dragged camera")
"""From where the map's colors are seen."""

_BLANK = np.full((4, 4, 3), 245, np.uint8)
_COMPUTING = "computing …"


@dataclass(frozen=True)
class Wishes:
    """What the user has set."""

    step: int
    """The view whose moment is shown."""

    quantity: str
    """What the map is colored by."""

    place: str
    """One of `PLACES`."""

    surface: str
    """What is drawn of the place: voxels, or what else there is."""

    cut: float
    """Nothing is drawn above this height [m]."""

    shows_candidates: bool


@dataclass(frozen=True)
class Menu:
    """What there is to choose from; the first of everything is set."""

    num_views: int
    quantities: tuple[str, ...]
    surfaces: tuple[str, ...]

    heights: tuple[float, float, float]
    """Least, greatest and first height of the cut [m]."""

    is_live: bool
    """Whether views are being added: the newest one is followed then."""


class Controls:
    """The panel. Methods may be called from any thread."""

    def __init__(self, server: viser.ViserServer, head: str, menu: Menu):
        """Lays it out.

        Args:
            server: with nothing on its page.
            head: HTML at the top.
            menu: what there is to choose from.
        """
        gui, last = server.gui, max(menu.num_views - 1, 0)
        self._server, self._is_pending = server, True
        gui.configure_theme(
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(15, 118, 110),
        )
        gui.add_html(head)
        self._note = gui.add_html(note_html("opening the run …"))
        self._step = gui.add_slider("view", 0, max(last, 1), 1, last)
        self._follow = gui.add_checkbox(
            "follow the newest view", menu.is_live, visible=menu.is_live
        )
        with gui.add_folder("The dragged camera"):
            self._numbers = gui.add_html(pending_html())
            self._picture = gui.add_image(_BLANK, label=_COMPUTING)
            self._panorama = gui.add_image(_BLANK, label=_COMPUTING)
            self._turn = gui.add_button("look along the suggested direction")
            self._return = gui.add_button("go to the view on the slider")
        with gui.add_folder("The map"):
            self._quantity = gui.add_dropdown("color by", menu.quantities)
            self._place = gui.add_dropdown("as seen from", PLACES)
            self._surface = gui.add_dropdown("draw", menu.surfaces)
            low, high, first = menu.heights
            self._cut = gui.add_slider("cut off above [m]", low, high, 0.05, first)
        with gui.add_folder("The view"):
            self._facts = gui.add_html("")
            self._image = gui.add_image(_BLANK)
            self._candidates = gui.add_checkbox("draw its candidates", False)
            self._frusta = gui.add_checkbox("draw all views before it", True)

    def listen(
        self,
        on_wish: Callable[[], None],
        on_turn: Callable[[], None],
        on_return: Callable[[], None],
    ) -> None:
        """Tells from now on what the user does; handlers run in the server's thread.

        Args:
            on_wish: something was set.
            on_turn: the camera is to look along the suggested direction.
            on_return: the camera is to go where the view on the slider was taken.
        """

        # Coroutines run one after the other; threads of a pool would mix up their order.
        async def wish(event: Any) -> None:
            del event
            on_wish()

        async def turn(event: Any) -> None:
            del event
            on_turn()

        async def go_back(event: Any) -> None:
            del event
            on_return()

        self._step.on_update(wish)
        self._cut.on_update(wish)
        self._quantity.on_update(wish)
        self._place.on_update(wish)
        self._surface.on_update(wish)
        self._candidates.on_update(wish)
        self._frusta.on_update(wish)
        self._turn.on_click(turn)
        self._return.on_click(go_back)

    @property
    def wishes(self) -> Wishes:
        """What is set."""
        return Wishes(
            step=int(self._step.value),
            quantity=self._quantity.value,
            place=self._place.value,
            surface=self._surface.value,
            cut=float(self._cut.value),
            shows_candidates=self._candidates.value,
        )

    @property
    def shows_all_views(self) -> bool:
        """Whether the views before the one on the slider are drawn."""
        return self._frusta.value

    @property
    def is_following(self) -> bool:
        """Whether the newest view is to be shown."""
        return self._follow.value

    def set_step(self, step: int, num_views: int) -> None:
        """Moves the slider, and makes room on it."""
        self._step.max = max(num_views - 1, 1)
        self._step.value = step

    def show_view(self, facts: str, image: np.ndarray) -> None:
        """What the trace says of a view as HTML, and its picture [H, W, 3] uint8."""
        with self._server.atomic():
            self._facts.content, self._image.image = facts, image

    def show_pending(self) -> None:
        """What stands beside the dragged camera belongs to another pose: marks it as such."""
        if not self._is_pending:
            self._is_pending = True
            self._numbers.content = stale_html(self._numbers.content)
            self._picture.label = self._panorama.label = _COMPUTING

    def show_numbers(self, content: str) -> None:
        """The dragged camera's numbers as HTML."""
        self._numbers.content = content

    def show_pictures(self, picture: np.ndarray, panorama: np.ndarray) -> None:
        """The dragged camera's pictures, [H, W, 3] uint8 each: nothing is pending any more."""
        with self._server.atomic():
            self._picture.image, self._panorama.image = picture, panorama
            self._picture.label = "this view"
            self._panorama.label = "worth of every direction (ring: suggested)"
        self._is_pending = False

    def show_note(self, text: str) -> None:
        """A line at the top."""
        self._note.content = note_html(text)
