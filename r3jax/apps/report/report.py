"""The report of a run: PNG figures and one HTML page that opens from disk."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from matplotlib.figure import Figure

from r3jax.apps.forecast.forecast import Outlook
from r3jax.apps.report import figures
from r3jax.apps.report.figures import (
    outlook_figure,
    outlook_lines,
    reasons_figure,
    utility_by_cause,
)
from r3jax.apps.report.model_report import (
    EvaluatedModel,
    quality_note,
    quality_rows,
    read_evaluated_model,
    training_figure,
)
from r3jax.apps.report.summary import outcome, stage_times, summary
from r3jax.files import make_folder, own_folder, write_atomic
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.plots.page import render
from r3jax.plots.pictures import panorama_figure, panorama_picture
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run
from r3jax.runs.replay import states_of

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
    map_state: MapState,
    grid: OccupancyGrid,
    on_progress: Progress = lambda stage, steps: None,
) -> Path:
    """Writes `report/*.png` and `report/report.html`.

    Args:
        run: the run, finished or cut off.
        map_state: its map after the last view.
        grid: its coarse grid after the last view.
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
    panorama = panorama_picture(map_state, grid, run.camera, last.pose, max_range)
    outlook = Outlook(run)
    drawn: dict[str, Figure | str] = {
        "plan": figures.plan_figure(run, map_state, grid),
        "progress": figures.progress_figure(run),
        "reasons": _reasons(run, outlook, on_progress),
        "forecast": _forecast(outlook, map_state, grid),
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


def _forecast(outlook: Outlook, map_state: MapState, grid: OccupancyGrid) -> Figure | str:
    outlook.add(len(outlook.run.rows), map_state, grid)
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
