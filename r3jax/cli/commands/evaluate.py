"""`r3jax evaluate`: judges a model by test views and writes what came out."""

from pathlib import Path

import numpy as np

from r3jax.apps.report.report import write_report
from r3jax.cli.console import Console, Table, Text
from r3jax.cli.options.splats import EvaluateOptions
from r3jax.cli.parsing import given_words, settings_for
from r3jax.cli.progress import Stages
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
from r3jax.formats.ros.bags import parse_topics
from r3jax.splatting.model import find_model


def run_evaluate(options: EvaluateOptions) -> int:
    """Judges a model and writes rows, summary and contact sheet.

    Raises:
        ValueError, OSError, ImportError: no model, no test views, views that cannot be judged, a
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
            _, state, grid = capture.run.checkpoint()
            written["report"] = write_report(capture.run, state, grid, stages.on_progress)
    _show(Console(), judgment, written)
    if capture.run is not None:
        which = () if options.name == EvaluateOptions.name else ("--name", options.name)
        progress.next("view", options.path, *which)
    else:
        progress.next("audit", options.path, *given_words(options, ("up", "topics")))
    return 0


def _show(console: Console, judgment: Judgment, written: dict[str, Path]) -> None:
    rows, network = judgment.evaluation.rows, judgment.settings.lpips
    console.say(judgment.described)
    console.say(f"model: {judgment.model.path}, {judgment.num_gaussians} Gaussians")
    console.print(_table(judgment.summaries))
    lpips = "no LPIPS" if network == "none" else f"LPIPS v0.1 with {NETWORKS[network]} on [-1, 1]"
    console.print(
        "Renders rounded to 8 bits; SSIM with an 11x11 Gaussian window, sigma 1.5, data range 1; "
        f"{lpips}. Brackets: 95 % bootstrap interval of the mean over views. 5th percentile: "
        "worst 5 % of views (95th for LPIPS).",
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
    for warning in warnings_of(judgment):
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
