"""A contact sheet of the worst test views: truth, render, error, renderability."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from r3jax.errors import InputError
from r3jax.evaluation.scores import ViewRow
from r3jax.plots import style
from r3jax.plots.pictures import BEYOND

ERROR_SCALE = 0.3
"""Mean absolute error over RGB at which the color of the error image saturates. Fixed, so that
sheets can be compared."""

_ERROR_MAP = "magma"
_NOTHING = "#d1d5db"
_SCALES = {
    # Two lines: each has the width of an image.
    "error": f"mean |error| over RGB,\nsaturates at {ERROR_SCALE:g}",
    "renderability": "R of the voxel seen (gray:\nnever seen, blue: out of range)",
}
_MARGIN, _LINE, _HEADING, _CAPTION, _CELL, _GAP, _BAR, _BAR_TEXT = (
    0.1, 0.2, 0.25, 0.95, 2.1, 0.06, 0.07, 0.55
)  # fmt: skip
"""Margin, line of the title, headings of the columns, width of the captions, width of an image,
space between images, height of a color bar and of the text below it [inch]."""


@dataclass(frozen=True)
class SheetView:
    """One line of the sheet."""

    row: ViewRow
    """The view's numbers."""

    truth: np.ndarray
    """[H, W, 3] uint8."""

    render: np.ndarray
    """[H, W, 3] uint8."""

    renderability: np.ndarray | None = None
    """R of the voxel in each pixel, [h, w] in [0, 1] of any resolution; None without a map."""

    beyond: np.ndarray | None = None
    """True where the sensor found nothing within its range, [H, W] of any resolution; None: not
    known."""


def error_picture(truth: np.ndarray, render: np.ndarray) -> np.ndarray:
    """Computes the mean absolute error of two uint8 images over RGB, [H, W] in [0, 1]."""
    return np.abs(truth.astype(np.float32) - render.astype(np.float32)).mean(axis=-1) / 255.0


def contact_sheet(views: Sequence[SheetView], title: str) -> Figure:
    """Draws one line per view: truth, render, error and (with a map) renderability.

    Args:
        views: in the order of the lines, usually the worst first (`scores.worst_rows`).
        title: what was evaluated, in a line or two.

    Raises:
        ValueError: there are no views.
    """
    if not views:
        raise InputError("a contact sheet needs at least one view")
    has_map = any(view.renderability is not None for view in views)
    titles = ["ground truth", "render", "error"] + ["renderability"] * has_map
    height, width = views[0].truth.shape[:2]
    cell, top = _CELL * height / width, _MARGIN + _LINE * (1 + title.count("\n")) + _HEADING
    size = (
        _MARGIN + _CAPTION + (_CELL + _GAP) * len(titles) + _MARGIN,
        top + (cell + _GAP) * len(views) + _BAR + _BAR_TEXT,
    )
    figure = style.new_figure(*size)
    figure.set_layout_engine("none")  # images of one size, with the same space between all

    def place(line: int, column: int, height: float = cell, inset: float = 0.0) -> Axes:
        """Adds axes for an image, or for the bar below the last one."""
        left = _MARGIN + _CAPTION + (_CELL + _GAP) * column + inset
        lower = size[1] - top - (cell + _GAP) * line - height
        wide = _CELL - 2.0 * inset
        box = (left / size[0], lower / size[1], wide / size[0], height / size[1])
        return style.blank(figure.add_axes(box))

    figure.text(
        _MARGIN / size[0], 1.0 - _MARGIN / size[1], title, va="top", fontsize=10, color=style.INK,
        fontweight="bold", linespacing=1.3,
    )  # fmt: skip
    drawn = [
        _draw_line([place(i, column) for column in range(len(titles))], view)
        for i, view in enumerate(views)
    ]
    for column, (name, picture) in enumerate(zip(titles, drawn[0], strict=True)):
        picture.axes.set_title(name, fontsize=9, color=style.MUTED, loc="left", pad=3)
        if name in _SCALES:
            # Narrower than the images, so that the numbers at the ends do not meet.
            _color_bar(figure, picture, place(len(views), column, _BAR, 0.12), _SCALES[name])
    return figure


def _draw_line(axes: list[Axes], view: SheetView) -> list[AxesImage]:
    """Draws one view; returns its images."""
    left = axes[0]
    left.annotate(
        _caption(view.row), (0.0, 1.0), xycoords="axes fraction", xytext=(-72.0 * _CAPTION, 0.0),
        textcoords="offset points", va="top", fontsize=8, linespacing=1.45, color=style.INK,
    )  # fmt: skip
    error = error_picture(view.truth, view.render)
    pictures = [
        axes[0].imshow(view.truth, interpolation="nearest"),
        axes[1].imshow(view.render, interpolation="nearest"),
        axes[2].imshow(error, cmap=_ERROR_MAP, vmin=0.0, vmax=ERROR_SCALE, interpolation="nearest"),
    ]
    if len(axes) == 3:
        return pictures
    return [*pictures, _draw_renderability(axes[3], view)]


def _draw_renderability(axes: Axes, view: SheetView) -> AxesImage:
    """Draws R of a view over what lies beyond the sensor's range, and over what was never seen."""
    height, width = view.truth.shape[:2]
    whole = (0, width, height, 0)
    axes.set_facecolor(_NOTHING)
    if view.beyond is not None:
        blue = np.zeros((*view.beyond.shape, 4))
        blue[view.beyond] = (*BEYOND, 1.0)
        axes.imshow(blue, interpolation="nearest", extent=whole)
    known = np.zeros((1, 1)) if view.renderability is None else view.renderability
    return axes.imshow(
        np.where(known > 0.0, known, np.nan),
        cmap=style.SCORE_MAP,
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest",
        extent=whole,
    )


def _caption(row: ViewRow) -> str:
    lines = [f"frame {row.view}", f"PSNR {row.psnr:.1f} dB", f"SSIM {row.ssim:.3f}"]
    if row.lpips is not None:
        lines.append(f"LPIPS {row.lpips:.3f}")
    if row.renderability is not None:
        lines.append(f"R {row.renderability:.2f}")
    lines.append(f"coverage {100 * row.coverage:.0f} %")
    return "\n".join(lines)


def _color_bar(figure: Figure, image: AxesImage, axes: Axes, label: str) -> None:
    """Draws a bar below a column of images."""
    bar = figure.colorbar(image, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_ticks(list(np.linspace(*image.get_clim(), 3)))
    bar.set_label(label, fontsize=7, color=style.MUTED)
    axes.tick_params(labelsize=7, colors=style.MUTED, length=2)
