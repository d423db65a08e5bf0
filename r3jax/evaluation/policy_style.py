"""One look per policy in every figure: color, marker and line. Ours are warm and thick.

The colors are those of Okabe and Ito ("Color universal design", 2008), which people with any kind
of color vision tell apart; the floor (frontier, uniform, random) goes from ink to light grey.
Markers and dashes say the same again, for print.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from r3jax.evaluation import style

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colors of groups that are no policies."""


@dataclass(frozen=True)
class Look:
    """How one method is drawn."""

    color: str
    marker: str
    dashes: str
    """Style of the line: solid, and another for each further settings of the same policy."""

    width: float
    """Of the line [pt]."""

    order: float
    """Height in the stack of artists: ours are drawn on top."""

    def line(self) -> dict[str, Any]:
        """Arguments of `Axes.plot`."""
        return {
            "color": self.color, "marker": self.marker, "linestyle": self.dashes,
            "linewidth": self.width, "markersize": 4.5, "zorder": self.order,
        }  # fmt: skip


_POLICIES = {
    "ours-pano": ("#D55E00", "o"),
    "ours": ("#E69F00", "s"),
    "active_gs": ("#0072B2", "^"),
    "active_gamer": ("#56B4E9", "v"),
    "cover": ("#CC79A7", "D"),
    "unseen": ("#009E73", "P"),
    "frontier": (style.INK, "X"),
    "uniform": (style.MUTED, "d"),
    "random": ("#a8b0bb", "."),
}
_UNKNOWN = ("#8b5cf6", "*")
_DASHES = ("-", "--", ":", "-.")


def looks_of(methods: Sequence[str]) -> dict[str, Look]:
    """The look of each method, as `equal_terms.method_name` writes it."""
    seen: dict[str, int] = {}
    looks = {}
    for method in methods:
        policy = method.partition(" (")[0]
        color, marker = _POLICIES.get(policy, _UNKNOWN)
        variant = seen[policy] = seen.get(policy, -1) + 1
        is_ours = policy.startswith("ours")
        looks[method] = Look(
            color, marker, _DASHES[variant % len(_DASHES)], *((2.6, 4.0) if is_ours else (1.5, 3.0))
        )
    return looks


def legend_below(figure: Figure, methods: Sequence[str]) -> None:
    """One legend for all panels, below them; it takes the handles of the first panel."""
    found = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        found = dict(zip(labels, handles, strict=True)) | found
    named = [method for method in methods if method in found]
    # As wide as the figure allows at this size of letters, 0.085 inch each and 0.5 for the line.
    widest = 0.085 * max(map(len, named)) + 0.5
    columns = max(1, min(len(named), int(figure.get_figwidth() / widest)))
    figure.legend(
        [found[method] for method in named], named, loc="outside lower center", ncols=columns,
        fontsize=8, frameon=False, labelcolor=style.INK,
    )  # fmt: skip
