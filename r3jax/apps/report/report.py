"""The report of a run, and of the model trained on it: PNG figures and one HTML page."""

import csv
import hashlib
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from r3jax.apps.forecast.forecast import Outlook
from r3jax.apps.report import figures
from r3jax.apps.report.figures import (
    outlook_figure,
    outlook_lines,
    reasons_figure,
    utility_by_cause,
)
from r3jax.apps.report.summary import outcome, stage_times, summary
from r3jax.files import make_folder, own_folder, write_atomic
from r3jax.planning.planner import Planner
from r3jax.plots import style
from r3jax.plots.page import render
from r3jax.plots.pictures import panorama_figure, panorama_picture
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run
from r3jax.runs.replay import states_of
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, check_type, parse_json, unsealed


@dataclass(frozen=True)
class EvaluatedModel:
    """The newest evaluation of a model of a run, as stored on disk."""

    evaluation: dict[str, Any]
    """evaluation.json."""

    history: dict[str, np.ndarray]
    """Columns of history.csv: step, loss, psnr, gaussians; empty if there is none."""

    sheet: bytes | None
    """The contact sheet of the worst views, PNG."""


HINTS = {
    "PSNR of test views": "Peak signal-to-noise ratio of renders against images that were not "
    "trained on; higher is better, 25 dB is good for a place.",
    "mean renderability": "How well images from fixed probe views in the free space could be "
    "rendered from the frames so far: 0 not at all, 1 perfectly.",
    "explored": "Cells of the scene's box that are known to be free or occupied. The insides of "
    "walls cannot be seen, so 100 % is out of reach.",
    "views": "Views that the policy chose, the start included.",
    "views + frames while moving": "Views that the policy chose, the start included, and frames "
    "captured on the paths between them.",
    "path": "Length of the path of the camera.",
    "mission clock": "Time of a real mission: planning, mapping and moving count; the simulator "
    "and the disk do not.",
    "PSNR": "Peak signal-to-noise ratio [dB]: higher is better.",
    "SSIM": "Structural similarity, at most 1: higher is better.",
    "LPIPS": "Learned perceptual distance from 0: lower is better.",
    "mean": "Mean over the test views.",
    "95 % interval": "Bootstrap interval of the mean over the test views.",
    "median": "Half of the test views are better.",
    "5th percentile": "5 % of the test views are worse (of LPIPS: the 95th percentile).",
    "worst": "The worst test view, and its number.",
    "< 20 dB": "Share of test views with a PSNR under 20 dB: visibly broken.",
    "p50": "Median over the steps of the run.",
    "p95": "95 % of the steps took less.",
    "total": "Sum over the run.",
    "budget": "Limit at which the run ends.",
    "seed": "Random seed of the run.",
    "mission": "Time on the mission clock, see above.",
    "map": "Voxels with at least one measurement, and the memory of their table.",
    "dropped observations": "Measurements that did not fit into the map; 0 is as it should be.",
}
"""Tooltips of the numbers on the page."""

T = TypeVar("T")

Progress = Callable[[str, int], None]
"""Called when a stage begins, with its name and steps; and without a name when steps are done."""


def write_report(
    run: Run,
    planner: Planner,
    on_progress: Progress = lambda stage, steps: None,
) -> Path:
    """Writes `report/*.png` and `report/report.html`.

    Args:
        run: the run, finished or cut off.
        planner: holds its map and its coarse grid after the last view.
        on_progress: for a progress bar; a long run takes minutes to explain.

    Returns:
        The HTML page; the images are inside it, so it can be sent as one file.

    Raises:
        RunError: a run without a view, or images that cannot be read.
        OSError: the disk is full, not writable, ...
    """
    if not run.rows:
        raise RunError(run.path, "the run has no views: nothing to report")
    last = run.rows[-1]
    max_range = float(run.header.config.get("max_range", 5.0))
    map_state, grid = planner.whole_map, planner.whole_grid
    panorama = panorama_picture(map_state, grid, run.camera, last.pose, max_range)
    outlook = Outlook(run)
    drawn: dict[str, Figure | str] = {
        "plan": figures.plan_figure(run, map_state, grid),
        "progress": figures.progress_figure(run),
        "reasons": _reasons(run, outlook, on_progress),
        "forecast": _forecast(outlook, planner),
        "panorama": panorama_figure(panorama),
        "views": figures.strip_figure(run),
        "cost": figures.cost_figure(run),
    }
    on_progress("drawing the report", len(drawn))
    folder = run.path / "report"
    own_folder(run.path, "run")
    make_folder(folder)
    shown: dict[str, bytes | str] = {}
    for name, figure in drawn.items():
        on_progress("", 1)
        shown[name] = figure if isinstance(figure, str) else _saved(folder / f"{name}.png", figure)
    model = read_evaluated_model(run)
    path, ended = folder / "report.html", outcome(run)
    page = render(
        "apps/report/report.html",
        kind="run",
        title=f"{run.header.policy.get('name')} in {run.header.scene.get('name')}",
        lead=[f"{ended[:1].upper()}{ended[1:]}."],
        cards=_cards(run, model),
        hints=HINTS,
        model=None if model is None else _model(folder, model),
        drawn=shown,
        outlook=outlook_lines(outlook),
        stages=stage_times(run),
        settings=_settings(run),
    )
    write_atomic(path, page.encode())
    return path


