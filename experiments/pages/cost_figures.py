"""The figures of what planning costs: milliseconds and bytes against key frames."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from r3jax.apps.benchmark.figures import panels_of
from r3jax.apps.benchmark.policy_style import legend_below, styles_of
from r3jax.plots import style

Samples = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Per method the numbers of key frames in the map [k], and what was measured there."""


def latency_figure(latency: Samples, title: str = "") -> Figure:
    """Returns milliseconds of planning against key frames: a panel per method, all on one scale.

    Line: median; band: to the 95th percentile; dotted: 99th percentile.

    Args:
        latency: milliseconds [k, repeats] per method, NaN where there are fewer repeats.
        title: above all, such as the machine.
    """
    styles = styles_of(list(latency))
    figure, panels = panels_of(len(latency), share=True)
    for axes, (method, (frames, samples)) in zip(panels, latency.items(), strict=True):
        style.dress(axes, x="key frames", y="planning [ms]").label_outer()
        axes.set_title(method, fontsize=11, color=style.INK, loc="left", fontweight="bold", pad=16)
        p50, p95, p99 = np.nanpercentile(samples, [50, 95, 99], axis=1)
        color = styles[method].color
        band = axes.fill_between(frames, p50, p95, color=color, alpha=0.2, label="to p95")
        band.set_linewidth(0)
        axes.plot(frames, p50, color=color, linewidth=2.0, label="p50")
        axes.plot(frames, p99, color=color, linewidth=1.0, linestyle=":", label="p99")
        overall = [
            f"p{p} {value:.0f}" if value >= 100.0 else f"p{p} {value:.3g}"
            for p, value in zip((50, 95, 99), np.nanpercentile(samples, (50, 95, 99)), strict=True)
        ]
        axes.annotate(
            f"all: {', '.join(overall)} ms", (0.0, 1.0), xycoords="axes fraction", xytext=(0, 4),
            textcoords="offset points", fontsize=8, color=style.MUTED,
        )  # fmt: skip
    panels[0].set_yscale("log")
    panels[0].yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panels[0].yaxis.set_major_formatter("{x:g}")
    panels[0].yaxis.set_minor_locator(NullLocator())
    legend_below(figure, ["p50", "to p95", "p99"])
    figure.suptitle(title, fontsize=11, color=style.INK, fontweight="bold")
    return figure


def memory_figure(memory: Samples, title: str = "", limit: float | None = None) -> Figure:
    """Returns bytes that planning needs against key frames: a line per method.

    Args:
        memory: bytes [k] per method.
        title: what was measured (device memory, process memory).
        limit: bytes that must not be passed, as a line.
    """
    figure = style.new_figure(6.8, 4.0)
    axes = style.dress(figure.subplots(), title, "key frames", "memory [MB]")
    for method, look in styles_of(list(memory)).items():
        frames, used = memory[method]
        every = max(1, len(frames) // 12)  # markers, not beads
        axes.plot(frames, np.asarray(used) / 1e6, label=method, markevery=every, **look.line())
    if limit is not None:
        axes.axhline(limit / 1e6, color=style.INK, linewidth=1.0, linestyle="--")
        axes.annotate(
            f"{limit / 1e6:g} MB", (0.01, limit / 1e6), xycoords=("axes fraction", "data"),
            xytext=(0, 3), textcoords="offset points", fontsize=8, color=style.INK,
        )  # fmt: skip
    axes.set_ylim(0.0, 1.08 * axes.get_ylim()[1])
    legend_below(figure, list(memory))
    return figure
