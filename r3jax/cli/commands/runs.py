"""Commands on runs: info, replay, merge, forecast, export, view; and the list of policies."""

import contextlib
import shlex
import time
from collections import deque
from pathlib import Path
from typing import Protocol

from r3jax.apps.forecast.forecast import Outlook
from r3jax.apps.forecast.psnr import default_calibration, read_calibration
from r3jax.apps.report.summary import stage_times, summary
from r3jax.cli.console import Console, Stages, Table, Text
from r3jax.cli.errors import check_viser
from r3jax.cli.options.runs import (
    ExportOptions,
    ForecastOptions,
    InfoOptions,
    MergeOptions,
    PoliciesOptions,
    ReplayOptions,
    ViewOptions,
)
from r3jax.errors import InputError
from r3jax.exploration.config import DEPTH_STEPS_PER_METRE
from r3jax.exploration.state import describe_counts
from r3jax.files import PNG_MARK, check_replaceable, make_folder, write_atomic
from r3jax.formats.exports import export_run, write_data_set
from r3jax.formats.recordings import is_recording, read_recording
from r3jax.formats.submissions import submission_of_run, write_submission
from r3jax.interrupts import check_interrupt, deferred_interrupt, end_process
from r3jax.network import exposure_warning
from r3jax.planning.registry import describe, policy_names, source_of
from r3jax.runs.begin import merge_runs
from r3jax.runs.reader import Run, read_run
from r3jax.runs.replay import differences, states_of
from r3jax.runs.settings import config_of


def run_info(options: InfoOptions) -> int:
    """Prints a run, a recording, or the installed versions.

    Raises:
        InputError, ValueError, OSError: neither a run nor a recording, or a broken one.
    """
    console = Console()
    path = options.path
    if path is None:
        _show_inventory(console)
    elif (path / "run.json").exists():
        _show_run(console, path)
    elif is_recording(path):
        _show_recording(console, options, path)
    else:
        raise InputError(
            f"{path}: neither a run (no run.json) nor a recording (no poses.txt and images/)"
        )
    return 0


def _show_inventory(console: Console) -> None:
    from r3jax.kernels.native.platform import describe_kernels
    from r3jax.planning.registry import describe, policy_names
    from r3jax.runs.header import package_versions
    from r3jax.simulators.scenes import registry

    scenes = {name: registry.describe(name) for name in registry.scene_names()}
    scenes |= registry.outside_scenes()
    policies = {name: describe(name) for name in policy_names()}
    for title, entries in (
        ("Scenes", scenes),
        ("Policies", policies),
        ("Software", {**package_versions(), "kernels": describe_kernels()}),
    ):
        console.print(_two_columns(title, entries))
    Console(stderr=True).next("demo")


def _two_columns(title: str, entries: dict[str, str]) -> Table:
    table = Table(
        title=title, title_justify="left", title_style="bold", show_header=False, box=None
    )
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in entries.items():
        table.add_row(name, text)
    return table


def _show_run(console: Console, path: Path) -> None:
    run = read_run(path)
    console.print(_two_columns(f"Run {path}", summary(run)))
    table = Table("stage", "p50 [ms]", "p95 [ms]", "total [s]", title="Step times", box=None)
    for column in table.columns[1:]:
        column.justify = "right"
    for stage in stage_times(run):
        table.add_row(
            stage.name, f"{1e3 * stage.median:.1f}", f"{1e3 * stage.p95:.1f}", f"{stage.total:.2f}"
        )
    console.print(table)
    page = path / "report" / "report.html"
    if page.exists():
        console.say(f"report  {page}")
    Console(stderr=True).next("view" if run.rows else "replay", path)


def _show_recording(console: Console, options: InfoOptions, path: Path) -> None:
    from r3jax.apps.report.figures import FrameReport, follow_recording, revisit_figure
    from r3jax.plots.style import to_png

    if options.plot is not None:
        check_replaceable(options.plot, PNG_MARK)
    recording = read_recording(path, options.up)
    camera = recording.lenses[0].camera
    console.print(
        f"{len(recording)} frames of {camera.width}x{camera.height} px; renderability of each "
        "frame before it is mapped:",
    )
    console.print("frame  renderability  new voxels  voxels  path [m]", style="bold")
    reports: list[FrameReport] = []
    for report, _ in follow_recording(recording, voxel_size=options.voxel_size):
        check_interrupt()
        reports.append(report)
        bar = "█" * round(20 * report.renderability)
        console.print(
            f"{report.index:5d}  {report.renderability:13.3f}  {report.new_voxels:10d}  "
            f"{report.voxels:6d}  {report.metres:8.2f}  {bar}",
        )
    if options.plot is not None:
        write_atomic(options.plot, to_png(revisit_figure(recording, reports)))
        console.say(f"plot  {options.plot}")
    Console(stderr=True).next("audit", path)


