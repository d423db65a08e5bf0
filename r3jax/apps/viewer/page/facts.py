"""What the panel says of a view and of the dragged camera, as HTML.

What comes from files is escaped. Every quantity has a tooltip: a name that `words.HINTS` does not
know is an error.
"""

import base64
import html
import io
import math
from collections.abc import Sequence

import numpy as np
from PIL import Image

from r3jax.apps.report.reasons import COLORS
from r3jax.apps.viewer.color_maps import UTILITY_MAP, css_color, paint
from r3jax.apps.viewer.page.words import HINTS
from r3jax.apps.viewer.preview import TERMS, CameraPreview, QuickPreview
from r3jax.apps.viewer.story import why_no_choice
from r3jax.exploration.explain_run import Reason
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.scoring.explain import CAUSES
from r3jax.trace.rows import Choice, StepRow

_BOX = '<div style="font:13px/1.45 system-ui,sans-serif;padding:2px 10px 6px">{}</div>'
_ROW = (
    '<div title="{hint}" style="display:flex;justify-content:space-between;gap:8px;cursor:help">'
    '<span style="opacity:.65">{name}</span>'
    '<span style="font-variant-numeric:tabular-nums">{value}</span></div>'
)
_TERM = (
    '<div title="{hint}" style="display:flex;align-items:center;gap:8px;cursor:help">'
    '<span style="opacity:.65;width:74px">{name}</span>'
    '<span style="flex:1;height:7px;border-radius:4px;background:#8884">'
    '<span style="display:block;width:{percent:.0f}%;height:7px;border-radius:4px;'
    'background:{color}"></span></span><span style="width:34px;text-align:right;'
    'font-variant-numeric:tabular-nums">{value:.2f}</span></div>'
)
_SHARE = (
    '<div title="{hint}" style="display:flex;align-items:baseline;gap:7px;cursor:help">'
    '<span style="width:9px;height:9px;border-radius:5px;border:1px solid #8888;'
    'background:{color}"></span><span style="flex:1">{name}</span>'
    '<span style="opacity:.65">{count}</span><span style="width:54px;text-align:right;'
    'font-variant-numeric:tabular-nums">{percent:.1f} %</span></div>'
)
_NUMBER = (
    '<div title="{hint}" style="display:flex;align-items:baseline;gap:8px;cursor:help">'
    '<b id="r3jax-renderability" data-state="{state}" style="font-size:30px;line-height:1.2;'
    'font-variant-numeric:tabular-nums">{number}</b><span style="opacity:.65">{words}</span></div>'
)
_CANDIDATE = (
    '<div title="{hint}" style="display:flex;gap:8px;cursor:help;font-weight:{weight};'
    'font-variant-numeric:tabular-nums"><span style="width:26px;opacity:.65">{rank}</span>'
    "<span>{text}</span></div>"
)
_IMAGE = (
    '<img src="{url}" alt="" style="width:100%;display:block;border-radius:4px;'
    'image-rendering:{rendering}">'
)
_TILE = (
    '<figure style="margin:0">{picture}<figcaption style="opacity:.65;font-size:12px">{name}'
    "</figcaption></figure>"
)
_MUTED = '<div style="opacity:.65;margin-top:6px">{}</div>'
_SHOWN = 5
"""Candidates that are listed."""

_COARSE = 160
"""Width from which a picture is smoothed when it is made larger [px]."""


def head_html(text: str) -> str:
    """The line below the title."""
    return _BOX.format(f'<span style="opacity:.65">{_e(text)}</span>')


def note_html(text: str) -> str:
    """A line about what went wrong, or is missing."""
    return _BOX.format(f'<span id="r3jax-note">{_e(text)}</span>')


def view_html(row: StepRow, num_views: int, image: np.ndarray, reason: Reason | str) -> str:
    """The photo of a view, what the trace says of it, and why it was chosen.

    Args:
        row: of the trace.
        num_views: of the run so far.
        image: the photo, [H, W, 3] uint8.
        reason: what the view promised, or why that is not known.
    """
    coverage, total = row.coverage, sum(row.charged.values())
    facts = {
        "mission clock": f"{row.seconds:.1f} s",
        "this view cost": f'<span title="{_e(_costs(row))}">{total:.1f} s</span>',
        "path": f"{row.metres:.1f} m",
        "explored": f"{100 * coverage.known_share:.0f} %",
        "mean renderability": f"{coverage.mean_renderability:.2f}",
        "R before this view": f"{coverage.arrival_renderability:.2f}",
    }
    table = "".join(_row(name, value) for name, value in facts.items())
    head = (
        f'<div style="font-weight:600;margin-bottom:3px">view <span id="r3jax-view">{row.step + 1}'
        f"</span> of {num_views}</div>"
    )
    photo = f'<img src="{image_url(image)}" alt="its photo" style="width:40%;border-radius:4px">'
    beside = f'{photo}<div style="flex:1;min-width:0">{table}</div>'
    return _BOX.format(
        f'{head}<div style="display:flex;gap:12px;align-items:flex-start">{beside}</div>'
        f"{candidates_html(row)}{reason_html(reason)}"
    )


