"""What a planner was after, view by view: the utility of its decisions, divided among causes."""

from collections.abc import Iterable

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from r3jax.exploration.explain_run import explain_run
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.scoring.explain import CAUSES
from r3jax.trace.reader import Run

COLORS = (style.NEVER_SEEN, style.TOO_OBLIQUE, style.INCONSISTENT, style.TOO_FAR)
"""Colors of the causes, in the order of `CAUSES`."""

_MANY = 60
"""From so many views on their bars touch: gaps would be narrower than a pixel."""


def utility_by_cause(
    run: Run, states: Iterable[tuple[MapState, OccupancyGrid]] | None = None
) -> np.ndarray:
    """What each view of a run promised when it was chosen, by cause.

    Args:
        run: the run.
        states: as `explain_run` takes them.

    Returns:
        [views, 4] float64, in the order of `CAUSES`; NaN for views that nobody chose.

    Raises:
        RunError: as `explain_run`.
    """
    unknown = np.full(len(CAUSES), np.nan)
    rows = [unknown if reason is None else reason.totals for reason in explain_run(run, states)]
    return np.stack(rows) if rows else np.zeros((0, len(CAUSES)))


def shares_of(utility: np.ndarray) -> np.ndarray:
    """Shares of each view's utility, [views, 4]; 0 where it promised nothing, NaN where unknown."""
    total = utility.sum(axis=1, keepdims=True)
    return np.where(total == 0.0, 0.0, utility / np.where(total == 0.0, 1.0, total))


def reasons_figure(utility: np.ndarray) -> Figure:
    """The utility of each chosen view by cause: shares, and below how much on a logarithmic axis.

    Where much is unexplored, that hides the other causes in the shares.

    Args:
        utility: by view and cause, [views, 4]; NaN for views that nobody chose.
    """
    figure = style.new_figure(10.0, 5.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.6, 1.0])
    views = np.arange(1, len(utility) + 1)
    percent = 100.0 * np.nan_to_num(shares_of(utility))
    width = 1.0 if len(views) >= _MANY else 0.86
    style.dress(upper, "What each view was chosen for", y="share of its utility [%]")
    base = np.zeros(len(views))
    for name, color, height in zip(CAUSES, COLORS, percent.T, strict=True):
        upper.bar(views, height, width, bottom=base, color=color, label=name, linewidth=0)
        base = base + height
    upper.set_ylim(0.0, 100.0)
    upper.grid(visible=False)
    figure.legend(
        *upper.get_legend_handles_labels(), fontsize=9, frameon=False, ncols=4,
        loc="outside lower center",
    )  # fmt: skip
    style.dress(lower, "What it promised", "views", "part of its utility U")
    lower.set_yscale("log")
    for color, amount in zip(COLORS, np.where(utility > 0.0, utility, np.nan).T, strict=True):
        lower.plot(views, amount, color=color, linewidth=1.6, marker="o", markersize=2.5)
    lower.set_xlim(0.4, len(views) + 0.6)
    lower.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure
