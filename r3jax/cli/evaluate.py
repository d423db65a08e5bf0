"""`r3jax evaluate`: judges a model by test views and writes what came out."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from r3jax.apps.report import style
from r3jax.apps.report.contact_sheet import SheetView, contact_sheet
from r3jax.apps.report.report import write_report
from r3jax.cli.captures import Capture, open_capture
from r3jax.cli.console import (
    BarColumn,
    Console,
    MofNCompleteColumn,
    Progress,
    Table,
    Text,
    TextColumn,
    progress_bar,
)
from r3jax.cli.errors import UserError, check_resolution, one_line
from r3jax.cli.options import Evaluate
from r3jax.cli.progress import Stages
from r3jax.cli.selection import (
    TestSet,
    Training,
    choose_views,
    find_training,
    frames_of,
    mapped_views,
)
from r3jax.evaluation.evaluate import Evaluation, evaluate
from r3jax.evaluation.lpips import load_lpips
from r3jax.evaluation.maps import expected_image, expected_renderability, map_of
from r3jax.evaluation.scores import Summary, summarize, worst_rows, write_rows
from r3jax.files import write_atomic
from r3jax.formats.errors import FormatError
from r3jax.formats.validation.json_text import sealed
from r3jax.mapping.state import MapState
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.ply import read_scene
from r3jax.splatting.views import Views, load_views
from r3jax.trace.errors import RunError
from r3jax.trace.header import package_versions

_NETWORKS = {"alex": "AlexNet", "vgg": "VGG16"}


@dataclass(frozen=True)
class Outcome:
    """All that is shown and written."""

    training: Training
    test: TestSet
    num_gaussians: int
    views: Views
    judgment: Evaluation
    summaries: tuple[Summary, ...]

    state: MapState | None
    """The map of the training views; None without one."""


def run_evaluate(options: Evaluate) -> int:
    """Judges a model and writes rows, summary and contact sheet.

    Raises:
        UserError: no model, no test views, views that cannot be judged, a missing package.
    """
    try:
        capture = open_capture(options.path, options.up)
        outcome = _evaluate(options, capture)
        folder = options.out or _default_folder(capture, outcome.training)
        folder.mkdir(parents=True, exist_ok=True)
        written = _write(options, outcome, folder)
        if capture.run is not None and folder == _default_folder(capture, outcome.training):
            _, state, grid = capture.run.checkpoint()
            with Stages(Console(stderr=True)) as stages:
                page = write_report(capture.run, state, grid, stages.on_progress)
            written["report"] = page
    except (ValueError, OSError, ImportError, RunError, FormatError) as error:
        raise UserError(one_line(error)) from error
    _show(Console(), options, outcome, written)
    return 0


def _evaluate(options: Evaluate, capture: Capture) -> Outcome:
    # What can be checked quickly comes first.
    if options.worst < 0:
        raise ValueError(f"--worst must not be negative, got {options.worst}")
    check_resolution(options.resolution)
    training = find_training(options, capture)
    test = choose_views(options, capture, training)
    lpips = None if options.lpips == "none" else load_lpips(options.lpips)
    scene = read_scene(training.model)
    progress = Console(stderr=True)
    with progress.status(f"reading {len(test.numbers)} views ..."):
        resolution = options.resolution or training.record.get("resolution")
        views = load_views(test.frames(), resolution)
    state, expected = None, None
    mapped = [] if options.no_renderability else mapped_views(training, test, capture)
    if mapped:
        with progress.status(f"mapping {len(mapped)} training views ..."):
            state = _map(capture, mapped)
            expected = expected_renderability(state, test.frames())
    with _bar(progress) as bar:
        task = bar.add_task("", total=len(views))
        judgment = evaluate(
            scene,
            views,
            RasterConfig(backend=options.backend),
            background=jnp.asarray(training.background),
            lpips=lpips,
            renderability=expected,
            numbers=test.numbers,
            on_view=lambda done: bar.update(task, completed=done),
        )
    summaries = summarize(judgment.rows, seed=options.seed)
    return Outcome(training, test, scene.capacity, views, judgment, summaries, state)


def _map(capture: Capture, numbers: list[int]) -> MapState:
    config = capture.run.header.config if capture.run is not None else {}
    return map_of(
        frames_of(capture, numbers),
        voxel_size=float(config.get("voxel_size", 0.05)),
        max_range=float(config.get("max_range", 5.0)),
    )


def _bar(console: Console) -> Progress:
    return progress_bar(
        console,
        TextColumn("rendering"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        transient=True,
    )


def _default_folder(capture: Capture, training: Training) -> Path:
    return training.model.parent if capture.run is None else capture.path / "report"


def _write(options: Evaluate, outcome: Outcome, folder: Path) -> dict[str, Path]:
    """The files, under what they hold."""
    written = {"rows": folder / f"evaluation.{options.rows}", "summary": folder / "evaluation.json"}
    write_rows(written["rows"], outcome.judgment.rows)
    record = _record(options, outcome)
    if options.worst:
        written["worst views"] = folder / "evaluation.png"
        sheet = style.to_png(_sheet(options, outcome))
        record["sheet_sha256"] = hashlib.sha256(sheet).hexdigest()
        write_atomic(written["worst views"], sheet)
    text = json.dumps(sealed(record), indent=1, allow_nan=False)
    write_atomic(written["summary"], text.encode())
    return written


def _record(options: Evaluate, outcome: Outcome) -> dict[str, Any]:
    """Everything that the numbers depend on, and the numbers."""
    summaries: dict[str, Any] = {}
    for summary in outcome.summaries:
        plain = dataclasses.asdict(summary)
        summaries[plain.pop("metric")["name"]] = plain
    return {
        "format": 1,
        "model": str(outcome.training.model),
        "gaussians": outcome.num_gaussians,
        "data": str(outcome.test.capture.path),
        "views": options.views,
        "numbers": outcome.test.numbers,
        "trained_on": outcome.test.num_trained,
        "width": outcome.views.width,
        "height": outcome.views.height,
        "lpips": None
        if options.lpips == "none"
        else {"network": _NETWORKS[options.lpips], "version": "0.1", "input": [-1, 1]},
        "bootstrap_seed": options.seed,
        "metrics": summaries,
        "packages": package_versions(),
    }


def _sheet(options: Evaluate, outcome: Outcome):
    """The contact sheet of the worst views."""
    rows, renders = outcome.judgment.rows, outcome.judgment.renders
    place = {row.view: i for i, row in enumerate(rows)}
    lines: list[SheetView] = []
    for row in worst_rows(rows, options.worst):
        i, expected = place[row.view], None
        if outcome.state is not None:
            expected = expected_image(outcome.state, outcome.test.capture.source.frame(row.view))
        lines.append(SheetView(row, np.asarray(outcome.views.rgb[i]), renders[i], expected))
    psnr = outcome.summaries[0]
    title = (
        f"The worst {len(lines)} of {_described(outcome)}\n"
        f"mean PSNR {psnr.mean:.2f} dB, median {psnr.median:.2f} dB"
    )
    return contact_sheet(lines, title)


def _described(outcome: Outcome) -> str:
    test, views = outcome.test, outcome.views
    return f"{len(views)} {test.title} of {test.capture.path} at {views.width}x{views.height} px"


def _show(console: Console, options: Evaluate, outcome: Outcome, written: dict[str, Path]) -> None:
    rows = outcome.judgment.rows
    console.say(_described(outcome))
    console.say(f"model: {outcome.training.model}, {outcome.num_gaussians} Gaussians")
    console.print(_table(outcome.summaries))
    lpips = (
        "no LPIPS"
        if options.lpips == "none"
        else f"LPIPS v0.1 with {_NETWORKS[options.lpips]} on [-1, 1]"
    )
    console.print(
        "Renders rounded to 8 bits; SSIM with an 11x11 Gaussian window, sigma 1.5, data range 1; "
        f"{lpips}. Brackets: 95 % bootstrap interval of the mean over views. The 5th percentile "
        "is the bad tail (of LPIPS the 95th).",
        style="dim",
    )
    coverage = np.mean([row.coverage for row in rows])
    holes = 1.0 - np.mean([row.measured for row in rows])
    facts = f"filled by the model {100 * coverage:.1f} %, holes of the scan {100 * holes:.1f} %"
    expected = [row.renderability for row in rows if row.renderability is not None]
    if expected:
        facts += f", mean renderability {np.mean(expected):.3f}"
    console.say(facts)
    for what, path in written.items():
        console.say(f"{what}  {path}")
    for warning in _warnings(outcome):
        console.say(f"warning: {warning}", style="yellow")


def _table(summaries: tuple[Summary, ...]) -> Table:
    table = Table("", "mean", "", "median", "5th %", "worst (view)", "<20 dB", box=None)
    for column in table.columns:
        column.no_wrap = True
        column.justify = "left" if column is table.columns[0] else "right"
    for summary in summaries:

        def show(value: float, digits: int = summary.metric.decimals) -> str:
            return f"{value:.{digits}f}"

        low, high = summary.interval
        poor = "" if summary.poor_share is None else f"{100 * summary.poor_share:.1f} %"
        table.add_row(
            summary.metric.title,
            Text(show(summary.mean), style="bold"),
            f"[{show(low)}, {show(high)}]",
            show(summary.median),
            show(summary.percentile_5),
            f"{show(summary.worst)} ({summary.worst_view})",
            poor,
        )
    return table


def _warnings(outcome: Outcome) -> list[str]:
    """What makes the numbers mean less than they seem to."""
    test, training = outcome.test, outcome.training
    warnings: list[str] = []
    if test.num_trained:
        warnings.append(
            f"the model was trained on {test.num_trained} of these {len(test.numbers)} views; "
            "this says how well it fits, not how well it predicts"
        )
    if test.num_trained is None:
        warnings.append(
            "it is not known whether the model was trained on these views (no train.json beside it)"
        )
    trained = training.record.get("resolution")
    longer = max(outcome.views.width, outcome.views.height)
    if trained is not None and longer != trained:
        warnings.append(f"the model was trained at {trained} px and is judged at {longer} px")
    return warnings
