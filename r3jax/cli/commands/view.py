"""`r3jax view`: a run in the browser, or as images and a film without one."""

import contextlib
import time
from pathlib import Path

from r3jax.apps.viewer.film import export_film, load_av
from r3jax.cli.console import Console
from r3jax.cli.errors import check_viser
from r3jax.cli.options.runs import ViewOptions
from r3jax.cli.progress import Stages
from r3jax.errors import InputError
from r3jax.interrupts import deferred_interrupt, end_process
from r3jax.network import exposure_warning
from r3jax.runs.reader import Run, read_run
from r3jax.runs.settings import config_of


def run_view(options: ViewOptions) -> int:
    """Shows a run until Ctrl-C, or writes its images.

    Raises:
        InputError: no views yet.
        ValueError, OSError, ImportError: not a run, a port that is in use, a folder that holds
            something, a missing package.
    """
    console = Console(stderr=True)
    run = read_run(options.path)
    if not run.rows:
        raise InputError(f"{run.path}: the run has no views yet: there is nothing to see")
    config_of(run)  # says what is wrong with it
    if options.export is not None:
        return _export(run, options.export, options.video, console)
    _show(options, run, console)
    return 0


def _show(options: ViewOptions, run: Run, console: Console) -> None:
    """Shows the page until Ctrl-C.

    Raises:
        InputError: viser is not installed.
        ValueError, OSError: as `open_run_page`.
    """
    check_viser()
    from r3jax.apps.viewer.recorded import open_run_page  # needs viser

    if warning := exposure_warning(options.host, "sees the page, and can use it"):
        console.say(warning, style="yellow")
    with contextlib.ExitStack() as stack:
        page = open_run_page(
            run,
            host=options.host,
            port=options.port,
            allow=options.allow,
            model=options.name,
            with_scene=not options.no_scene,
        )
        with console.status("opening the run ..."):
            shown = stack.enter_context(page)
        with deferred_interrupt() as was_interrupted:
            console.say(f"view      {shown.url}")
            console.say("Ctrl-C ends it")  # from here on, and not only once this waits
            while not was_interrupted():
                time.sleep(0.1)
        # The page writes nothing, and what it works on may take half a minute yet.
        end_process(0)


def _export(run: Run, out: Path, video: bool, console: Console) -> int:
    """Writes the images.

    Raises:
        FormatError, RunError, ImportError, OSError: as `export_film`.
    """
    if video:
        load_av()  # says what is missing before an hour has passed
    with Stages(console) as stages:
        written = export_film(
            run, out, video=video, on_picture=lambda done, total: stages.at("drawing", done, total)
        )
    for path in written:
        console.say(f"written   {path}")
    return 0
