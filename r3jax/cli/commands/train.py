"""`r3jax train`: from a run or a recording to a model on disk."""

from pathlib import Path

from r3jax.cli.console import Console
from r3jax.cli.errors import UserError, check_folder_name, check_resolution, one_line
from r3jax.cli.options import TrainOptions
from r3jax.cli.options.parsing import given_words
from r3jax.cli.progress import Stages, TrainProgress
from r3jax.files import own_folder
from r3jax.formats.captures import open_capture
from r3jax.formats.points import write_points
from r3jax.formats.ros.bags import parse_topics
from r3jax.runs.header import package_versions
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.model import check_free, only_writer, scene_points, write_model
from r3jax.splatting.training import train
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.views import load_views, split_views


def run_train(options: TrainOptions) -> int:
    """Trains a model and writes it.

    Returns:
        0 done, 130 interrupted (it can be resumed).

    Raises:
        UserError: bad input, a model that exists, too little memory, training that diverged.
    """
    console = Console(stderr=True)
    try:
        check_resolution(options.resolution)
        check_folder_name(options.name)
        config = _config(options)
        capture = open_capture(options.path, options.up, parse_topics(options.topics))
        folder = (options.out or capture.models) / options.name
        replace = options.overwrite or options.resume
        check_free(folder, replace=replace)
        split = split_views(len(capture), options.hold_out)
        with Stages(console) as stages:
            frames = stages.each("reading the views", capture.frames(), len(capture))
            views = load_views(frames, options.resolution).take(split[0])
        if capture.run is not None and options.out is None:
            own_folder(capture.path, "run")
        with only_writer(folder, replace=replace):
            with TrainProgress(console, config.iterations) as progress:
                result = train.fit(
                    views,
                    config,
                    folder=folder / "checkpoints",
                    resume=options.resume,
                    overwrite=options.overwrite,
                    on_progress=progress.on_progress,
                )
            write_points(folder / "points.ply", *scene_points(result.scene))
            write_model(folder, result, options.path, views, split, config, package_versions())
    except (ValueError, ArithmeticError, OSError, ImportError) as error:
        raise UserError(one_line(error)) from error
    _conclude(console, options, folder, result)
    return 130 if result.interrupted else 0


def _config(options: TrainOptions) -> TrainConfig:
    return TrainConfig(
        iterations=options.iterations,
        strategy=options.strategy,
        num_gaussians=options.gaussians,
        capacity=options.capacity,
        views_per_step=options.views_per_step,
        background=options.background,
        raster=RasterConfig(backend=options.backend),
        seed=options.seed,
    )


def _conclude(
    console: Console, options: TrainOptions, folder: Path, result: train.FitResult
) -> None:
    history = result.history
    done = history.first_step + len(history.loss) - 1
    if result.interrupted:
        console.say(f"interrupted after step {done}; the same command with --resume goes on")
    if len(history.psnr):
        latest = history.psnr[-100:].mean()
        console.say(
            f"{done} steps, {int(history.num_gaussians[-1])} Gaussians, PSNR of the latest "
            f"training views {latest:.2f} dB",
        )
    if result.dropped:
        console.say(
            f"Capacity reached, {result.dropped} Gaussians dropped; "
            "increase --capacity for more detail"
        )
    console.say(f"model     {folder / 'scene.ply'}")
    if result.interrupted:
        return
    which = () if options.name == TrainOptions.name else ("--name", options.name)
    where = which if options.out is None else ("--model", folder)
    how = () if options.hold_out else ("--views", "all")
    console.next("evaluate", options.path, *where, *how, *given_words(options, ("up", "topics")))
