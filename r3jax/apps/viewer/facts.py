"""The page's text about a view, the dragged camera and the drawing, as HTML.

The parts are macros of `facts.html`, which escapes content of files. Every quantity has a tooltip:
a name that is not in `HINTS` is an error.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from r3jax.apps.viewer.drawing import (
    CAUSE,
    ORDER,
    SCORES,
    TERMS,
    UNSEEN,
    UTILITY_MAP,
    CameraPreview,
    QuickPreview,
    css_color,
    paint,
)
from r3jax.apps.viewer.story import why_no_choice
from r3jax.exploration.taken_views import Choice, StepRow
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.plots import style
from r3jax.plots.page import data_url, render_macro
from r3jax.runs.replay import Reason
from r3jax.scoring.explain import CAUSES

HINTS = {
    # The view on the slider.
    "mission clock": "Time that the mission has taken so far: planning, mapping and flight. "
    "Rendering the simulator's images does not count.",
    "this view cost": "Time that this view added to the clock: planning, mapping and flight.",
    "path": "Length of the path flown so far.",
    "explored": "Share of the cells in the scene's box that are known to be free or occupied. "
    "Nothing ever shows the insides of walls and furniture, so it stays below 100 %.",
    "mean renderability": "Renderability, averaged over fixed test views in the free space that is "
    "known. 1 is perfect.",
    "R before this view": "Renderability of this view just before it joined the map. A low value "
    "means that the view showed something new, a high one that it repeated known surfaces.",
    # The camera that is dragged.
    "renderability R": "How well an image from this camera could be rendered from the views so "
    "far: 0 is not at all, 1 is perfect. R = bias x noise x resolution, averaged over the pixels.",
    "bias": "Viewing angle: 1 where a surface was seen from exactly this direction, falling to 0 "
    "with the angle to the nearest direction from which it was seen.",
    "noise": "Color agreement: 1 where the views agree on a surface's color, less on shiny or "
    "transparent surfaces.",
    "resolution": "Closeness: 1 where some view was at least as close to the surface as this "
    "camera, less where all of them were farther away.",
    "known surface": "Share of the pixels that show a surface in the map. All other pixels count "
    "as R = 0.",
    "unexplored cells": "U_G: cells of the coarse grid in view that no view has shown yet.",
    "missing quality": "U_R: the sum of 1 - R over the voxels in view. A view from here "
    "would improve much if it is high.",
    "utility ahead": "Utility of the view straight ahead: unexplored cells (weighted "
    "by lambda1) plus missing quality.",
    "utility, best direction": "The same for the best direction from this position: the ring in "
    "the picture below, and the red arrow in the scene.",
    # Candidates and causes.
    "candidates": "Poses that the planner could choose from, best score first. Score = share of "
    "the utility minus lambda2 times share of the path.",
    "promise": "Utility of the chosen view, recomputed pixel by pixel and divided among four "
    "causes: unexplored cells (weighted by lambda1) plus the sum of 1 - R over the voxels in view. "
    "The planner's own number in the list above may differ: planners use a faster estimate.",
    **dict(
        zip(
            CAUSES,
            (
                "Unexplored space in view.",
                "Surfaces seen only from directions far from this view's.",
                "Surfaces whose color differed from view to view.",
                "Surfaces seen only from farther away.",
            ),
            strict=True,
        )
    ),
}
"""Tooltips by the name of the quantity on the page."""

PLACES = ("places in free space", "the dragged camera")
"""From where the map's colors are seen."""


@dataclass(frozen=True)
class Layer:
    """One entry of the menu."""

    name: str
    """Name in the menu."""

    surface: str
    """Surface that is drawn: voxels, splats, points or mesh."""

    quantity: str
    """Quantity that gives the colors: one of `drawing.QUANTITIES`, or `CAUSE`."""

    title: str
    """Title in the legend."""

    @property
    def has_score(self) -> bool:
        """True if the colors are those of R or of a term, which depend on a position."""
        return self.quantity not in ("color", CAUSE)

    @property
    def is_of_one_view(self) -> bool:
        """True if it shows the map after a view; other layers show the whole run."""
        return self.surface == "voxels"


LAYERS = (
    Layer("splats", "splats", "color", "Splats trained on this run"),
    Layer("colors", "voxels", "color", "Map in its own colors"),
    Layer("renderability R", "voxels", "renderability", "Renderability R of the map"),
    Layer("bias: viewing angle", "voxels", "bias", "Bias: seen from the right angle?"),
    Layer("noise: color agreement", "voxels", "noise", "Noise: do the views agree on the color?"),
    Layer("resolution: closeness", "voxels", "resolution", "Resolution: seen from close enough?"),
    Layer("why this view was chosen", "voxels", CAUSE, "Why this view was chosen"),
    Layer("measured points", "points", "color", "Measured points of all views"),
    Layer("scene mesh", "mesh", "color", "The scene's own mesh"),
)
"""The menu, in order."""


