"""Defines one style per policy for all figures: color, marker and line. Ours are warm and thick.

The colors are those of Okabe and Ito ("Color universal design", 2008), which people with any kind
of color vision can distinguish; the floor (frontier, uniform, random) is ink, brown and light gray.
Markers and dashes repeat the distinction, for print.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from r3jax.evaluation.comparison import policy_of
from r3jax.plots import style

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colors of groups that are no policies."""


@dataclass(frozen=True)
class PolicyStyle:
    """How one method is drawn."""

    color: str
    marker: str
    dashes: Any
    """Style of the line, as matplotlib takes it."""

    width: float
    """Line width [pt]."""

    order: float
    """Height in the stack of artists: ours are drawn on top."""

    fill: Literal["full", "none", "left", "bottom"] = "full"
    """How much of the marker is filled: a curve of one point has no line to tell it by."""

    def line(self) -> dict[str, Any]:
        """Returns arguments of `Axes.plot`."""
        return {
            "color": self.color, "marker": self.marker, "linestyle": self.dashes,
            "linewidth": self.width, "markersize": 4.5, "zorder": self.order,
            "fillstyle": self.fill,
        }  # fmt: skip


_POLICIES = {
    "r3-pano": ("#D55E00", "o", "-"),
    "r3": ("#E69F00", "s", "-"),
    "r3-ahead": ("#8f2d00", ">", "-"),
    "active-gs": ("#0072B2", "^", "-"),
    "active-gs-online": ("#0072B2", "8", ":"),
    "fisherrf": ("#009E73", "H", "-."),
    "gauss-mi": ("#CC79A7", "s", "-."),
    "r3con": ("#332288", "P", "-"),
    "active-gamer": ("#56B4E9", "v", "-"),
    "cover": ("#CC79A7", "D", "-"),
    "gavis": ("#882255", "H", "-"),
    "frontier": (style.INK, "X", "-"),
    "random": ("#c3c9d1", "h", "-"),
}
"""Color, marker and dashes; the variants of one idea share a color."""

_UNKNOWN = ("#8b5cf6", "*", "-")
_VARIANTS: tuple[tuple[Any, Literal["none", "left", "bottom"]], ...] = (
    (":", "none"), ("-.", "left"), ((0, (5, 1, 1, 1, 1, 1)), "bottom"),
)  # fmt: skip
"""Dashes and filling of the markers, of other settings of a policy than the first."""


def styles_of(methods: Sequence[str]) -> dict[str, PolicyStyle]:
    """Returns the style of each method, named as `equal_terms.method_name` writes it.

    The first settings of a policy have the same style in every figure; others have other dashes,
    and markers that are hollow or half filled.
    """
    seen: dict[str, int] = {}
    styles: dict[str, PolicyStyle] = {}
    for method in methods:
        policy = policy_of(method)
        color, marker, dashes = _POLICIES.get(policy, _UNKNOWN)
        variant = seen[policy] = seen.get(policy, -1) + 1
        fill = "full"
        if variant:
            dashes, fill = _VARIANTS[(variant - 1) % len(_VARIANTS)]
        width, order = (2.6, 4.0) if policy in ("r3", "r3-pano", "r3-ahead") else (1.5, 3.0)
        styles[method] = PolicyStyle(color, marker, dashes, width, order, fill)
    return styles


def legend_below(figure: Figure, labels: Sequence[str]) -> None:
    """Draws one legend for all panels, below them; the figure grows by its height.

    Args:
        figure: whose axes have artists with these labels.
        labels: in the order of the legend; those that no panel has are left out.
    """
    found: dict[str, Any] = {}
    for axes in figure.axes:
        found = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True)) | found
    named = [label for label in labels if label in found]
    if not named:
        return
    columns = _columns_that_fit(named, figure.get_figwidth() - 0.3)
    figure.set_figheight(figure.get_figheight() + _LEGEND_LINE * -(-len(named) // columns))
    figure.legend(
        [found[label] for label in named], named, loc="outside lower center", ncols=columns,
        fontsize=8, frameon=False, labelcolor=style.INK, columnspacing=1.4,
    )  # fmt: skip


_LEGEND_LINE, _LETTER, _HANDLE = 0.19, 0.068, 0.55
"""Height of a line, width of a letter, width of a handle with its spaces [inch], at 8 pt."""


def _columns_that_fit(labels: Sequence[str], width: float) -> int:
    """Returns the fewest columns with the fewest lines that are no wider than that [inch]."""
    for lines in range(1, len(labels)):
        columns = -(-len(labels) // lines)
        # As matplotlib fills them: one below the other, the first columns one longer.
        filled = np.array_split([len(label) for label in labels], columns)
        if sum(_LETTER * column.max() + _HANDLE for column in filled) <= width:
            return columns
    return 1
