"""Draws what the map knows in all directions from one position."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from r3jax.plots import style
from r3jax.plots.pictures import BEYOND, PanoramaPicture

_NEVER_SEEN = "#9ca3af"
"""Color of directions that meet unexplored space."""


def panorama_figure(picture: PanoramaPicture) -> Figure:
    """All directions from one position: what the map knows, and how well it would render."""
    figure = style.new_figure(10.0, 9.6)
    upper, lower = figure.subplots(2, 1)
    extent = (180.0, -180.0, -90.0, 90.0)
    for axes, title in (
        (upper, "Mean color of the voxels seen"),
        (lower, "Renderability R of the voxels seen"),
    ):
        style.dress(axes, title, "azimuth [°]", "elevation [°]").grid(visible=False)
        axes.set_xticks(range(-180, 181, 60))
        axes.set_yticks(range(-90, 91, 45))
    upper.imshow(picture.rgb, extent=extent)
    image = show_renderability(lower, picture, extent)
    bar = figure.colorbar(image, ax=[upper, lower], shrink=0.4, pad=0.01, anchor=(0.0, 0.0))
    bar.outline.set_visible(False)
    bar.set_label("renderability R", fontsize=9, color=style.MUTED)
    lower.legend(
        handles=empty_directions(), fontsize=8, frameon=False, ncols=2,
        loc="upper right", bbox_to_anchor=(1.0, -0.1),
    )  # fmt: skip
    bar.ax.tick_params(labelsize=8, colors=style.MUTED)
    for axes in (upper, lower):
        axes.plot(
            np.rad2deg(picture.azimuth),
            np.rad2deg(picture.elevation),
            marker="+",
            markersize=14,
            markeredgewidth=2.0,
            color="white" if axes is upper else style.INK,
        )
    return figure


def show_renderability(
    axes: Axes, picture: PanoramaPicture, extent: tuple[float, float, float, float] | None = None
) -> AxesImage:
    """Draws R in all directions, and the two kinds of directions without a voxel apart."""
    axes.set_facecolor(_NEVER_SEEN)
    blue = np.concatenate([np.broadcast_to(BEYOND, (*picture.beyond.shape, 3)),
                           picture.beyond[..., None]], axis=-1)  # fmt: skip
    axes.imshow(blue, extent=extent)
    return axes.imshow(picture.value, extent=extent, cmap=style.SCORE_MAP, vmin=0.0, vmax=1.0)


def empty_directions() -> list[Patch]:
    """Entries of a legend for directions without a voxel."""
    kinds = (("beyond the sensor's range", BEYOND), ("never seen", _NEVER_SEEN))
    return [Patch(facecolor=color, edgecolor=style.MUTED, label=name) for name, color in kinds]
