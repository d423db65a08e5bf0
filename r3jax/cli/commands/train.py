"""`r3jax train`: from a run or a recording to a model on disk."""

from pathlib import Path

from r3jax.cli.console import Console
from r3jax.cli.errors import one_line
from r3jax.cli.options.splats import ModelFolderOptions, TrainOptions
from r3jax.cli.parsing import given_words, settings_for
from r3jax.cli.progress import Stages, TrainProgress
from r3jax.errors import InputError
from r3jax.files import own_folder
from r3jax.formats.captures import open_capture
from r3jax.formats.points import write_points
from r3jax.formats.ros.bags import parse_topics
from r3jax.runs.header import package_versions
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.errors import TrainingDiverged
from r3jax.splatting.model import check_free, only_writer, scene_points, write_model
from r3jax.splatting.training import train
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.views import load_views, split_views


def run_train(options: TrainOptions) -> int:
    """Trains a model and writes it.

    Returns:
        0 done, 130 interrupted (it can be resumed).

    Raises:
        InputError: training that diverged.
        ValueError, OSError, ImportError: bad input, a model that exists, too little memory.
    """
    console = Console(stderr=True)
    config = TrainConfig(
        num_gaussians=options.model.gaussians,
        raster=RasterConfig(backend=options.reading.backend),
        **settings_for(TrainConfig, options),
    )
    capture = open_capture(options.path, options.reading.up, parse_topics(options.reading.topics))
    folder = (options.folder.out or capture.models) / options.folder.name
    resume, overwrite = options.folder.resume, options.folder.overwrite
    check_free(folder, replace=overwrite or resume)
    split = split_views(len(capture), options.hold_out)
    with Stages(console) as stages:
        frames = stages.each("reading the views", capture.frames(), len(capture))
        views = load_views(frames, options.resolution).take(split[0])
    if capture.run is not None and options.folder.out is None:
        own_folder(capture.path, "run")
    try:
        with only_writer(folder, replace=overwrite or resume):
            with TrainProgress(console, config.iterations) as progress:
                result = train.fit(
                    views,
                    config,
                    folder=folder / "checkpoints",
                    resume=resume,
                    overwrite=overwrite,
                    on_progress=progress.on_progress,
                )
            write_points(folder / "points.ply", *scene_points(result.scene))
            write_model(folder, result, options.path, views, split, config, package_versions())
    except TrainingDiverged as error:
        raise InputError(one_line(error)) from error
    _conclude(console, options, folder, result)
    return 130 if result.interrupted else 0


def _conclude(
    console: Console, options: TrainOptions, folder: Path, result: train.FitResult
) -> None:
    history = result.history
    done = history.first_step + len(history.loss) - 1
    if result.interrupted:
        console.say(f"interrupted after step {done}; add --resume to the same command to go on")
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
    name = options.folder.name
    which = () if name == ModelFolderOptions.name else ("--name", name)
    where = which if options.folder.out is None else ("--model", folder)
    how = () if options.hold_out else ("--views", "all")
    console.next("evaluate", options.path, *where, *how, *given_words(options, ("up", "topics")))