def _saved(path: Path, figure: Figure) -> bytes:
    """Writes the figure beside the page, and returns its PNG."""
    png = style.to_png(figure)
    write_atomic(path, png)
    return png


def _reasons(run: Run, outlook: Outlook, on_progress: Progress) -> Figure | str:
    """Draws why the views were chosen, or explains why that is not known.

    The forecast uses the same maps.
    """
    on_progress("explaining the views", len(run.rows) - 1)  # no view was chosen after the last one
    states = outlook.watch(_counted(states_of(run), on_progress))
    try:
        return reasons_figure(utility_by_cause(run, states))
    except RunError as error:  # merged from other runs, or settings that this version cannot read
        return f"Not known: {error.reason}."


def _counted(states: Iterator[T], on_progress: Progress) -> Iterator[T]:
    for state in states:
        on_progress("", 1)
        yield state


def _forecast(outlook: Outlook, planner: Planner) -> Figure | str:
    outlook.add(len(outlook.run.rows), planner)
    if not outlook.forecasts[-1].mixture.size:
        return " ".join(outlook_lines(outlook))
    return outlook_figure(outlook)


def _model(folder: Path, model: EvaluatedModel) -> dict[str, Any]:
    """Returns the page's fields about the trained model."""
    return {
        "note": quality_note(model.evaluation),
        "rows": quality_rows(model.evaluation),
        "curves": model.history and _saved(folder / "training.png", training_figure(model.history)),
        "sheet": model.sheet,
    }


def _cards(run: Run, model: EvaluatedModel | None) -> dict[str, str]:
    """Returns a few large numbers, results first."""
    last, captured = run.rows[-1], sum(row.captured for row in run.rows)
    views = str(len(run.rows) - captured)
    cards: dict[str, str] = {}
    if model is not None:
        cards["PSNR of test views"] = f"{model.evaluation['metrics']['psnr']['mean']:.1f} dB"
    return cards | {
        "mean renderability": f"{last.coverage.mean_renderability:.2f}",
        "explored": f"{100 * last.coverage.known_share:.0f} %",
        **(
            {"views + frames while moving": f"{views} + {captured}"}
            if captured
            else {"views": views}
        ),
        "path": f"{last.metres:.1f} m",
        "mission clock": f"{last.seconds:.1f} s",
    }


def _settings(run: Run) -> dict[str, str]:
    """Returns the outcome, the totals and every setting."""
    header = run.header
    return {
        **summary(run),
        "scene hash": str(header.scene.get("hash", "")),
        "scene settings": _in_words({k: v for k, v in header.scene.items() if k != "hash"}),
        "policy settings": _in_words(header.policy.get("settings", {})),
        "loop settings": _in_words(header.config),
        "camera": _in_words(header.camera),
        "software": _in_words(header.packages),
    }


def _in_words(settings: dict[str, Any]) -> str:
    """Writes settings as text: `name value`, groups in brackets after their name."""
    texts: list[str] = []
    for name, value in settings.items():
        words = name.replace("_", " ")
        if isinstance(value, dict):
            texts.append(f"{words} ({_in_words(value)})")
        elif isinstance(value, bool):
            texts.append(f"{words} {'yes' if value else 'no'}")
        elif value is None:
            texts.append(f"{words} none")
        else:
            texts.append(f"{words} {value:.6g}" if isinstance(value, float) else f"{words} {value}")
    return ", ".join(texts)


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
