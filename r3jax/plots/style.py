"""The look that all figures share: light, few colors, nothing global."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Tick
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.text import Text

INK = "#1f2937"
"""Text and frames."""

MUTED = "#6b7280"
"""Secondary text, grids."""

ACCENT = "#0f766e"
"""The first curve."""

SECOND = "#d97706"
"""The second curve."""

NEVER_SEEN = "#334155"
"""What no view has shown."""

TOO_OBLIQUE = "#2563eb"
"""What was seen from other directions only."""

INCONSISTENT = "#dc2626"
"""What looked different from view to view."""

TOO_FAR = "#f59e0b"
"""What was seen from farther away only."""

CAUSE_COLORS = (NEVER_SEEN, TOO_OBLIQUE, INCONSISTENT, TOO_FAR)
"""Colors of the causes of a utility, in the order of `scoring.explain.CAUSES`."""

PATH_MAP = "plasma"
"""Colors of acquisition order."""

SCORE_MAP = "RdYlGn"
"""Colors of renderability, 0 to 1."""


def new_figure(width: float, height: float) -> Figure:
    """Makes an empty figure of that size [inch] without pyplot's global state."""
    return Figure(figsize=(width, height), dpi=110, layout="constrained", facecolor="white")


def dress(axes: Axes, title: str = "", x: str = "", y: str = "") -> Axes:
    """Gives axes the common look."""
    axes.set_title(title, fontsize=11, color=INK, loc="left", fontweight="bold")
    axes.set_xlabel(x, fontsize=9, color=MUTED)
    axes.set_ylabel(y, fontsize=9, color=MUTED)
    axes.tick_params(labelsize=8, colors=MUTED, length=3)
    axes.grid(visible=True, color="#e5e7eb", linewidth=0.8)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#9ca3af")
    return axes


def blank(axes: Axes, title: str = "") -> Axes:
    """Prepares axes for an image: no ticks, no grid."""
    dress(axes, title)
    axes.grid(visible=False)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    return axes


def picture_grid(
    lines: int, columns: int, aspect: float, space: float
) -> tuple[Figure, np.ndarray]:
    """Makes a figure 10 inches wide for images of one shape.

    Args:
        lines: of images.
        columns: of images.
        aspect: height of an image over its width.
        space: for the caption above each [inch].

    Returns:
        The figure, and its axes [lines, columns], blank.
    """
    figure = new_figure(10.0, lines * (10.0 / columns * aspect + space))
    grid = np.asarray(figure.subplots(lines, columns, squeeze=False))
    for axes in grid.flat:
        blank(axes)
    return figure, grid


def caption(axes: Axes, text: str, color: str = MUTED) -> None:
    """Writes a small line above an image."""
    axes.set_title(text, fontsize=8, color=color, loc="left", pad=2)


def color_bar(
    figure: Figure,
    image: ScalarMappable,
    axes: Axes | Sequence[Axes] | np.ndarray,
    label: str = "",
    *,
    shrink: float = 0.5,
    anchor: tuple[float, float] = (0.0, 0.5),
) -> None:
    """Draws the scale of an image beside axes."""
    bar = figure.colorbar(image, ax=axes, shrink=shrink, pad=0.01, anchor=anchor)
    bar.set_label(label, fontsize=9, color=MUTED)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, colors=MUTED)


def to_png(figure: Figure) -> bytes:
    """Encodes the figure as PNG.

    Dollar signs in names are not read as formulas; log axes use them for theirs.
    """
    numbers = {label for tick in figure.findobj(Tick) for label in (tick.label1, tick.label2)}
    for text in figure.findobj(Text):
        text.set_parse_math(text in numbers)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": "r3jax"})
    return buffer.getvalue()
