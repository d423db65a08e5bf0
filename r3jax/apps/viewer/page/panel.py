"""The panel of the page: what the user can set, and the words, numbers and pictures beside it.

Words and numbers are HTML; what comes from files is escaped.
"""

import html
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from r3jax.apps.report.reasons import COLORS
from r3jax.apps.viewer.color_maps import paint
from r3jax.apps.viewer.preview import TERMS, CameraPreview, QuickPreview
from r3jax.apps.viewer.story import why_no_choice
from r3jax.exploration.explain_run import Reason
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.scoring.explain import CAUSES
from r3jax.trace.rows import StepRow

_BOX = '<div style="font:13px/1.45 system-ui,sans-serif;padding:2px 10px 6px">{}</div>'
_ROW = (
    '<div style="display:flex;justify-content:space-between;gap:8px">'
    '<span style="opacity:.65">{}</span><span style="font-variant-numeric:tabular-nums">{}</span>'
    "</div>"
)
_BAR = (
    '<div style="display:flex;align-items:center;gap:8px"><span style="opacity:.65;width:86px">'
    '{name}</span><span style="flex:1;height:7px;border-radius:4px;background:#8884">'
    '<span style="display:block;width:{percent:.0f}%;height:7px;border-radius:4px;'
    'background:{color}"></span></span><span style="width:34px;text-align:right;'
    'font-variant-numeric:tabular-nums">{value:.2f}</span></div>'
)
_SHARE = (
    '<div style="display:flex;align-items:baseline;gap:7px"><span style="width:9px;height:9px;'
    'border-radius:5px;border:1px solid #8888;background:{1}"></span><span style="flex:1">{0}'
    '</span><span style="opacity:.65">{2}</span><span style="width:44px;text-align:right;'
    'font-variant-numeric:tabular-nums">{3:.1f} %</span></div>'
)
_NUMBER = (
    '<div style="display:flex;align-items:baseline;gap:8px"><b id="r3jax-renderability" '
    'data-state="{state}" style="font-size:30px;font-variant-numeric:tabular-nums">{number}</b>'
    '<span style="opacity:.65">{words}</span></div>'
)


def title_html(title: str, subtitle: str) -> str:
    """The head of the panel."""
    return _BOX.format(
        f'<b style="font-size:15px">{html.escape(title)}</b><br>'
        f'<span style="opacity:.65">{html.escape(subtitle)}</span>'
    )


def note_html(text: str) -> str:
    """A line about what is going on, or went wrong."""
    escaped = html.escape(text)
    return _BOX.format(f'<span id="r3jax-note" style="opacity:.65">{escaped}</span>')


def view_html(row: StepRow, num_views: int) -> str:
    """What the trace says of a view: clock, path, coverage, and the best candidates' scores."""
    facts = {
        "view": f'<span id="r3jax-view">{row.step}</span> of {num_views - 1}',
        "mission clock": f"{row.seconds:.1f} s",
        "path": f"{row.metres:.1f} m",
        "explored": f"{100 * row.coverage.known_share:.0f} %",
        "mean renderability": f"{row.coverage.mean_renderability:.3f}",
        "R of this view before it": f"{row.coverage.arrival_renderability:.3f}",
    }
    text = "".join(_ROW.format(name, value) for name, value in facts.items())
    return _BOX.format(text + _candidates(row))


def _candidates(row: StepRow) -> str:
    """A table of the best candidates' utilities, best first; the first one was taken."""
    if row.choice is None:
        return f'<div style="opacity:.65;margin-top:4px">{why_no_choice(row)}</div>'
    choice = row.choice
    head = (
        f'<div style="margin-top:4px;opacity:.65">chosen from {choice.num_candidates} candidates, '
        f"{choice.num_reachable} within reach; the best:</div>"
    )
    names = list(choice.top)
    cells = "".join(f'<th style="text-align:right;font-weight:600">{_e(n)}</th>' for n in names)
    lines = [f"<tr>{cells}</tr>"]
    for values in list(zip(*choice.top.values(), strict=False))[:5]:
        cells = "".join(f'<td style="text-align:right">{_number(v)}</td>' for v in values)
        lines.append(f"<tr>{cells}</tr>")
    style = "width:100%;font-size:12px;font-variant-numeric:tabular-nums"
    return f'{head}<table style="{style}">{"".join(lines)}</table>'


