"""The panel of the page: what the user can set, what stands beside it, and the legend.

The words are HTML of `facts`. What is shown belongs to one view and one pose; until that of the
newest question is there, what stands there still is faint and says so.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import viser

from r3jax.apps.viewer.facts import (
    PLACES,
    Layer,
    busy_html,
    head_html,
    note_html,
    pending_html,
    stale_html,
)

_SHOW_HINT = (
    "What is drawn. Splats, measured points and the scene mesh belong to the whole run; everything "
    "else to the view on the slider."
)
_SEEN_FROM_HINT = (
    "Renderability depends on where the camera is: the mean over places in free space, or from "
    "the camera that you drag."
)
_CUT_HINT = "Nothing above this height is drawn, so that you look into the rooms from above."
_VIEW_HINT = "Goes through the run view by view. You can also click a camera on the path."
_FOLLOW_HINT = "Goes to the newest view whenever there is one."
_TURN_HINT = (
    "Turns the camera along the red arrow: the direction of largest utility from its position."
)
_RETURN_HINT = "Puts the camera back to where the view on the slider was taken."
_TRUTH_HINT = (
    "Compares with a photo from the scene that the run was recorded in. The scene is opened for "
    "it, which takes some seconds and half a gigabyte of memory, more for large ones."
)
_CANDIDATES_HINT = (
    "Draws the poses that the planner could choose from, yellow best. The planner is asked again "
    "for them, which takes as long as planning took."
)
_FRUSTA_HINT = "Draws a small camera for every view up to the one on the slider."

PANEL_WIDTH = 360
"""Width of the panel beside the scene [px]."""

_LEGEND_WIDTH = 300
"""Width of the legend over the scene [px]."""

_EDGE = 14
"""Distance of the legend from the edges of the scene [px]."""


@dataclass(frozen=True)
class DisplaySettings:
    """What the user has set."""

    step: int
    """The view whose moment is shown, from 0."""

    layer: Layer
    """What is drawn of the place."""

    place: str
    """From where the map's colors are seen: one of `PLACES`."""

    cut: float
    """Nothing is drawn above this height [m]."""

    shows_candidates: bool
    shows_views: bool
    """Whether the views before the one on the slider are drawn."""

    shows_truth: bool
    """Whether the dragged camera's true image is wanted."""

    @property
    def scene(self) -> tuple[object, ...]:
        """What the drawing of the place depends on."""
        return self.step, self.layer, self.place, self.cut


@dataclass(frozen=True)
class Menu:
    """What there is to choose from; the first layer is set."""

    title: str
    num_views: int
    layers: tuple[Layer, ...]

    heights: tuple[float, float, float]
    """Least, greatest and first height of the cut [m]."""

    is_live: bool
    """Whether views are being added: the newest one is followed then."""

    has_truth: bool
    """Whether there may be true images."""


class _Section:
    """HTML that belongs to one view and pose, and is faint once another one is selected."""

    def __init__(self, handle: viser.GuiHtmlHandle):
        """Takes over what the handle shows."""
        self._handle, self._shown = handle, handle.content

    @property
    def content(self) -> str:
        """What is on the page."""
        return self._handle.content

    def show(self, content: str) -> None:
        """Marks the content as that of the newest question."""
        self._shown, self._handle.content = content, content

    def mark(self, text: str) -> None:
        """Marks the content as that of an older question; says what is being done."""
        stale = stale_html(self._shown, text)
        if self._handle.content != stale:
            self._handle.content = stale