def menu_of(surfaces: tuple[str, ...], *, with_causes: bool) -> tuple[Layer, ...]:
    """Returns the entries of a menu, the initial one first: splats if there are any, else colors.

    Args:
        surfaces: what there is to draw.
        with_causes: whether it can be known why a view was chosen.
    """
    return tuple(
        layer
        for layer in LAYERS
        if layer.surface in surfaces and (with_causes or layer.quantity != CAUSE)
    )


_SHOWN = 5
"""Candidates that are listed."""

_COARSE = 160
"""Width from which a picture is smoothed when it is made larger [px]."""

_STOPS = 12
"""Colors of a bar: a browser blends between them."""


def _part(macro: str, **values: Any) -> str:
    return render_macro("apps/viewer/facts.html", macro, hints=HINTS, **values)


def head_html(text: str) -> str:
    """Formats the line below the title."""
    return _part("head", text=text)


def note_html(text: str) -> str:
    """Formats a note about an error, or about something missing."""
    return _part("note", text=text)


def view_html(
    row: StepRow, num_views: int, image: np.ndarray, reason: Reason | str, unit: str = "view"
) -> str:
    """Formats the photo of a view, its facts from the trace, and why it was chosen.

    Args:
        row: of the trace.
        num_views: of the run so far.
        image: the photo, [H, W, 3] uint8.
        reason: what the view promised, or why that is not known.
        unit: `view`, or `frame` in runs with frames between views.
    """
    return _part(
        "view",
        unit=unit,
        view_number=row.step + 1,
        num_views=num_views,
        photo=_picture(image),
        facts=facts_of_view(row),
        costs=" + ".join(f"{name} {seconds:.1f} s" for name, seconds in row.charged.items()),
        choice=row.choice,
        why_not=None if row.choice else why_no_choice(row),
        best=best_candidates(row.choice) if row.choice else [],
        promise=promise_of(reason),
    )


def facts_of_view(row: StepRow) -> dict[str, str]:
    """Returns the facts that the trace contains about a view."""
    return {
        "mission clock": f"{row.seconds:.1f} s",
        "this view cost": f"{sum(row.charged.values()):.1f} s",
        "path": f"{row.metres:.1f} m",
        "explored": f"{100 * row.coverage.known_share:.0f} %",
        "mean renderability": f"{row.coverage.mean_renderability:.2f}",
        "R before this view": f"{row.coverage.arrival_renderability:.2f}",
    }


def best_candidates(choice: Choice) -> list[dict[str, Any]]:
    """Describes the best candidates of a decision."""
    chosen = chosen_rank(choice)
    lines: list[dict[str, Any]] = []
    for rank in range(min(len(choice.top.get("total", [])), _SHOWN)):
        values = {name: column[rank] for name, column in choice.top.items() if rank < len(column)}
        utility, path = values.get("utility"), values.get("path")
        parts = [
            f"score {_number(values['total'])}"
            if utility is None
            else f"utility {_number(utility)}",
            "out of reach" if path is None else f"{path:.1f} m away",
        ]
        hint = ", ".join(f"{_PARTS.get(name, name)} {_number(v)}" for name, v in values.items())
        lines.append({
            "rank": _ordinal(rank + 1),
            "text": " · ".join([*parts, "chosen"] if rank == chosen else parts),
            "hint": hint,
            "is_chosen": rank == chosen,
        })  # fmt: skip
    return lines


def chosen_rank(choice: Choice) -> int | None:
    """Finds the chosen view among the best candidates, from 0; None if it is not among them."""
    for rank, total in enumerate(choice.top.get("total", [])):
        if total is not None and math.isclose(total, choice.score, rel_tol=1e-5, abs_tol=1e-12):
            return rank
    return None


_PARTS = {
    "total": "score",
    "path": "path with turns [m]",
    "exploration": "unexplored cells",
    "rendering": "missing quality",
}
"""Names of a candidate's numbers in words."""


def _ordinal(number: int) -> str:
    return f"{number}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(number, 'th') }"


def promise_of(reason: Reason | str) -> dict[str, Any] | str:
    """Describes what a view promised when it was chosen, by cause, or why that is not known."""
    if isinstance(reason, str):
        return reason
    total = reason.utility
    shares = reason.totals / total if total > 0.0 else np.zeros(len(CAUSES))
    counts = [_count(len(reason.cells), "cell")] + [
        _count(voxels, "voxel") for voxels in (reason.shares > 0.0).sum(axis=1).tolist()
    ]
    causes = [
        {"name": name, "color": color, "count": count, "percent": f"{100.0 * share:.1f}"}
        for name, color, count, share in zip(
            CAUSES, style.CAUSE_COLORS, counts, shares, strict=True
        )
    ]
    return {"utility": f"{total:,.0f}", "causes": causes}


def _count(number: int, name: str) -> str:
    return f"{number:,} {name}" if number == 1 else f"{number:,} {name}s"


def pending_html() -> str:
    """Formats the placeholder before the first numbers."""
    return _part("pending")


