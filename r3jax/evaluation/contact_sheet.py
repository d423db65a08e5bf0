"""The worst test views at a glance: truth, render, where they differ, what the map expected."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from r3jax.evaluation import style
from r3jax.evaluation.scores import ViewRow

ERROR_SCALE = 0.5
"""Mean absolute error over RGB at which the colour of the error picture saturates. Fixed, so that
sheets can be compared."""

_ERROR_MAP = "magma"
_CELL, _CAPTION, _BAR = 2.1, 1.15, 0.75
"""Width of a picture, of the column of captions, and height of the colour bars [inch]."""


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
    """R of what each pixel sees, [h, w] in [0, 1] of any resolution; None without a map."""


def error_picture(truth: np.ndarray, render: np.ndarray) -> np.ndarray:
    """Mean absolute error over RGB per pixel, [H, W] in [0, 1], of two uint8 images."""
    return np.abs(truth.astype(np.float32) - render.astype(np.float32)).mean(axis=-1) / 255.0


def contact_sheet(views: Sequence[SheetView], title: str) -> Figure:
    """One line per view: truth, render, error and (with a map) renderability.

    Args:
        views: in the order of the lines, usually the worst first (`scores.worst_rows`).
        title: what was judged, in a line or two.

    Raises:
        ValueError: there are no views.
    """
    if not views:
        raise ValueError("a contact sheet needs at least one view")
    has_map = any(view.renderability is not None for view in views)
    titles = ["ground truth", "render", "error"] + ["renderability"] * has_map
    height, width = views[0].truth.shape[:2]
    line = _CELL * height / width
    lines = 1 + title.count("\n")
    figure = style.new_figure(
        _CAPTION + _CELL * len(titles), 0.3 * lines + 0.2 + line * len(views) + _BAR
    )
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color=style.INK, fontweight="bold")
    ratios = [_CAPTION / _CELL] + [1.0] * len(titles)
    grid = figure.subplots(len(views), 1 + len(titles), squeeze=False, width_ratios=ratios)
    for axes, name in zip(grid[0, 1:], titles, strict=True):
        axes.set_title(name, fontsize=9, color=style.MUTED, loc="left", pad=3)
    for axes, view in zip(grid, views, strict=True):
        error, score = _draw_line(axes, view)
    _color_bar(figure, error, grid[:, 3], f"mean |error| over RGB (saturates at {ERROR_SCALE:g})")
    if score is not None:
        _color_bar(figure, score, grid[:, 4], "R (0: unseen)")
    return figure


def _draw_line(axes: np.ndarray, view: SheetView) -> tuple[AxesImage, AxesImage | None]:
    """Draws one view; returns its two colour-mapped pictures."""
    for one in axes:
        _bare(one)
    axes[0].text(0.0, 1.0, _caption(view.row), transform=axes[0].transAxes, va="top", fontsize=8.5,
                 color=style.INK, linespacing=1.45)  # fmt: skip
    axes[1].imshow(view.truth, interpolation="nearest")
    axes[2].imshow(view.render, interpolation="nearest")
    error = axes[3].imshow(
        error_picture(view.truth, view.render),
        cmap=_ERROR_MAP,
        vmin=0.0,
        vmax=ERROR_SCALE,
        interpolation="nearest",
    )
    if len(axes) < 5:
        return error, None
    height, width = view.truth.shape[:2]
    nothing = np.full((height, width), np.nan)
    score = axes[4].imshow(
        nothing if view.renderability is None else view.renderability,
        cmap=style.SCORE_MAP,
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest",
        extent=(0, width, height, 0),
    )
    return error, score


def _caption(row: ViewRow) -> str:
    lines = [f"view {row.view}", f"PSNR {row.psnr:.1f} dB", f"SSIM {row.ssim:.3f}"]
    if row.lpips is not None:
        lines.append(f"LPIPS {row.lpips:.3f}")
    if row.renderability is not None:
        lines.append(f"R {row.renderability:.2f}")
    lines.append(f"filled {100 * row.coverage:.0f} %")
    return "\n".join(lines)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _color_bar(figure: Figure, image: AxesImage, axes: np.ndarray, label: str) -> None:
    """A bar below a column of pictures."""
    bar = figure.colorbar(
        image, ax=list(axes), location="bottom", fraction=0.05, pad=0.01, aspect=22
    )  # pyright: ignore[reportArgumentType]
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    bar.set_label(label, fontsize=7.5, color=style.MUTED)
    bar.ax.tick_params(labelsize=7.5, colors=style.MUTED, length=2)