class Controls:
    """The panel and the legend. Methods may be called from any thread."""

    def __init__(self, server: viser.ViserServer, head: str, menu: Menu):
        """Lays them out.

        Args:
            server: with nothing on its page.
            head: what is said below the title.
            menu: what there is to choose from.
        """
        gui = server.gui
        self._server, self._layers = server, {layer.name: layer for layer in menu.layers}
        self._caption = ""
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(15, 118, 110))
        gui.set_panel_label(menu.title)
        gui.main_panel.dock_right()  # beside the scene, which is never under it
        gui.main_panel.set_width(PANEL_WIDTH)
        gui.add_html(head_html(head))
        self._note = gui.add_html("", visible=False)
        self._add_choices(gui, menu)
        self._add_view(gui, menu)
        self._add_camera(gui, menu)
        self._add_legend(gui)

    def _add_choices(self, gui: viser.GuiApi, menu: Menu) -> None:
        """Adds the menus that select the drawing."""
        names = tuple(self._layers)
        self._layer = gui.add_dropdown("show", names, hint=_SHOW_HINT)
        self._place = gui.add_dropdown("seen from", PLACES, hint=_SEEN_FROM_HINT)
        low, high, first = menu.heights
        self._cut = gui.add_slider("hide above [m]", low, high, 0.05, first, hint=_CUT_HINT)
        self._place.visible = self._layers[names[0]].has_score

    def _add_view(self, gui: viser.GuiApi, menu: Menu) -> None:
        """Shows the view on the slider."""
        last, is_live = max(menu.num_views, 1), menu.is_live
        self._step = gui.add_slider("view", 1, max(last, 2), 1, last, hint=_VIEW_HINT)
        self._follow = gui.add_checkbox(
            "follow newest", is_live, visible=is_live, hint=_FOLLOW_HINT
        )
        with gui.add_folder("View on the slider"):
            self._facts = _Section(gui.add_html(""))
            self._candidates = gui.add_checkbox("candidates", False, hint=_CANDIDATES_HINT)
            self._frusta = gui.add_checkbox("earlier views", True, hint=_FRUSTA_HINT)

    def _add_camera(self, gui: viser.GuiApi, menu: Menu) -> None:
        """Adds the numbers and pictures of the dragged camera."""
        with gui.add_folder("Camera that you drag"):
            self._numbers = _Section(gui.add_html(pending_html()))
            self._pictures = _Section(gui.add_html(""))
            self._truth = gui.add_checkbox(
                "true image", False, visible=menu.has_truth, hint=_TRUTH_HINT
            )
            self._turn = gui.add_button("Look along the suggested direction", hint=_TURN_HINT)
            self._return = gui.add_button("Go to the view on the slider", hint=_RETURN_HINT)

    def _add_legend(self, gui: viser.GuiApi) -> None:
        """Adds the legend over the scene, with the sign of the current computation."""
        window = gui.add_panel()
        with window.add_tab("Legend"):
            self._legend = gui.add_html("")
            self._bar = gui.add_progress_bar(0.0, visible=False)
        window.float(x=_EDGE, y=_EDGE, width=_LEGEND_WIDTH)

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
        async def change(event: Any) -> None:
            del event
            self._place.visible = self._layers[self._layer.value].has_score
            on_wish()

        async def turn(event: Any) -> None:
            del event
            on_turn()

        async def go_back(event: Any) -> None:
            del event
            on_return()

        for control in (self._step, self._cut, self._layer, self._place):
            control.on_update(change)
        for box in (self._candidates, self._frusta, self._truth):
            box.on_update(change)
        self._turn.on_click(turn)
        self._return.on_click(go_back)

    @property
    def settings(self) -> DisplaySettings:
        """What is set."""
        return DisplaySettings(
            step=int(self._step.value) - 1,
            layer=self._layers[self._layer.value],
            place=self._place.value,
            cut=float(self._cut.value),
            shows_candidates=self._candidates.value,
            shows_views=self._frusta.value,
            shows_truth=self._truth.value,
        )

    @property
    def is_following(self) -> bool:
        """Whether the newest view is to be shown."""
        return self._follow.value

    def set_step(self, step: int, num_views: int) -> None:
        """Moves the slider, and makes room on it."""
        self._step.max = max(num_views, 2)
        self._step.value = step + 1

    def show_view(self, content: str) -> None:
        """Shows the view on the slider."""
        self._facts.show(content)

    def show_numbers(self, content: str) -> None:
        """Shows the dragged camera's numbers."""
        self._numbers.show(content)

    def show_pictures(self, content: str) -> None:
        """Shows the dragged camera's pictures."""
        self._pictures.show(content)

    def mark_camera_stale(self) -> None:
        """Marks the dragged camera's numbers as those of another pose or moment."""
        self._numbers.mark("")
        self._pictures.mark("being computed …")

    def mark_view_stale(self, step: int) -> None:
        """Marks the facts as those of another view than the selected one."""
        self._facts.mark(f"opening view {step + 1} …")

    def show_busy(self, text: str, share: float) -> None:
        """Shows what is being computed, and the share that is done."""
        with self._server.atomic():
            self._legend.content = busy_html(text, self._caption)
            self._bar.value, self._bar.visible = 100.0 * share, True

    def show_legend(self, content: str) -> None:
        """Describes the drawing from now on."""
        self._caption = content
        with self._server.atomic():
            self._legend.content, self._bar.visible = content, False

    def show_ready(self) -> None:
        """Marks everything requested as shown."""
        self.show_legend(self._caption)

    def show_note(self, text: str) -> None:
        """Shows a problem; an empty text takes the line away."""
        with self._server.atomic():
            self._note.content, self._note.visible = note_html(text), bool(text)
