"""Where the camera was, and when: degenerate behavior (circling, staying) is seen at a glance."""

from collections.abc import Mapping

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from r3jax.plots import style

_PANELS_PER_LINE = 4


def positions_figure(
    positions: Mapping[str, np.ndarray],
    box: tuple[np.ndarray, np.ndarray] | None = None,
    title: str = "",
) -> Figure:
    """Camera positions in 3D, one panel per method, colored by the order of acquisition.

    All panels share the box, the camera and the scale of colors; a thin line joins consecutive
    views, and gray dots are the positions' shadows on the floor.

    Args:
        positions: per method the camera centers in the order they were taken, [n, 3] in m.
        box: lower and upper corner of the scene, [3] each in m; None: that of all positions.
        title: above all, such as the scene.

    Raises:
        ValueError: no method, or positions of another shape.
    """
    for method, found in positions.items():
        if found.ndim != 2 or found.shape[1] != 3 or not len(found):
            raise ValueError(f"{method}: positions must be [n, 3], n >= 1, got {found.shape}")
    if not positions:
        raise ValueError("there are no positions to draw")
    low, high = _box(positions, box)
    scale = Normalize(1, max(2, *(len(found) for found in positions.values())))
    columns = min(len(positions), _PANELS_PER_LINE)
    lines = -(-len(positions) // columns)
    figure = style.new_figure(max(4.6, 3.2 * columns + 0.8), 2.7 * lines + 0.4)
    panels: list[Axes3D] = []
    for i, (method, found) in enumerate(positions.items()):
        axes = figure.add_subplot(lines, columns, i + 1, projection="3d")
        panels.append(axes)
        axes.plot(*found.T, color="#9ca3af", linewidth=0.6, zorder=1)
        floor = float(low[2])
        axes.plot(*found[:, :2].T, floor, ".", color="#d1d5db", markersize=3, zorder=0)
        axes.scatter(
            *found.T, c=np.arange(1, len(found) + 1), cmap=style.PATH_MAP, norm=scale, s=18,
            depthshade=False, edgecolors="white", linewidths=0.3,
        )  # fmt: skip
        for name, start, end in zip("xyz", low, high, strict=True):
            getattr(axes, f"set_{name}lim")(start, end)
            axis = getattr(axes, f"{name}axis")
            if name != "z":  # its label would stand in the next panel
                axis.set_label_text(f"{name} [m]", fontsize=7, color=style.MUTED)
                axis.labelpad = -8
            axis.set_tick_params(labelsize=7, colors=style.MUTED, pad=-3)
            axis.set_major_locator(MaxNLocator(3 if name == "z" else 5, steps=[1, 2, 5, 10]))
            axis.set_pane_color("#f9fafb")
        axes.set_box_aspect(high - low, zoom=1.1)  # pyright: ignore[reportArgumentType]
        axes.set_title(method, fontsize=10, color=style.INK, fontweight="bold", pad=-4)
        axes.view_init(elev=32, azim=-60)
    bar = figure.colorbar(
        ScalarMappable(scale, style.PATH_MAP), ax=panels, shrink=0.6, pad=0.04, aspect=30
    )
    bar.set_label("order of acquisition", fontsize=9, color=style.MUTED)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, colors=style.MUTED)
    figure.suptitle(title, fontsize=11, color=style.INK, fontweight="bold")
    return figure


def _box(
    positions: Mapping[str, np.ndarray], box: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corner; no side is shorter than a fifth of the longest."""
    everywhere = np.concatenate(list(positions.values()))
    low, high = (everywhere.min(axis=0), everywhere.max(axis=0)) if box is None else box
    size = np.maximum(high - low, max(0.2 * float(np.max(high - low)), 0.1))
    middle = (low + high) / 2.0
    return middle - size / 2.0, middle + size / 2.0