def _costs(row: StepRow) -> str:
    """What a view cost, part by part."""
    return " + ".join(f"{name} {seconds:.1f} s" for name, seconds in row.charged.items())


def candidates_html(row: StepRow) -> str:
    """The best candidates of a decision, a row each; or why there was no decision."""
    choice = row.choice
    if choice is None:
        return _MUTED.format(why_no_choice(row))
    head = f"chosen from {choice.num_candidates} candidates, {choice.num_reachable} within reach"
    chosen, num = chosen_rank(choice), min(len(choice.top.get("total", [])), _SHOWN)
    lines = "".join(_candidate(choice, rank, rank == chosen) for rank in range(num))
    return (
        f'<div title="{_e(HINTS["candidates"])}" style="margin-top:6px;cursor:help">{head}</div>'
        f"{lines}"
    )


def chosen_rank(choice: Choice) -> int | None:
    """Which of the best candidates was taken, from 0; None if it is not among them."""
    for rank, total in enumerate(choice.top.get("total", [])):
        if total is not None and math.isclose(total, choice.score, rel_tol=1e-5, abs_tol=1e-12):
            return rank
    return None


def _candidate(choice: Choice, rank: int, is_chosen: bool) -> str:
    """One candidate in words."""
    values = {name: column[rank] for name, column in choice.top.items() if rank < len(column)}
    utility, path = values.get("utility"), values.get("path")
    parts = [
        f"score {_number(values['total'])}" if utility is None else f"utility {_number(utility)}",
        "out of reach" if path is None else f"{path:.1f} m away",
    ]
    if is_chosen:
        parts.append("chosen")
    hint = ", ".join(f"{_PARTS.get(name, name)} {_number(value)}" for name, value in values.items())
    weight = 600 if is_chosen else 400
    return _CANDIDATE.format(
        hint=_e(hint), weight=weight, rank=_ordinal(rank + 1), text=" · ".join(parts)
    )


_PARTS = {
    "total": "score",
    "path": "path with turns [m]",
    "exploration": "unexplored cells",
    "rendering": "missing quality",
}
"""Names of a candidate's numbers in words."""


def _ordinal(number: int) -> str:
    return f"{number}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(number, 'th') }"


def reason_html(reason: Reason | str) -> str:
    """What a view promised when it was chosen, by cause; or why that is not known."""
    hint = _e(HINTS["promise"])
    head = f'<div title="{hint}" style="margin-top:6px;cursor:help">{{}}</div>'
    if isinstance(reason, str):
        words = head.format("what it promised")
        return f'{words}<div id="r3jax-reason" style="opacity:.65">{_e(reason)}</div>'
    total = reason.utility
    shares = reason.totals / total if total > 0.0 else np.zeros(len(CAUSES))
    parts = "".join(
        f'<span style="width:{100.0 * share:.1f}%;background:{color}"></span>'
        for share, color in zip(shares, COLORS, strict=True)
    )
    counts = [_count(len(reason.cells), "cell")] + [
        _count(voxels, "voxel") for voxels in (reason.shares > 0.0).sum(axis=1).tolist()
    ]
    lines = "".join(
        _SHARE.format(
            hint=_e(HINTS[name]), name=name, color=color, count=count, percent=100.0 * share
        )
        for name, color, count, share in zip(CAUSES, COLORS, counts, shares, strict=True)
    )
    words = head.format(f"what it promised: utility <b>{total:,.0f}</b>")
    return (
        f'{words}<div style="display:flex;height:9px;border-radius:4px;overflow:hidden;'
        f'margin:2px 0 4px;background:#8884">{parts}</div><div id="r3jax-reason">{lines}</div>'
    )


def _count(number: int, name: str) -> str:
    return f"{number:,} {name}" if number == 1 else f"{number:,} {name}s"


