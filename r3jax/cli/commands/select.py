"""`r3jax select`: which frames of a capture to keep."""

from pathlib import Path

from r3jax.apps.select.outputs import write_data_set
from r3jax.apps.select.select import select
from r3jax.apps.select.selection_page import commands, lead, write_page
from r3jax.apps.select.video import select_video
from r3jax.captures.source import source_of
from r3jax.cli.console import Console, Stages
from r3jax.cli.options.select import SelectOptions
from r3jax.files import check_own, own_folder
from r3jax.formats.captures import open_capture
from r3jax.formats.ros.bags import parse_topics
from r3jax.formats.video import is_video
from r3jax.interrupts import deferred_interrupt, settle_interrupt


def run_select(options: SelectOptions) -> int:
    """Selects frames and writes the data set and its page.

    Raises:
        ValueError, OSError: not a capture, a broken one, one without depth or points; nothing to
            choose from; a folder that holds something else; a disk that is full.
    """
    progress, console = Console(stderr=True), Console()
    if is_video(options.capture):
        return _select_video(options, progress, console)
    capture = open_capture(options.capture, "z", parse_topics(options.topics), options.terms.cut)
    source = source_of(capture.source, capture.name, can_compute=True)
    folder = options.out or Path("runs") / "select" / source.name
    check_own(folder, "selection", "give another --out")
    with Stages(progress) as stages:
        with deferred_interrupt() as is_interrupted:
            found = select(
                source,
                options.terms,
                capture=capture.source,
                on_progress=stages.on_progress,
                is_interrupted=is_interrupted,
            )
        settle_interrupt()  # it has ended the choice, and what was chosen is written
        own_folder(folder, "selection", "give another --out")
        stages.on_progress("writing the data set", len(found.kept))
        step = lambda: stages.on_progress("", 1)
        written = write_data_set(found, capture, folder, copies=options.copy, on_frame=step)
        page = write_page(found, folder, written)
    for sentence in (*lead(found), *found.notes):
        console.print(sentence)
    for what, path in {
        "data set": written.data_set,
        "numbers": written.record,
        "page": page,
    }.items():
        console.say(f"{what}  {path}")
    console.say(f"then  {commands(written)[0]}")
    return 0


def _select_video(options: SelectOptions, progress: Console, console: Console) -> int:
    """Selects frames of a video, which has no poses yet.

    Raises:
        ValueError, OSError: as `select_video`; a folder that holds something else.
    """
    folder = options.out or Path("runs") / "select" / options.capture.stem
    own_folder(folder, "selection", "give another --out")
    with Stages(progress) as stages:
        found = select_video(options.capture, options.terms.frames or 1, folder, stages.on_progress)
    console.print(
        f"{len(found.chosen)} of {len(found.motion)} frames: the sharpest, evenly spaced by "
        "motion. Compute their poses (COLMAP, ns-process-data images), then select again from "
        "the result."
    )
    console.say(f"pictures  {folder / 'images'}")
    console.say(
        f"then  ns-process-data images --data {folder / 'images'} --output-dir {folder}-posed"
    )
    return 0