def stale_html(content: str, text: str = "") -> str:
    """Shows content of another pose or view faintly, below a note on the current computation.

    Args:
        content: from this module.
        text: note on the current computation.
    """
    faint = content.replace('data-state="done"', 'data-state="computing"')
    return _part("stale", content=faint, text=text)


def preview_html(glance: QuickPreview, look: CameraPreview | None, view: int) -> str:
    """Formats R of the dragged camera, its terms, and the utility of its directions.

    Args:
        glance: what takes milliseconds.
        look: the other numbers, once they are computed.
        view: number of the last view in the map that it is scored on, from 1.
    """
    facts = {"known surface": f"{100 * glance.seen:.0f} % of its pixels"}
    if look is not None:
        this, best = _utilities(look)
        facts["unexplored cells"] = f"{look.exploration:,.0f}"
        facts["missing quality"] = f"{look.rendering:,.0f}"
        facts["utility ahead"] = f"{this:,.0f}"
        facts["utility, best direction"] = f"{best:,.0f}"
    terms = [
        {"name": name, "percent": f"{100.0 * value:.0f}", "color": _color(value, SCORES),
         "value": f"{value:.2f}"}
        for name, value in ((name, glance.means[name]) for name in TERMS[1:])
    ]  # fmt: skip
    renderability = f"{glance.renderability:.3f}"
    return _part("preview", renderability=renderability, view_number=view, terms=terms, facts=facts)


def pictures_html(pictures: Sequence[tuple[str, np.ndarray]], panorama: np.ndarray) -> str:
    """Formats the dragged camera's pictures and its panorama, each with its name.

    Args:
        pictures: names and pictures, [H, W, 3] uint8 each.
        panorama: utility of every direction, [h, w, 3] uint8.
    """
    return _part(
        "pictures",
        shown=[(name, _picture(image)) for name, image in pictures],
        panorama=_picture(panorama),
        low=_color(0.0, UTILITY_MAP),
        high=_color(1.0, UTILITY_MAP),
    )


def _picture(image: np.ndarray) -> dict[str, Any]:
    """Prepares a picture [H, W, 3] uint8 for the template."""
    return {"url": image_url(image), "is_coarse": _is_coarse(image)}


def image_url(image: np.ndarray) -> str:
    """Encodes a picture [H, W, 3] uint8 as a data URL."""
    file, kind = io.BytesIO(), "png" if _is_coarse(image) else "jpeg"
    Image.fromarray(np.ascontiguousarray(image)).save(file, kind, quality=88)
    return data_url(file.getvalue(), kind)


def _is_coarse(picture: np.ndarray) -> bool:
    """Returns True for a picture of few pixels, which stay squares: measurements, no photo."""
    return picture.shape[1] < _COARSE


def _utilities(look: CameraPreview) -> tuple[float, float]:
    """Returns the utility where the camera looks, and the best one from its position."""
    lattice = fibonacci_lattice(len(look.direction_scores))
    here = int(np.argmax(lattice @ look.T_world_camera[:3, 2]))
    return float(look.direction_scores[here]), float(look.direction_scores.max())


def _color(share: float, name: str) -> str:
    return css_color(paint(np.asarray([share]), name)[0])


def _number(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


@dataclass(frozen=True)
class Caption:
    """Content of the legend."""

    layer: Layer
    moment: str
    """Such as `after view 37 of 100`."""

    detail: str
    """A detail, such as the number of voxels."""


def legend_html(caption: Caption, with_candidates: bool = False) -> str:
    """Formats the legend: the drawn layer, its moment, and the meaning of its colors.

    Args:
        caption: the current drawing.
        with_candidates: whether the candidates of a view are drawn too.
    """
    layer = caption.layer
    entries: list[dict[str, Any] | list[tuple[str, str]]] = []
    if layer.has_score:
        hint = HINTS["renderability R" if layer.quantity == "renderability" else layer.quantity]
        entries.append(_bar(SCORES, "0 poor", "1 perfect", hint))
        entries.append([(css_color(UNSEEN), "seen from none of these places")])
    elif layer.quantity == CAUSE:
        causes = zip(style.CAUSE_COLORS, CAUSES, strict=True)
        entries.append([*causes, (css_color(UNSEEN), "not in its view")])
    order = "Order in which the views were taken."
    entries.append(_bar(ORDER, "path: first view", "last view", order))
    if with_candidates:
        entries.append(_bar(UTILITY_MAP, "candidates: worst", "best", HINTS["candidates"]))
    return _part(
        "legend",
        title=layer.title,
        moment=caption.moment,
        detail=caption.detail,
        entries=entries,
    )


def _bar(name: str, low: str, high: str, hint: str) -> dict[str, Any]:
    """Returns a color map from left to right, and the meaning of its ends."""
    stops = [css_color(color) for color in paint(np.linspace(0.0, 1.0, _STOPS), name)]
    return {"hint": hint, "stops": stops, "low": low, "high": high}


def busy_html(text: str, legend: str) -> str:
    """Formats a note on the current computation, above the legend of the current drawing.

    The legend is empty if nothing is drawn yet.
    """
    return _part("busy", text=text, until_then=legend)