_DIFFERS = 1
"""Exit code where the maps are not equal."""


def run_replay(options: ReplayOptions) -> int:
    """Rebuilds map and grid from the frames and compares them bit by bit with the stored ones.

    Raises:
        ValueError, OSError: not a run, no stored map, a frame that is missing or not the recorded
            one.
    """
    console = Console(stderr=True)
    run = read_run(options.path)
    with Stages(console) as stages:
        stages.on_progress("integrating the recorded frames", len(run.rows))
        views, found = differences(run, lambda: stages.on_progress("", 1))
    if not found:
        console.say(f"replayed {views} frames: map and grid are identical to the stored ones")
        console.next("train", options.path)
        return 0
    console.say(f"replayed {views} frames: the result differs from the stored one:")
    for difference in found:
        what = f"{difference.num_different} elements, by at most {difference.largest:g}"
        text = "another shape" if difference.num_different < 0 else what
        console.say(f"  {difference.name}: {text}")
    console.say("possible causes: another version of r3jax, or another kind of device")
    return _DIFFERS


def run_merge(options: MergeOptions) -> int:
    """Writes the merged run: the views of both, the map, transforms.json and points.

    Raises:
        ValueError, OSError: not runs, of different scenes or settings, or the folder cannot be
            written.
    """
    console = Console(stderr=True)
    out = options.out or options.first.parent / f"{options.first.name}+{options.second.name}"
    runs = [read_run(path) for path in (options.first, options.second)]
    total = sum(len(run.rows) for run in runs)
    with Stages(console) as stages:
        stages.on_progress("integrating the frames of both", total)
        map_state = merge_runs(
            runs, out, overwrite=options.overwrite, on_frame=lambda: stages.on_progress("", 1)
        )
        write_data_set(read_run(out), map_state)
    views = " + ".join(describe_counts(run.rows) for run in runs)
    console.say(f"{views}, {int(map_state.num_present)} voxels")
    console.say(f"merged    {out}")
    console.next("train", out)
    return 0


def run_forecast(options: ForecastOptions) -> int:
    """Prints the forecast along the run, and the estimated views for one more decibel.

    Raises:
        ValueError, OSError: not a run, a frame that is missing, or a file that is no calibration.
    """
    # Lazy import: other commands on runs need no plots.
    from r3jax.apps.report.figures import LEVEL, outlook_figure, outlook_lines
    from r3jax.plots.style import to_png

    console = Console(stderr=True)
    if options.plot is not None:
        check_replaceable(options.plot, PNG_MARK)
    chosen = options.calibration
    calibration = default_calibration() if chosen is None else read_calibration(chosen)
    outlook = Outlook(read_run(options.path), calibration=calibration)
    with Stages(console) as stages:
        states = states_of(outlook.run)
        total = len(outlook.run.rows)
        followed = stages.each("rebuilding the map from the frames", states, total)
        deque(outlook.watch(followed), maxlen=0)
    if options.plot is not None:
        write_atomic(options.plot, to_png(outlook_figure(outlook)))
    out = Console()
    out.say(
        f"PSNR of free-space views [dB], calibrated on {calibration.source}; intervals hold "
        f"{100 * LEVEL:.0f} % of the errors in unseen scenes",
    )
    captures = outlook.frames != outlook.views
    out.print(f"views  {'frames  ' * captures} mean   p10   p50", style="bold")
    steps = zip(outlook.views, outlook.frames, outlook.forecasts, strict=True)
    for views, frames, forecast in steps:
        mean, low, middle = (forecast.value(name) for name in ("mean", "p10", "p50"))
        all_frames = f"{frames:6d}  " * captures
        out.say(f"{views:5d}  {all_frames}{mean:5.1f} {low:5.1f} {middle:5.1f}")
    for line in outlook_lines(outlook):
        out.say(line)
    if options.plot is not None:
        out.say(f"plot  {options.plot}")
    console.next("explore", "--resume", options.path, "--until", "psnr:25")
    return 0