def pending_html() -> str:
    """Before the first numbers."""
    return _BOX.format(_number_html("computing", "…", "being computed"))


def stale_html(content: str, text: str = "") -> str:
    """What belongs to another pose or view, faint, below what is going on.

    Args:
        content: from this module.
        text: what is being computed.
    """
    faint = content.replace('data-state="done"', 'data-state="computing"')
    head = f'<div style="padding:0 10px;font:13px system-ui">{_e(text)}</div>' if text else ""
    return f'{head}<div style="opacity:.3">{faint}</div>'


def preview_html(glance: QuickPreview, look: CameraPreview | None, view: int) -> str:
    """R of the dragged camera, its terms, and the utility of looking there.

    Args:
        glance: what takes milliseconds.
        look: the rest, once it is there.
        view: number of the last view in the map that it is scored on, from 1.
    """
    words = f"renderability R, after view {view}"
    head = _number_html("done", f"{glance.renderability:.3f}", words)
    bars = "".join(_term(name, glance.means[name]) for name in TERMS[1:])
    facts = {"known surface": f"{100 * glance.seen:.0f} % of its pixels"}
    if look is not None:
        this, best = _utilities(look)
        facts["unexplored cells"] = f"{look.exploration:,.0f}"
        facts["missing quality"] = f"{look.rendering:,.0f}"
        facts["utility this way"] = f"{this:,.0f}"
        facts["utility the best way"] = f"{best:,.0f}"
    rows = "".join(_row(name, value) for name, value in facts.items())
    return _BOX.format(head + bars + rows)


def pictures_html(pictures: Sequence[tuple[str, np.ndarray]], panorama: np.ndarray) -> str:
    """The dragged camera's pictures and its panorama, each with its name.

    Args:
        pictures: names and pictures, [H, W, 3] uint8 each.
        panorama: utility of every direction, [h, w, 3] uint8.
    """
    tiles = "".join(
        _TILE.format(picture=_image(picture), name=_e(name)) for name, picture in pictures
    )
    low, high = (_color(share) for share in (0.0, 1.0))
    return _BOX.format(
        f'<div style="display:grid;grid-template-columns:1fr 1fr;gap:6px">{tiles}</div>'
        f'<figure style="margin:6px 0 0">{_image(panorama)}<figcaption style="font-size:12px">'
        f'<span style="opacity:.65">utility of every direction: </span>{_swatch(low)} low '
        f"{_swatch(high)} high"
        '<span style="opacity:.65"> · cross: this camera · ring: best</span>'
        "</figcaption></figure>"
    )


def _image(picture: np.ndarray) -> str:
    """A picture [H, W, 3] uint8, as wide as there is room."""
    rendering = "pixelated" if _is_coarse(picture) else "auto"
    return _IMAGE.format(url=image_url(picture), rendering=rendering)


def image_url(image: np.ndarray) -> str:
    """A picture [H, W, 3] uint8 as an address that holds it."""
    file, kind = io.BytesIO(), "png" if _is_coarse(image) else "jpeg"
    Image.fromarray(np.ascontiguousarray(image)).save(file, kind, quality=88)
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"


def _is_coarse(picture: np.ndarray) -> bool:
    """Few pixels stay squares: they are measurements, no photo."""
    return picture.shape[1] < _COARSE


def _utilities(look: CameraPreview) -> tuple[float, float]:
    """The utility where the camera looks, and the best one from its position."""
    lattice = fibonacci_lattice(len(look.direction_scores))
    here = int(np.argmax(lattice @ look.T_world_camera[:3, 2]))
    return float(look.direction_scores[here]), float(look.direction_scores.max())


def _number_html(state: str, number: str, words: str) -> str:
    hint = _e(HINTS["renderability R"])
    return _NUMBER.format(hint=hint, state=state, number=number, words=words)


def _row(name: str, value: str) -> str:
    return _ROW.format(hint=_e(HINTS[name]), name=name, value=value)


def _term(name: str, value: float) -> str:
    color = css_color(paint(np.asarray([value]))[0])
    return _TERM.format(
        hint=_e(HINTS[name]), name=name, percent=100.0 * value, color=color, value=value
    )


def _swatch(color: str) -> str:
    return (
        f'<span style="display:inline-block;width:9px;height:9px;border-radius:2px;'
        f'background:{color}"></span>'
    )


def _color(share: float) -> str:
    return css_color(paint(np.asarray([share]), UTILITY_MAP)[0])


def _number(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _e(text: str) -> str:
    return html.escape(text)
