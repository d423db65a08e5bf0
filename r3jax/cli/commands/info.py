"""`r3jax info`: what there is, what a run did, what a recording shows."""

from pathlib import Path

from r3jax.apps.report.summary import stage_times, summary
from r3jax.cli.console import Console, Table
from r3jax.cli.options.runs import InfoOptions
from r3jax.errors import InputError
from r3jax.files import check_replaceable, write_atomic
from r3jax.formats.recordings import is_recording, read_recording
from r3jax.interrupts import check_interrupt
from r3jax.runs.reader import read_run


def run_info(options: InfoOptions) -> int:
    """Prints what is asked for.

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
    from r3jax.apps.report.revisits import FrameReport, follow_recording, revisit_figure
    from r3jax.plots.style import PNG_MARK, to_png

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
