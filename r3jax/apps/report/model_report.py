"""The part of a run's report about the model trained on it."""

import csv
import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r3jax.plots import style
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, check_type, parse_json, unsealed

_TITLES = {
    "psnr": ("PSNR [dB]", 2),
    "psnr_measured": ("PSNR without holes [dB]", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
}
_TAIL = {"lpips": " (95th)"}
"""The percentile of the worst views, if it is not the fifth."""

_MAX_BYTES = 64 << 20

_KINDS = {
    "model": str,
    "metrics": dict[str, dict[str, Any]],
    "numbers": list[int],
    "trained_on": int | None,
    **dict.fromkeys(("gaussians", "width", "height"), int),
}
"""The fields used of evaluation.json."""

_PARTS = {
    **dict.fromkeys(("mean", "median", "percentile_5", "worst"), float),
    "interval": list[float],
    "worst_view": int,
    "poor_share": float | None,
}
"""The fields used of one metric."""

_COLUMNS = ("step", "loss", "psnr", "gaussians")
"""Columns of history.csv."""

_LARGEST = 1e12
"""Limit of the axes of figures."""

_SMOOTHING = 50
"""Steps over which the curves are averaged: single views differ by many dB."""


@dataclass(frozen=True)
class EvaluatedModel:
    """The newest evaluation of a model of a run, as stored on disk."""

    evaluation: dict[str, Any]
    """evaluation.json."""

    history: dict[str, np.ndarray]
    """Columns of history.csv: step, loss, psnr, gaussians; empty if there is none."""

    sheet: bytes | None
    """The contact sheet of the worst views, PNG."""


def read_evaluated_model(run: Run) -> EvaluatedModel | None:
    """Reads the newest evaluation of the run; returns None if there is none.

    Raises:
        RunError: the files are damaged.
    """
    path = run.path / "report" / "evaluation.json"
    if not path.exists():
        return None
    try:
        evaluation = parse_json(read_bytes(path, _MAX_BYTES))
        check_type("evaluation", evaluation, dict[str, Any])
        evaluation = unsealed(evaluation)
        _check(evaluation)
        curve = Path(evaluation["model"]).parent / "history.csv"
        history = _read_columns(curve) if curve.exists() else {}
        sheet = path.with_suffix(".png")
        image = read_bytes(sheet, _MAX_BYTES) if sheet.exists() else None
        if image is not None:
            _check_hash(sheet, image, evaluation.get("sheet_sha256"))
    except (OSError, ValueError, csv.Error) as error:
        raise RunError(
            path, f"the evaluation cannot be read ({error!s:.300}): evaluate again"
        ) from None
    return EvaluatedModel(evaluation, history, image)


def _check(evaluation: Any) -> None:
    """Refuses fields that the table or the note could not show.

    Raises:
        ForeignFileError: says what is missing or of another type.
    """
    check_fields("evaluation", evaluation, _KINDS)
    for name, metric in evaluation["metrics"].items():
        check_fields(name, metric, _PARTS)
        if len(metric["interval"]) != 2:
            raise ForeignFileError(f"`{name}.interval` must be two numbers")


def _read_columns(path: Path) -> dict[str, np.ndarray]:
    """Reads history.csv by column; returns an empty dict if it has no rows.

    Raises:
        ValueError, csv.Error: not a table, or not with these columns.
        OSError: it cannot be read.
    """
    data = read_bytes(path, _MAX_BYTES)
    beside = path.with_name("train.json")
    if beside.exists():
        training = parse_json(read_bytes(beside, _MAX_BYTES))
        check_type("train.json", training, dict[str, Any])
        _check_hash(path, data, unsealed(training).get("history_sha256"))
    text = data.decode("utf-8")
    rows = list(csv.DictReader(io.StringIO(text)))
    try:
        columns = {name: np.array([float(row[name]) for row in rows]) for name in _COLUMNS}
    except (KeyError, TypeError):
        raise ForeignFileError(f"{path} must have the columns {', '.join(_COLUMNS)}") from None
    if not all((np.abs(column) <= _LARGEST).all() for column in columns.values()):
        raise ForeignFileError(f"{path} contains a value that is not finite, or far out of range")
    return columns if rows else {}


def _check_hash(path: Path, data: bytes, sha256: str | None) -> None:
    """Refuses a file that does not match its stored hash; earlier versions stored none.

    Raises:
        ForeignFileError: says which.
    """
    if sha256 not in (None, hashlib.sha256(data).hexdigest()):
        raise ForeignFileError(f"{path} is damaged: it does not match its stored SHA-256")


def training_figure(history: dict[str, np.ndarray]) -> Figure:
    """Draws the PSNR of the training views and the number of Gaussians against steps."""
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


def quality_rows(evaluation: dict[str, Any]) -> list[list[str]]:
    """Makes the table of metrics.

    A row holds the name, mean, interval, median, tail, worst view and share of poor views.
    """
    rows: list[list[str]] = []
    for name, metric in evaluation["metrics"].items():
        title, digits = _TITLES.get(name, (name, 3))
        low, high = metric["interval"]
        poor = metric["poor_share"]
        rows.append([
            title,
            f"{metric['mean']:.{digits}f}",
            f"{low:.{digits}f} – {high:.{digits}f}",
            f"{metric['median']:.{digits}f}",
            f"{metric['percentile_5']:.{digits}f}{_TAIL.get(name, '')}",
            f"{metric['worst']:.{digits}f} (frame {metric['worst_view']})",
            "" if poor is None else f"{100 * poor:.0f} %",
        ])  # fmt: skip
    return rows


def quality_note(evaluation: dict[str, Any]) -> str:
    """Explains how the numbers were computed, in a sentence or two."""
    trained_on = evaluation.get("trained_on")
    count = len(evaluation["numbers"])
    if trained_on == 0:
        which = f"{count} views that the model was not trained on"
    elif trained_on is None:
        which = f"{count} views (not known whether the model was trained on them)"
    else:
        which = f"{count} views, {trained_on} of which the model was trained on"
    return (
        f"{evaluation['gaussians']} Gaussians, evaluated by {which}, at "
        f"{evaluation['width']}x{evaluation['height']} px. Black is what no training view saw."
    )
