"""The forecast along a run, as a figure and in words."""

import numpy as np
from matplotlib.figure import Figure

from r3jax.apps.forecast.outlook import Outlook
from r3jax.apps.report import style

LEVEL = 0.8
"""Of the intervals."""

_SHOWN = (("mean", "mean of all views"), ("p10", "all but the worst tenth"))


def outlook_figure(outlook: Outlook) -> Figure:
    """Mean and p10 of the PSNR of free-space views against the views taken, with intervals."""
    figure = style.new_figure(10.0, 3.6)
    axes = figure.subplots()
    style.dress(
        axes, "Forecast of a model trained on the views so far", "views", "PSNR of free views [dB]"
    )
    for (name, label), color in zip(_SHOWN, (style.ACCENT, style.SECOND), strict=True):
        values = np.array([forecast.value(name) for forecast in outlook.forecasts])
        bounds = np.array([forecast.interval(name, LEVEL) for forecast in outlook.forecasts])
        axes.fill_between(outlook.views, *bounds.T, color=color, alpha=0.15, linewidth=0)
        axes.plot(outlook.views, values, color=color, marker="o", markersize=4, label=label)
    axes.legend(fontsize=9, frameon=False, loc="lower right")
    return figure


def outlook_lines(outlook: Outlook) -> list[str]:
    """The forecast after the last view, and what one more decibel would take, a line each."""
    last = outlook.forecasts[-1]
    if not last.mixture.size:
        return ["No view of free space can be named yet, so nothing is forecast."]
    lines: list[str] = []
    for name, label in _SHOWN:
        low, high = last.interval(name, LEVEL)
        line = f"{label} ({name}): {last.value(name):.1f} dB ({low:.1f} to {high:.1f})"
        more = outlook.more_views(name)
        if more is not None:
            line += f"; about {more} more views for +1 dB, as things went"
        elif len(outlook.forecasts) > 1:
            line += "; the last views added next to nothing to it"
        lines.append(line)
    return lines
