"""The legend beside the scene: what is drawn, of which moment, and what its colors mean. HTML."""

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r3jax.apps.report.reasons import COLORS
from r3jax.apps.viewer.blocks import CAUSE
from r3jax.apps.viewer.color_maps import ORDER, SCORES, UNSEEN, UTILITY_MAP, css_color, paint
from r3jax.apps.viewer.page.layers import Layer
from r3jax.apps.viewer.page.words import HINTS
from r3jax.scoring.explain import CAUSES

_BOX = '<div style="font:13px/1.45 system-ui,sans-serif;padding:4px 10px 6px">{}</div>'
_BAR = (
    '<div title="{hint}" style="cursor:help;margin-top:6px">'
    '<div style="height:9px;border-radius:3px;background:linear-gradient(90deg,{stops})"></div>'
    '<div style="display:flex;justify-content:space-between;font-size:12px;opacity:.75">'
    "<span>{low}</span><span>{high}</span></div></div>"
)
_SWATCH = (
    '<span title="{hint}" style="white-space:nowrap"><span style="display:inline-block;width:10px;'
    "height:10px;border:1px solid #8888;border-radius:2px;margin-right:5px;"
    'background:{color}"></span>{name}</span>'
)
_SWATCHES = (
    '<div style="display:flex;flex-wrap:wrap;gap:1px 12px;font-size:12px;margin-top:3px">{}</div>'
)
_STOPS = 12
"""Colors of a bar: a browser blends between them."""


@dataclass(frozen=True)
class Caption:
    """What is drawn."""

    layer: Layer
    moment: str
    """Such as `after view 37 of 100`."""

    detail: str
    """Such as how many voxels are drawn."""


def legend_html(caption: Caption, with_candidates: bool = False) -> str:
    """The legend of what is drawn.

    Args:
        caption: what is drawn.
        with_candidates: whether the candidates of a view are drawn too.
    """
    layer = caption.layer
    head = (
        f'<b style="font-size:14px">{html.escape(layer.title)}</b><br>'
        f'<span id="r3jax-moment">{html.escape(caption.moment)}</span>'
        f'<span style="opacity:.65"> · {html.escape(caption.detail)}</span>'
    )
    rows = [head]
    if layer.has_score:
        hint = HINTS["renderability R" if layer.quantity == "renderability" else layer.quantity]
        rows.append(_bar(SCORES, "0 poor", "1 perfect", hint))
        rows.append(_swatches([(css_color(UNSEEN), "seen from none of these places", "")]))
    elif layer.quantity == CAUSE:
        rows.append(_swatches([*_causes(), (css_color(UNSEEN), "not in its view", "")]))
    rows.append(
        _bar(ORDER, "path: first view", "last view", "Order in which the views were taken.")
    )
    if with_candidates:
        rows.append(_bar(UTILITY_MAP, "candidates: worst", "best", HINTS["candidates"]))
    rows.append('<div style="font-size:12px;opacity:.75">Squares of the grid are 1 m wide.</div>')
    return _BOX.format("".join(rows))


def busy_html(text: str, legend: str) -> str:
    """What is being computed, above the legend of what is drawn until then; "": nothing is yet."""
    until_then = '<div style="opacity:.65;margin-top:4px">Shown until then:</div>' if legend else ""
    return _BOX.format(f'<span id="r3jax-busy">{html.escape(text)} …</span>{until_then}') + legend


def _bar(name: str, low: str, high: str, hint: str) -> str:
    """A color map from left to right, and what its ends mean."""
    stops = ",".join(css_color(color) for color in paint(np.linspace(0.0, 1.0, _STOPS), name))
    return _BAR.format(hint=html.escape(hint), stops=stops, low=low, high=high)


def _swatches(entries: Sequence[tuple[str, str, str]]) -> str:
    """Colors, their names and hints."""
    parts = "".join(
        _SWATCH.format(hint=html.escape(hint), color=color, name=name)
        for color, name, hint in entries
    )
    return _SWATCHES.format(parts)


def _causes() -> list[tuple[str, str, str]]:
    return [(color, name, HINTS[name]) for color, name in zip(COLORS, CAUSES, strict=True)]
