"""`r3jax replay`: do the recorded frames rebuild the stored map?"""

from r3jax.cli.console import Console
from r3jax.cli.options.runs import ReplayOptions
from r3jax.cli.progress import Stages
from r3jax.runs.reader import read_run
from r3jax.runs.replay import differences

_DIFFERS = 1
"""Exit code where the maps are not equal."""


def run_replay(options: ReplayOptions) -> int:
    """Rebuilds map and grid from the frames and compares them, array by array, bit by bit.

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
        console.say(f"{views} frames rebuild the stored map and grid, bit for bit")
        console.next("train", options.path)
        return 0
    console.say(f"{views} frames do not rebuild what is stored:")
    for difference in found:
        what = f"{difference.num_different} elements, by at most {difference.largest:g}"
        text = "another shape" if difference.num_different < 0 else what
        console.say(f"  {difference.name}: {text}")
    console.say("made by another version of this package, or on another kind of device?")
    return _DIFFERS
