"""What the report of a run says about the model that was trained on it."""

import csv
import html
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r3jax.evaluation import style
from r3jax.trace.errors import RunError
from r3jax.trace.reader import Run

_TITLES = {
    "psnr": ("PSNR [dB]", 2),
    "psnr_measured": ("PSNR without holes [dB]", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
}
_SMOOTHING = 50
"""Steps over which the curves are averaged: single views differ by many dB."""


@dataclass(frozen=True)
class JudgedModel:
    """The newest evaluation of a model of a run, as it lies on disk."""

    evaluation: dict[str, Any]
    """evaluation.json."""

    history: dict[str, np.ndarray]
    """Columns of history.csv: step, loss, psnr, gaussians; empty if there is none."""

    sheet: bytes | None
    """The contact sheet of the worst views, PNG."""


def read_judged_model(run: Run) -> JudgedModel | None:
    """The newest evaluation of the run; None if there is none.

    Raises:
        RunError: the files are damaged.
    """
    path = run.path / "report" / "evaluation.json"
    if not path.exists():
        return None
    try:
        evaluation = json.loads(path.read_text(encoding="utf-8"))
        curve = Path(evaluation["model"]).parent / "history.csv"
        history = _read_columns(curve) if curve.exists() else {}
        sheet = path.with_suffix(".png")
        return JudgedModel(evaluation, history, sheet.read_bytes() if sheet.exists() else None)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(path, f"the evaluation cannot be read ({error}): evaluate again") from None


def _read_columns(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = rows[0].keys() if rows else []
    return {name: np.array([float(row[name]) for row in rows]) for name in names}


def training_figure(history: dict[str, np.ndarray]) -> Figure:
    """PSNR of the training views and number of Gaussians, against steps."""
    figure = style.new_figure(10.0, 2.9)
    left, right = figure.subplots(1, 2)
    step, psnr = history["step"], history["psnr"]
    width = min(_SMOOTHING, len(step))
    smooth = np.convolve(psnr, np.full(width, 1.0 / width), mode="valid")
    style.dress(left, "PSNR of the training views", "step", "dB")
    left.plot(step, psnr, color=style.MUTED, linewidth=0.4, alpha=0.5)
    left.plot(step[width - 1 :], smooth, color=style.ACCENT, linewidth=2.0)
    style.dress(right, "Gaussians", "step")
    right.plot(step, history["gaussians"], color=style.SECOND, linewidth=2.0)
    right.set_ylim(0.0, 1.1 * history["gaussians"].max())
    return figure


def quality_table(evaluation: dict[str, Any]) -> str:
    """The metrics as an HTML table."""
    head = "".join(
        f'<th class="n">{title}</th>'
        for title in ("mean", "95 % interval", "median", "5th percentile", "worst", "&lt; 20 dB")
    )
    rows = []
    for name, metric in evaluation["metrics"].items():
        title, digits = _TITLES.get(name, (name, 3))
        low, high = metric["interval"]
        poor = metric["poor_share"]
        cells = [
            f"{metric['mean']:.{digits}f}",
            f"{low:.{digits}f} – {high:.{digits}f}",
            f"{metric['median']:.{digits}f}",
            f"{metric['percentile_5']:.{digits}f}",
            f"{metric['worst']:.{digits}f} (view {metric['worst_view']})",
            "" if poor is None else f"{100 * poor:.0f} %",
        ]
        rows.append(
            f"<tr><td>{html.escape(title)}</td>"
            + "".join(f'<td class="n">{cell}</td>' for cell in cells)
            + "</tr>"
        )
    return f"<table><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def quality_note(evaluation: dict[str, Any]) -> str:
    """How the numbers came about, in a sentence or two."""
    trained_on = evaluation.get("trained_on")
    count = len(evaluation["numbers"])
    if trained_on == 0:
        which = f"{count} views that the model was not trained on"
    elif trained_on is None:
        which = f"{count} views; it is not known whether the model was trained on them"
    else:
        which = f"{count} views, {trained_on} of which the model was trained on"
    return (
        f"{evaluation['gaussians']} Gaussians, judged by {which}, at "
        f"{evaluation['width']}x{evaluation['height']} px. Black is what no training view saw."
    )
