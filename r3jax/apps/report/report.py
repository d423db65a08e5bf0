"""The report of a run: PNG figures and one HTML page that opens from disk."""

import html
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from matplotlib.figure import Figure

from r3jax.apps.forecast.outlook import Outlook
from r3jax.apps.report import figures
from r3jax.apps.report.figures import outlook_figure, outlook_lines
from r3jax.apps.report.model_report import (
    EvaluatedModel,
    quality_note,
    quality_table,
    read_evaluated_model,
    training_figure,
)
from r3jax.apps.report.reasons import reasons_figure, utility_by_cause
from r3jax.apps.report.summary import StageTime, count_of_views, stage_times, summary
from r3jax.exploration.replay import states_of
from r3jax.files import make_folder, own_folder, write_atomic
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.plots.page import image, page, section
from r3jax.plots.panorama import panorama_figure
from r3jax.plots.pictures import panorama_picture
from r3jax.trace.errors import RunError
from r3jax.trace.reader import Run

T = TypeVar("T")

_NOTES = {
    "plan": (
        "Path from above",
        "Dots are views, ticks their viewing directions. The picture shows what lies below the "
        "cameras' heads in the map's own colors; white is known to be free, dark gray "
        "occupied, light gray unexplored at that height.",
    ),
    "progress": (
        "Coverage and renderability",
        "Explored: coarse cells known to be free or occupied, over all cells of the scene's box "
        "(the insides of walls and furniture can never be seen, so 100 % is out of reach). The "
        "curve below is the mean renderability of fixed probe views in the free space known at "
        "that time; dots are the recorded views just before each was mapped: low means new.",
    ),
    "reasons": (
        "What the planner was after",
        "The utility U = λ1 U<sub>G</sub> + Σ (1 − R) that each view promised when it was chosen, "
        "by cause. Never seen: unexplored cells in view. The rest is what the voxels in view "
        "lacked, each divided among its terms in proportion to their logarithms: seen from other "
        "directions only (too oblique), with colors that disagree (inconsistent), from farther "
        "away only (too far). All of it is worked out again from the frames, whether or not the "
        "policy decides by U.",
    ),
    "forecast": (
        "Is it enough?",
        "The PSNR that a splat model trained on the views so far would have all over the free "
        "space, forecast from the map alone. The bands hold four of five errors of such forecasts "
        "in scenes that their calibration had not seen.",
    ),
    "panorama": (
        "Panorama at the last position",
        "All directions from the last view's position; the cross is the direction it looked in. "
        "Two kinds of direction show no voxel: blue ones reach the end of the sensor's range "
        "through known free space, gray ones meet space that was never seen. Neither is part of "
        "a mean of R over voxels; in the renderability of a whole view both count as R = 0.",
    ),
    "views": ("Some of the views", "Evenly spread over the run."),
    "cost": (
        "Time and memory",
        "Measured on this machine. Colored bars count on the mission clock (with the flight); "
        "the simulator, the disk and the coverage numbers do not.",
    ),
}


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
        on_progress: for a progress bar; a long run is looked back at for minutes.

    Returns:
        The HTML page; the images are inside it, so it can be sent as one file.

    Raises:
        RunError: a run without a view, or images that cannot be read.
        OSError: the disk is full, not writable, ...
    """
    if not run.rows:
        raise RunError(run.path, "the run has no view, so there is nothing to report")
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
    sections: list[str] = []
    for name, figure in drawn.items():
        on_progress("", 1)
        if isinstance(figure, str):
            sections.append(section(_NOTES[name][0], html.escape(figure), ""))
            continue
        png = style.to_png(figure)
        write_atomic(folder / f"{name}.png", png)
        table = _beside(name, run, outlook)
        sections.append(_figure_section(name, png, table))
    model = read_evaluated_model(run)
    if model is not None:
        # What came out of it all stands first.
        sections[:0] = _model_sections(folder, model)
    sections.append(_settings_section(run))
    title = f"{run.header.policy.get('name')} in {run.header.scene.get('name')}"
    path = folder / "report.html"
    write_atomic(path, page("run", title, [f"{run.outcome}."], _cards(run, model), sections))
    return path


def _reasons(run: Run, outlook: Outlook, on_progress: Progress) -> Figure | str:
    """What the views were chosen for, or why that is not known; the outlook sees the maps too."""
    on_progress("looking back at the views", len(run.rows) - 1)  # nothing was chosen after the last
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


def _beside(name: str, run: Run, outlook: Outlook) -> str:
    """What stands below a figure."""
    if name == "cost":
        return _stage_table(stage_times(run))
    if name == "forecast":
        return "".join(f"<p>{html.escape(line)}</p>" for line in outlook_lines(outlook))
    return ""


def _model_sections(folder: Path, model: EvaluatedModel) -> list[str]:
    """The trained model: numbers and curves, then the contact sheet of the worst views."""
    note = html.escape(quality_note(model.evaluation))
    curves = b""
    if model.history:
        curves = style.to_png(training_figure(model.history))
        write_atomic(folder / "training.png", curves)
    table = quality_table(model.evaluation)
    sections = [_picture_section("The splats trained on these views", note, curves, table)]
    if model.sheet is not None:
        note = "Ground truth, render, error, and what the map had expected; worst views first."
        sections.append(_picture_section("Renders", note, model.sheet))
    return sections


def _cards(run: Run, model: EvaluatedModel | None) -> dict[str, str]:
    """At most six large numbers, so that they fit one row: what came out of the run first."""
    last = run.rows[-1]
    cards: dict[str, str] = {}
    if model is not None:
        cards["PSNR of test views"] = f"{model.evaluation['metrics']['psnr']['mean']:.1f} dB"
    return cards | {
        "mean renderability": f"{last.coverage.mean_renderability:.2f}",
        "explored": f"{100 * last.coverage.known_share:.0f} %",
        "views": count_of_views(run),
        "path": f"{last.metres:.1f} m",
        "mission clock": f"{last.seconds:.1f} s",
    }


def _figure_section(name: str, png: bytes, extra: str) -> str:
    title, note = _NOTES[name]
    return _picture_section(title, note, png, extra)


def _picture_section(title: str, note: str, png: bytes, extra: str = "") -> str:
    """A title, a note, an image (if it is not empty) and more."""
    return section(title, note, (image(png, title) if png else "") + extra)


def _stage_table(stages: list[StageTime]) -> str:
    head = (
        '<tr><th>stage</th><th>on the clock</th><th class="n">p50 [ms]</th>'
        '<th class="n">p95 [ms]</th><th class="n">total [s]</th></tr>'
    )
    rows = "".join(
        f"<tr><td>{html.escape(s.name)}</td><td>{'yes' if s.on_clock else ''}</td>"
        f'<td class="n">{1e3 * s.median:.1f}</td><td class="n">{1e3 * s.p95:.1f}</td>'
        f'<td class="n">{s.total:.2f}</td></tr>'
        for s in stages
    )
    return f"<table>{head}{rows}</table>"


def _settings_section(run: Run) -> str:
    """Outcome, numbers and every setting, so that the page explains itself."""
    header = run.header
    groups = {
        **summary(run),
        "scene hash": str(header.scene.get("hash", "")),
        "scene settings": _in_words({k: v for k, v in header.scene.items() if k != "hash"}),
        "policy settings": _in_words(header.policy.get("settings", {})),
        "loop settings": _in_words(header.config),
        "camera": _in_words(header.camera),
        "software": _in_words(header.packages),
    }
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th><td><code>{html.escape(text)}</code></td></tr>"
        for name, text in groups.items()
    )
    return section("Outcome and settings", "", f"<table>{rows}</table>")


def _in_words(settings: dict[str, Any]) -> str:
    """Settings as text: `name value`, groups in brackets behind their name."""
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
