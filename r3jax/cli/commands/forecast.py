"""`r3jax forecast`: what a model trained on a run would be like, from the map alone."""

from collections import deque

from r3jax.apps.forecast.forecast import Outlook
from r3jax.apps.forecast.psnr import default_calibration, read_calibration
from r3jax.apps.report.figures import LEVEL, outlook_figure, outlook_lines
from r3jax.cli.console import Console
from r3jax.cli.options.runs import ForecastOptions
from r3jax.cli.progress import Stages
from r3jax.files import check_replaceable, write_atomic
from r3jax.plots.style import PNG_MARK, to_png
from r3jax.runs.reader import read_run
from r3jax.runs.replay import states_of


def run_forecast(options: ForecastOptions) -> int:
    """Prints the forecast along the run, and what one more decibel would take.

    Raises:
        ValueError, OSError: not a run, a frame that is missing, or a file that is no calibration.
    """
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
        f"{100 * LEVEL:.0f} % of its errors in scenes that it had not seen",
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