def run_export(options: ExportOptions) -> int:
    """Writes the folder, or the file of a submission.

    Raises:
        ValueError, OSError: not a run, no views, a folder that holds something, a disk that is
            full.
    """
    console = Console(stderr=True)
    run = read_run(options.path)
    if options.format == "submission":
        return _write_submission(console, run, options.out)
    with Stages(console) as stages:
        stages.on_progress("copying the images", len(run.rows))
        points = export_run(run, options.out, options.format, lambda: stages.on_progress("", 1))
    console.say(f"{len(run.rows)} images, {points} points")
    console.say(f"exported  {options.out}")
    if options.format == "nerfstudio":
        unit = 1.0 / DEPTH_STEPS_PER_METRE
        console.say(
            f"next      ns-train splatfacto --data {shlex.quote(str(options.out))} nerfstudio-data "
            f"--depth-unit-scale-factor {unit:g}"
        )
    else:
        console.next("audit", options.out)
    return 0


def _write_submission(console: Console, run: Run, out: Path) -> int:
    """Writes the poses of a run, and prints the command that evaluates them."""
    submission = submission_of_run(run)
    make_folder(out.parent)
    write_submission(out, submission)
    console.say(f"{len(submission.frames)} frames, {out.stat().st_size / 1000:.0f} kB")
    console.say(f"exported  {out}")
    console.next("benchmark", "--submission", out)
    return 0


def run_view(options: ViewOptions) -> int:
    """Shows a run in the browser until Ctrl-C, or writes its images.

    Raises:
        InputError: no views yet.
        ValueError, OSError, ImportError: not a run, a port that is in use, a folder that holds
            something, a missing package.
    """
    console = Console(stderr=True)
    if not options.is_run:
        _show_page(options, _scan_page(options), console)
        return 0
    run = read_run(options.path)
    if not run.rows:
        raise InputError(f"{run.path}: the run has no views yet")
    config_of(run)  # says what is wrong with it
    if options.export is not None:
        return _export_images(run, options.export, options.video, console)
    _show_page(options, _run_page(options, run), console)
    return 0


class _Page(Protocol):
    """A page that is being shown."""

    @property
    def url(self) -> str: ...


def _run_page(options: ViewOptions, run: Run) -> contextlib.AbstractContextManager[_Page]:
    """Prepares the page of a run.

    Raises:
        InputError: viser is not installed.
    """
    check_viser()
    from r3jax.apps.viewer.run_page import open_run_page  # needs viser

    return open_run_page(
        run,
        host=options.host,
        port=options.port,
        allow=options.allow,
        model=options.name,
        with_scene=not options.no_scene,
    )


def _scan_page(options: ViewOptions) -> contextlib.AbstractContextManager[_Page]:
    """Prepares the page of an audit, a capture or a splat.

    Raises:
        InputError: viser is not installed, or an audit of another version.
        ValueError, OSError: neither of them, or a damaged one.
    """
    check_viser()
    from r3jax.apps.viewer.scan_page import open_scan_page, scan_of  # needs viser

    return open_scan_page(
        scan_of(options.path), host=options.host, port=options.port, allow=options.allow
    )


def _show_page(
    options: ViewOptions, page: contextlib.AbstractContextManager[_Page], console: Console
) -> None:
    """Shows a page until Ctrl-C.

    Raises:
        ValueError, OSError: as `open_run_page` and `open_scan_page`.
    """
    if warning := exposure_warning(options.host, "sees the page, and can use it"):
        console.say(warning, style="yellow")
    with contextlib.ExitStack() as stack:
        with console.status("opening ..."):
            shown = stack.enter_context(page)
        with deferred_interrupt() as was_interrupted:
            console.say(f"view      {shown.url}")
            console.say("Ctrl-C ends it")  # from here on, and not only once this waits
            while not was_interrupted():
                time.sleep(0.1)
        # The page writes nothing, and what it works on may take half a minute yet.
        end_process(0)


def _export_images(run: Run, out: Path, video: bool, console: Console) -> int:
    """Writes the images.

    Raises:
        FormatError, RunError, ImportError, OSError: as `export_film`.
    """
    # Lazy import: other commands on runs need no plots.
    from r3jax.apps.viewer.film import export_film, load_av

    if video:
        load_av()  # says what is missing before an hour has passed
    with Stages(console) as stages:
        written = export_film(
            run, out, video=video, on_picture=lambda done, total: stages.at("drawing", done, total)
        )
    for path in written:
        console.say(f"written   {path}")
    return 0


def run_policies(options: PoliciesOptions) -> int:
    """Prints every policy with a sentence and its source."""
    del options
    # Lines break between words, at 100 columns at most; into a file or a pipe they fit in 80.
    console = Console()
    table = Table(show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name in policy_names():
        table.add_row(name, Text(describe(name)).append(f"\n{source_of(name)}", style="dim"))
    console.print(table, width=min(console.width, 100))
    Console(stderr=True).next("explore", "--scene", "flat", "--policy", policy_names()[0])
    return 0
