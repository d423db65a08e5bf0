"""Commands that train a model and evaluate it."""

from pathlib import Path

import numpy as np

from r3jax.cli.console import Console, Stages, Table, Text, TrainProgress
from r3jax.cli.errors import one_line
from r3jax.cli.options.models import EvaluateOptions, ModelFolderOptions, TrainOptions
from r3jax.cli.parsing import given_words, settings_for
from r3jax.errors import InputError
from r3jax.evaluation.judge import (
    NETWORKS,
    JudgeSettings,
    Judgment,
    check_judgment_folder,
    choose_views,
    judge,
    warnings_of,
    write_judgment,
)
from r3jax.evaluation.scores import Summary
from r3jax.files import own_folder
from r3jax.formats.captures import open_capture
from r3jax.formats.points import write_points
from r3jax.formats.ros.bags import parse_topics
from r3jax.runs.header import package_versions
from r3jax.runs.replay import stored_planner
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.errors import TrainingDiverged
from r3jax.splatting.model import check_free, find_model, only_writer, scene_points, write_model
from r3jax.splatting.training import train
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.views import load_views, split_views


def run_train(options: TrainOptions) -> int:
    """Trains a model and writes it.

    Returns:
        0 done, 130 interrupted (it can be resumed).

    Raises:
        InputError: training that diverged.
        ValueError, OSError, ImportError: bad input, a model that exists, too little memory.
    """
    console = Console(stderr=True)
    config = TrainConfig(
        num_gaussians=options.model.gaussians,
        raster=RasterConfig(backend=options.reading.backend),
        **settings_for(TrainConfig, options),
    )
    capture = open_capture(options.path, options.reading.up, parse_topics(options.reading.topics))
    folder = (options.folder.out or capture.models) / options.folder.name
    resume, overwrite = options.folder.resume, options.folder.overwrite
    check_free(folder, replace=overwrite or resume)
    split = split_views(len(capture), options.hold_out)
    with Stages(console) as stages:
        frames = stages.each("reading the views", capture.frames(), len(capture))
        views = load_views(frames, options.resolution).take(split[0])
    if capture.run is not None and options.folder.out is None:
        own_folder(capture.path, "run")
    try:
        with only_writer(folder, replace=overwrite or resume):
            with TrainProgress(console, config.iterations) as progress:
                result = train.fit(
                    views,
                    config,
                    folder=folder / "checkpoints",
                    resume=resume,
                    overwrite=overwrite,
                    on_progress=progress.on_progress,
                )
            write_points(folder / "points.ply", *scene_points(result.scene))
            write_model(folder, result, options.path, views, split, config, package_versions())
    except TrainingDiverged as error:
        raise InputError(one_line(error)) from error
    _conclude_training(console, options, folder, result)
    return 130 if result.interrupted else 0


def _conclude_training(
    console: Console, options: TrainOptions, folder: Path, result: train.FitResult
) -> None:
    history = result.history
    done = history.first_step + len(history.loss) - 1
    if result.interrupted:
        console.say(f"interrupted after step {done}; add --resume to the same command to go on")
    if len(history.psnr):
        latest = history.psnr[-100:].mean()
        console.say(
            f"{done} steps, {int(history.num_gaussians[-1])} Gaussians, PSNR of the latest "
            f"training views {latest:.2f} dB",
        )
    if result.dropped:
        console.say(
            f"Capacity reached, {result.dropped} Gaussians dropped; "
            "increase --capacity for more detail"
        )
    console.say(f"model     {folder / 'scene.ply'}")
    if result.interrupted:
        return
    name = options.folder.name
    which = () if name == ModelFolderOptions.name else ("--name", name)
    where = which if options.folder.out is None else ("--model", folder)
    how = () if options.hold_out else ("--views", "all")
    console.next("evaluate", options.path, *where, *how, *given_words(options, ("up", "topics")))


def run_evaluate(options: EvaluateOptions) -> int:
    """Evaluates a model and writes rows, summary and contact sheet.

    Raises:
        ValueError, OSError, ImportError: no model, no test views, views that cannot be evaluated, a
            missing package.
    """
    progress, reading, results = Console(stderr=True), options.reading, options.results
    capture = open_capture(options.path, reading.up, parse_topics(reading.topics))
    model = find_model(capture.models, capture.path, options.name, options.model)
    test = choose_views(options.views, capture, model, reading.up)
    default = model.path.parent if capture.run is None else capture.path / "report"
    folder = results.out or default
    check_judgment_folder(folder)
    settings = JudgeSettings(
        with_map=not results.no_renderability, **settings_for(JudgeSettings, options)
    )
    with Stages(progress) as stages:
        judgment = judge(capture, model, test, settings, stages.on_progress)
        stages.on_progress("writing the results", 0)
        if capture.run is not None and folder == default:
            own_folder(capture.path, "run")
        written = write_judgment(judgment, folder, options.views, results.rows, results.worst)
        if capture.run is not None and folder == default:
            _, planner = stored_planner(capture.run)
            # Lazy import: training needs no plots.
            from r3jax.apps.report.report import write_report

            written["report"] = write_report(capture.run, planner, stages.on_progress)
    _show_judgment(Console(), judgment, written)
    if capture.run is not None:
        which = () if options.name == EvaluateOptions.name else ("--name", options.name)
        progress.next("view", options.path, *which)
    else:
        progress.next("audit", options.path, *given_words(options, ("up", "topics")))
    return 0


def _show_judgment(console: Console, judgment: Judgment, written: dict[str, Path]) -> None:
    rows, network = judgment.evaluation.rows, judgment.settings.lpips
    console.say(judgment.described)
    console.say(f"model     {judgment.model.path}, {judgment.num_gaussians} Gaussians")
    console.print(_metric_table(judgment.summaries))
    lpips = "no LPIPS" if network == "none" else f"LPIPS v0.1 with {NETWORKS[network]} on [-1, 1]"
    console.print(
        "Renders rounded to 8 bits; SSIM with an 11x11 Gaussian window, sigma 1.5, data range 1; "
        f"{lpips}. Brackets: 95 % bootstrap interval of the mean over views. 5th percentile: "
        "worst 5 % of views (95th for LPIPS).",
        style="dim",
    )
    coverage = np.mean([row.coverage for row in rows])
    holes = 1.0 - np.mean([row.measured for row in rows])
    facts = f"coverage {100 * coverage:.1f} %, pixels without true depth {100 * holes:.1f} %"
    expected = [row.renderability for row in rows if row.renderability is not None]
    if expected:
        facts += f", mean renderability {np.mean(expected):.3f}"
    console.say(facts)
    for what, path in written.items():
        console.say(f"{what:<8}  {path}")
    for warning in warnings_of(judgment):
        console.say(f"warning: {warning}", style="yellow")


def _metric_table(summaries: tuple[Summary, ...]) -> Table:
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
