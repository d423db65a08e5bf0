"""`r3jax export`: a run as a data set of nerfstudio or COLMAP, or as a submission."""

import shlex
from pathlib import Path

from r3jax.cli.console import Console
from r3jax.cli.options.runs import ExportOptions
from r3jax.cli.progress import Stages
from r3jax.exploration.config import DEPTH_STEPS_PER_METRE
from r3jax.files import make_folder
from r3jax.formats.exports import export_run
from r3jax.formats.submissions import submission_of_run, write_submission
from r3jax.runs.reader import Run, read_run


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
    """Writes the poses of a run, and says how they are judged."""
    submission = submission_of_run(run)
    make_folder(out.parent)
    write_submission(out, submission)
    console.say(f"{len(submission.frames)} frames, {out.stat().st_size / 1000:.0f} kB")
    console.say(f"exported  {out}")
    console.next("benchmark", "--submission", out)
    return 0
