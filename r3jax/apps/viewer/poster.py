"""The page on which a picture of the map stands: what it shows, the view, numbers, a scale.

Shape symbols: H W picture size.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from r3jax.apps.viewer.colors import SCORES, UNSEEN, paint
from r3jax.apps.viewer.known import title_of
from r3jax.apps.viewer.pictures import fitted, font
from r3jax.trace.reader import Run

_INK, _MUTED, _PAPER = (31, 41, 55), (107, 114, 128), (255, 255, 255)
_LINE, _ACCENT, _NOW = (229, 231, 235), (15, 118, 110), (220, 38, 38)
_COLUMN = 320
"""Width of the column of facts [px]."""

_EDGE = 20
"""Empty space round the column [px]."""

_TITLES = {
    "renderability": "Renderability R, mean over places that see the voxel",
    "bias": "Angle term b: how near to a direction it was seen from",
    "noise": "Consistency term: do its colors agree?",
    "resolution": "Resolution term: was it seen from close enough?",
    "color": "Mean color of the voxels",
}


@dataclass(frozen=True)
class Sheet:
    """What stands beside a picture."""

    title: str
    """Policy and scene."""

    subtitle: str
    """What the colors mean."""

    image: np.ndarray
    """The view that was taken, [H, W, 3] uint8."""

    facts: tuple[tuple[str, str], ...]
    """Names and values."""

    curve: np.ndarray
    """Mean renderability after each view so far, in [0, 1]."""

    num_views: int
    """Of the whole run: where the curve will end."""

    has_scale: bool
    """Whether the colors are those of a score."""

    @staticmethod
    def scene_width(width: int) -> int:
        """What is left for the picture beside the column [px]."""
        return width - _COLUMN

    @staticmethod
    def of_run(run: Run, step: int, image: np.ndarray, quantity: str) -> "Sheet":
        """The sheet of a view of a run.

        Args:
            run: the run.
            step: the view.
            image: its image, [H, W, 3] uint8.
            quantity: what the colors show, one of `blocks.QUANTITIES`.
        """
        row = run.rows[step]
        facts = (
            ("view", f"{step + 1} of {len(run.rows)}"),
            ("mission clock", f"{row.seconds:.1f} s"),
            ("path", f"{row.metres:.1f} m"),
            ("explored", f"{100 * row.coverage.known_share:.0f} %"),
            ("mean renderability", f"{row.coverage.mean_renderability:.2f}"),
            ("R of this view before it", f"{row.coverage.arrival_renderability:.2f}"),
        )
        curve = [r.coverage.mean_renderability for r in run.rows[: step + 1]]
        return Sheet(
            title=title_of(run.header),
            subtitle=_TITLES[quantity],
            image=image,
            facts=facts,
            curve=np.asarray(curve),
            num_views=len(run.rows),
            has_scale=quantity != "color",
        )


def compose(picture: np.ndarray, sheet: Sheet) -> np.ndarray:
    """The picture with its sheet at the right, [H, W + 320, 3] uint8."""
    height, width = picture.shape[:2]
    canvas = Image.new("RGB", (width + _COLUMN, height), _PAPER)
    canvas.paste(Image.fromarray(np.ascontiguousarray(picture)), (0, 0))
    pen = ImageDraw.Draw(canvas)
    pen.text((_EDGE, 14), _cut(sheet.title, 60), fill=_INK, font=font(24))
    pen.text((_EDGE, 46), sheet.subtitle, fill=_MUTED, font=font(16))
    if sheet.has_scale:
        _scale(canvas, pen, _EDGE, height - 48)
    left, side = width, _COLUMN - _EDGE
    canvas.paste(Image.fromarray(fitted(sheet.image, side, side, is_photo=True)), (left, _EDGE))
    top = _EDGE + side + 16
    for name, value in sheet.facts:
        pen.text((left, top), name, fill=_MUTED, font=font(16))
        pen.text((left + side, top), value, fill=_INK, font=font(16), anchor="ra")
        top += 25
    _curve(pen, sheet, (left, top + 34, left + side - 6, height - 30))
    return np.asarray(canvas)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def _scale(canvas: Image.Image, pen: ImageDraw.ImageDraw, left: int, top: int) -> None:
    """The colors from 0 to 1, and that of what no place sees."""
    colors = np.repeat(paint(np.linspace(0.0, 1.0, 220), SCORES)[None], 12, axis=0)
    canvas.paste(Image.fromarray(colors), (left, top))
    for share, word, anchor in ((0.0, "0", "la"), (0.5, "0.5", "ma"), (1.0, "1", "ra")):
        pen.text((left + 220 * share, top + 15), word, fill=_MUTED, font=font(14), anchor=anchor)
    pen.rectangle([left + 250, top, left + 262, top + 11], fill=UNSEEN)
    pen.text((left + 270, top - 3), "seen from none of the places", fill=_MUTED, font=font(14))


def _curve(pen: ImageDraw.ImageDraw, sheet: Sheet, box: tuple[int, int, int, int]) -> None:
    """Mean renderability over the views, its axis from 0 to 1."""
    left, top, right, bottom = box
    pen.text((left, top - 26), "mean renderability over views", fill=_MUTED, font=font(14))
    for share in (0.0, 0.5, 1.0):
        y = bottom + (top - bottom) * share
        pen.line([(left, y), (right, y)], fill=_LINE)
    x = left + (right - left) * np.arange(len(sheet.curve)) / max(sheet.num_views - 1, 1)
    y = bottom + (top - bottom) * sheet.curve.clip(0.0, 1.0)
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    if len(points) > 1:
        pen.line(points, fill=_ACCENT, width=3, joint="curve")
    u, v = points[-1]
    pen.ellipse([u - 5, v - 5, u + 5, v + 5], fill=_NOW)
