"""`r3jax audit`: finds where a capture fails, how well it is covered, which views to add."""

import dataclasses
import shlex
import tempfile
from pathlib import Path

from r3jax.apps.audit import sentences
from r3jax.apps.audit.audit import Audit, audit
from r3jax.apps.audit.audit_figures import region_letter
from r3jax.apps.audit.audit_page import write_report
from r3jax.apps.audit.live.follow import follow
from r3jax.apps.audit.live.guide_page import open_guide
from r3jax.apps.audit.outputs import (
    Preview,
    audited_capture,
    suggested_poses,
    train_preview,
    write_outputs,
)
from r3jax.apps.audit.settings import AuditSettings
from r3jax.captures.camera_paths import CameraPath, path_of
from r3jax.captures.source import Source, source_of
from r3jax.cli.console import Console, Stages, Table
from r3jax.cli.errors import one_line
from r3jax.cli.options.audit import AuditOptions
from r3jax.cli.parsing import given_words
from r3jax.errors import InputError
from r3jax.files import check_own, own_folder
from r3jax.formats.captures import open_capture
from r3jax.formats.ros.bags import parse_topics
from r3jax.interrupts import settle_interrupt
from r3jax.network import exposure_warning
from r3jax.splatting.errors import TooLargeError, TrainingDiverged, ViewsError

_SHOWN = 5
"""Regions that the console lists."""

_REPEATED = {"path", "out", "topics", *(field.name for field in dataclasses.fields(AuditSettings))}
"""Options to repeat in the suggested command, which audits the capture with further views."""


def run_audit(options: AuditOptions) -> int:
    """Audits a capture and writes the report and what belongs to it.

    Raises:
        ValueError, OSError: not a capture, a broken one, one without depth; a folder that holds
            something else; a disk that is full.
    """
    progress = Console(stderr=True)
    if options.guide.live:
        with tempfile.TemporaryDirectory(prefix="r3jax-") as scratch:
            _follow(options, Path(scratch), progress)
    else:
        capture = open_capture(
            options.capture, "z", parse_topics(options.topics), options.terms.cut
        )
        path = None if options.path is None else path_of(options.path, capture.source)
        source = source_of(capture.source, capture.name, can_compute=True)
        _audit(options, source, path, progress)
    return 0


def _follow(options: AuditOptions, scratch: Path, progress: Console) -> None:
    """Guides the scan until Ctrl-C, then audits the received frames; the page stays up meanwhile.

    Raises:
        InputError: nothing came in.
        ValueError, OSError: as `follow`, `open_guide` and `_audit`.
    """
    if warning := exposure_warning(options.guide.host):
        progress.say(warning, style="yellow")
    with open_guide(options.guide.host, options.guide.port) as page:
        progress.say(f"guide     {page.url}")
        if not options.capture.exists():
            progress.say(f"waiting for {options.capture} to be recorded")
        progress.say("Ctrl-C ends the scan, and audits it")
        topics = parse_topics(options.topics)
        source = follow(options.capture, page, scratch, up=options.terms.up, topics=topics)
        settle_interrupt()  # It has ended the scan.
        if source is None:
            raise InputError(f"{options.capture}: no frames were received")
        page.say("The scan has ended.", "its audit is being written")
        _audit(options, source, None, progress)


def _audit(
    options: AuditOptions, source: Source, path: CameraPath | None, progress: Console
) -> None:
    """Audits a capture, writes what belongs to it, and shows what was found.

    Args:
        options: of the command line.
        source: the capture.
        path: frames to evaluate instead of its own.
        progress: display of the progress.

    Raises:
        InputError: a folder that holds something else.
        ValueError, OSError: as `audit` and `write_outputs`.
    """
    folder = options.out or Path("runs") / "audit" / source.name
    _check_folder(folder, options.capture)
    with Stages(progress) as stages:
        found = audit(source, options.terms, path, stages.on_progress)
        own_folder(folder, "audit", "give another --out")
        preview = _preview(found, folder, stages, progress) if options.preview else None
        stages.on_progress("writing the report", 0)
        written = write_outputs(found, folder, options.capture, has_splat=preview is not None)
        page = write_report(
            found, folder, written.values(), capture=options.capture, preview=preview
        )
    if (moved := sentences.origin(found)) is not None:
        progress.say(moved)
    _show(Console(), found, {"report": page, **written})
    progress.say(f"in three dimensions: r3jax view {shlex.quote(str(folder))}")
    progress.say(f"fewest frames to train on: {sentences.select_command(options.capture)}")
    if found.plan.views:
        progress.say("then take the views above, add them to the capture, and")
    progress.next("audit", options.capture, *given_words(options, _REPEATED))


def _preview(found: Audit, folder: Path, stages: Stages, progress: Console) -> Preview | None:
    """Trains a splat to look at, or says why there is none."""
    try:
        return train_preview(found, folder, stages.on_progress)
    except (ViewsError, TooLargeError, TrainingDiverged) as error:
        progress.say(f"no splat could be trained: {one_line(error)}", style="yellow")
        return None


def _check_folder(folder: Path, capture: Path) -> None:
    """Refuses to replace anything but an earlier audit of the same capture."""
    check_own(folder, "audit", "give another --out")
    audited = audited_capture(folder)
    if audited is not None and audited != capture.resolve():
        raise InputError(f"{folder} holds the audit of {audited}: give another --out")


def _show(console: Console, found: Audit, written: dict[str, Path]) -> None:
    for sentence in (sentences.headline(found), *sentences.verdict(found)):
        console.print(sentence)
    if found.regions:
        console.print(_regions(found))
    if found.plan.views:
        console.print(_views(found))
    for what, path in written.items():
        console.say(f"{what:<8}  {path}")


def _regions(found: Audit) -> Table:
    table = Table(title="Where it is worst", title_justify="left", title_style="bold", box=None)
    for name in ("", "mostly"):
        table.add_column(name)
    for name in ("bad", "R", "middle (x, y, z)"):
        table.add_column(name, justify="right")
    for number, region in enumerate(found.regions[:_SHOWN]):
        center = found.survey.alignment.points_back(region.center[None])[0]
        table.add_row(
            region_letter(number),
            region.cause,
            sentences.area(found, region.area),
            f"{region.renderability:.2f}",
            sentences.point(center),
        )
    return table


def _views(found: Audit) -> Table:
    table = Table(title="Views to take", title_justify="left", title_style="bold", box=None)
    for name in ("", "from (x, y, z)", "towards", "most useful"):
        table.add_column(name, justify="right")
    poses = suggested_poses(found)
    for number, (view, pose) in enumerate(zip(found.plan.views, poses, strict=True), start=1):
        table.add_row(
            str(number),
            sentences.point(pose[:3, 3]),
            sentences.point(pose[:3, 2]),
            f"{view.rank}.",
        )
    return table
