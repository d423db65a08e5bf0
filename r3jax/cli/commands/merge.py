"""`r3jax merge`: two runs of one scene as one data set, with the map that saw both."""

from r3jax.cli.console import Console
from r3jax.cli.options.runs import MergeOptions
from r3jax.cli.progress import Stages
from r3jax.exploration.state import describe_counts
from r3jax.formats.exports import write_data_set
from r3jax.runs.begin import merge_runs
from r3jax.runs.reader import read_run


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
    console.say(f"{views}, {int(map_state.num_occupied)} voxels")
    console.say(f"merged    {out}")
    console.next("train", out)
    return 0