def reason_html(reason: Reason | str) -> str:
    """What a view promised when it was chosen, by cause; or why that is not known."""
    head = '<div style="opacity:.65">its utility when it was chosen</div>'
    if isinstance(reason, str):
        return _BOX.format(f'{head}<div id="r3jax-reason">{_e(reason)}</div>')
    total = reason.utility
    shares = reason.totals / total if total > 0.0 else np.zeros(len(CAUSES))
    parts = "".join(
        f'<span style="width:{100.0 * share:.1f}%;background:{color}"></span>'
        for share, color in zip(shares, COLORS, strict=True)
    )
    counts = [f"{len(reason.cells)} cells"] + [
        f"{voxels} voxels" for voxels in (reason.shares > 0.0).sum(axis=1)
    ]
    table = zip(CAUSES, COLORS, counts, shares, strict=True)
    lines = "".join(_SHARE.format(*line[:3], 100.0 * line[3]) for line in table)
    number = f'<b style="font-size:18px">{total:.0f}</b>'
    return _BOX.format(
        f'{head}{number}<div style="display:flex;height:9px;border-radius:4px;overflow:hidden;'
        f'margin:2px 0 4px;background:#8884">{parts}</div><div id="r3jax-reason">{lines}</div>'
    )


def pending_html() -> str:
    """Before the first numbers."""
    return _BOX.format(_NUMBER.format(state="computing", number="…", words="computing"))


def stale_html(content: str) -> str:
    """Numbers that belong to another pose, faint; `content` comes from this module."""
    if 'data-state="computing"' in content:
        return content
    faint = content.replace('data-state="done"', 'data-state="computing"')
    return f'<div style="opacity:.3">{faint}</div>'


def preview_html(glance: QuickPreview, look: CameraPreview | None) -> str:
    """R of the dragged camera, its terms, and the utility of looking there."""
    bars = "".join(_bar(name, glance.means[name]) for name in TERMS[1:])
    number = f"{glance.renderability:.3f}"
    head = _NUMBER.format(state="done", number=number, words="renderability of this view")
    facts = {"shows known surfaces in": f"{100 * glance.seen:.0f} % of its pixels"}
    if look is not None:
        facts["unexplored cells in view"] = f"{look.exploration:.0f}"
        facts["lack in view, Σ (1 − R)"] = f"{look.rendering:.0f}"
        facts["score along its axis / best"] = _scores(look)
    rows = "".join(_ROW.format(name, value) for name, value in facts.items())
    return _BOX.format(head + bars + rows)


def _scores(look: CameraPreview) -> str:
    """The panorama's score where the camera looks, and the best one."""
    lattice = fibonacci_lattice(len(look.direction_scores))
    here = int(np.argmax(lattice @ look.T_world_camera[:3, 2]))
    return f"{look.direction_scores[here]:.0f} / {look.direction_scores.max():.0f}"


def _bar(name: str, value: float) -> str:
    color = "#" + "".join(f"{c:02x}" for c in paint(np.asarray([value]))[0])
    return _BAR.format(name=name, percent=100.0 * value, color=color, value=value)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _e(text: str) -> str:
    return html.escape(text)


PLACES = ("free space", "the dragged camera")
"""From where the map's colors are seen."""

_BLANK = np.full((4, 4, 3), 245, np.uint8)
_COMPUTING = "computing …"


@dataclass(frozen=True)
class DisplaySettings:
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
        async def change(event: Any) -> None:
            del event
            on_wish()

        async def turn(event: Any) -> None:
            del event
            on_turn()

        async def go_back(event: Any) -> None:
            del event
            on_return()

        self._step.on_update(change)
        self._cut.on_update(change)
        self._quantity.on_update(change)
        self._place.on_update(change)
        self._surface.on_update(change)
        self._candidates.on_update(change)
        self._frusta.on_update(change)
        self._turn.on_click(turn)
        self._return.on_click(go_back)

    @property
    def settings(self) -> DisplaySettings:
        """What is set."""
        return DisplaySettings(
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
            self._panorama.label = "utility of every direction (ring: suggested)"
        self._is_pending = False

    def show_note(self, text: str) -> None:
        """A line at the top."""
        self._note.content = note_html(text)
