"""`r3jax train`: from a run or a recording to a model on disk."""

import contextlib
import csv
import hashlib
import io
import json
from collections.abc import Generator
from pathlib import Path

import numpy as np

from r3jax.cli.captures import Capture, open_capture
from r3jax.cli.console import BarColumn, Console, SpinnerColumn, TextColumn, progress_bar
from r3jax.cli.errors import UserError, check_folder_name, check_resolution, one_line
from r3jax.cli.options import Train
from r3jax.cli.selection import RECORD_FORMAT
from r3jax.files import lock_folder, write_atomic
from r3jax.formats.errors import FormatError
from r3jax.formats.pointcloud import write_points
from r3jax.formats.validation.json_text import sealed
from r3jax.splatting import train
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.harmonics import C0
from r3jax.splatting.ply import write_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training_config import TrainConfig
from r3jax.splatting.views import Views, load_views, split_views
from r3jax.trace.errors import RunError
from r3jax.trace.header import package_versions

_LOG_LINES = 10
"""Lines that a training leaves in a log."""


def run_train(options: Train) -> int:
    """Trains a model and writes it.

    Returns:
        0 done, 130 interrupted (it can be resumed).

    Raises:
        UserError: bad input, a model that exists, too little memory, training that diverged.
    """
    console = Console(stderr=True)
    try:
        config = _config(options)
        capture = open_capture(options.path, options.up)
        folder = _folder(options, capture)
        training, held_out = split_views(len(capture), options.hold_out)
        with console.status(f"reading {len(capture)} views ..."):
            views = load_views(capture.frames(), options.resolution).take(training)
        with _only_writer(options, folder):
            with TrainProgress(console, config.iterations) as progress:
                result = train.fit(
                    views,
                    config,
                    folder=folder / "checkpoints",
                    resume=options.resume,
                    overwrite=options.overwrite,
                    on_progress=progress.on_progress,
                )
            _write_model(folder, result)
            _write_record(folder / "train.json", options, config, views, training, held_out)
    except (ValueError, ArithmeticError, OSError, ImportError, RunError, FormatError) as error:
        raise UserError(one_line(error)) from error
    _conclude(console, options, folder, result)
    return 130 if result.interrupted else 0


def _config(options: Train) -> TrainConfig:
    check_resolution(options.resolution)
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


def _folder(options: Train, capture: Capture) -> Path:
    """The model's folder; one that is there is kept, unless the user says otherwise."""
    check_folder_name(options.name)
    folder = (options.out or capture.models) / options.name
    _check_free(options, folder)
    return folder


def _check_free(options: Train, folder: Path) -> None:
    present = {path.name for path in folder.iterdir()} - {"lock"} if folder.is_dir() else set[str]()
    if present and not (options.overwrite or options.resume):
        raise UserError(
            f"{folder} holds a model: --resume goes on with it, --overwrite replaces it, "
            "--name NAME makes another"
        )
    if present and not present & {"scene.ply", "train.json", "checkpoints"}:
        raise UserError(f"{folder} holds something that is not a model: give another --name")


@contextlib.contextmanager
def _only_writer(options: Train, folder: Path) -> Generator[None]:
    """Within it no other process trains this model, from its first file to its last."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = lock_folder(folder)
    except BlockingIOError:
        raise UserError(f"{folder}: another process is training here") from None
    with lock:
        _check_free(options, folder)  # another process may have been faster
        yield


def _write_record(
    path: Path,
    options: Train,
    config: TrainConfig,
    views: Views,
    training: np.ndarray,
    held_out: np.ndarray,
) -> None:
    """train.json: what the model was trained on, for `r3jax evaluate` and for the reader."""
    record = {
        "format": RECORD_FORMAT,
        "data": str(options.path),
        "resolution": max(views.width, views.height),
        "train_views": training.tolist(),
        "test_views": held_out.tolist(),
        "config": config.as_record(),
        "packages": package_versions(),
        "history_sha256": hashlib.sha256((path.parent / "history.csv").read_bytes()).hexdigest(),
    }
    write_atomic(path, json.dumps(sealed(record), indent=1).encode())


def _write_model(folder: Path, result: train.FitResult) -> None:
    """The scene, its points, and the curves."""
    write_scene(folder / "scene.ply", result.scene)
    write_points(folder / "points.ply", *scene_points(result.scene))
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["step", "loss", "psnr", "gaussians"])
    history = result.history
    for i, (loss, psnr, count) in enumerate(
        zip(history.loss, history.psnr, history.num_gaussians, strict=True)
    ):
        writer.writerow([history.first_step + i, f"{loss:.6g}", f"{psnr:.4f}", int(count)])
    write_atomic(folder / "history.csv", text.getvalue().encode())


def scene_points(scene: GaussianScene) -> tuple[np.ndarray, np.ndarray]:
    """Centers [m] and mean colors (uint8) of the Gaussians in use, [n, 3] each."""
    alive = np.asarray(scene.is_alive)
    colors = np.clip(np.asarray(scene.sh)[alive, 0] * C0 + 0.5, 0.0, 1.0)
    return np.asarray(scene.means)[alive], np.round(255.0 * colors).astype(np.uint8)


def _conclude(console: Console, options: Train, folder: Path, result: train.FitResult) -> None:
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
        console.say(f"{result.dropped} Gaussians found no room: raise --capacity for finer detail")
    console.say(f"model  {folder / 'scene.ply'}")
    if options.hold_out and not result.interrupted:
        console.say(f"next   {_next_command(options, folder)}")


def _next_command(options: Train, folder: Path) -> str:
    """What judges this model."""
    command = f"r3jax evaluate {options.path}"
    if options.out is not None:
        return f"{command} --model {folder}"
    return command if options.name == Train.name else f"{command} --name {options.name}"


class TrainProgress:
    """A bar on a terminal, ten lines in a log; hand `on_progress` to `fit`."""

    def __init__(self, console: Console, iterations: int):
        """Shows nothing before it is entered."""
        self._console, self._logged = console, -1
        self._bar = progress_bar(
            console,
            SpinnerColumn(),
            TextColumn("step {task.completed:.0f}/{task.total:.0f}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[facts]}", style="dim"),
        )
        self._task = self._bar.add_task("", total=iterations, facts="compiling on first use")

    def on_progress(self, progress: train.Progress) -> None:
        """Some steps are done."""
        facts = (
            f"loss {progress.loss:.4f}, PSNR {progress.psnr:.2f} dB, "
            f"{progress.num_gaussians} Gaussians, {progress.seconds_left:.0f} s left"
        )
        self._bar.update(self._task, completed=progress.step, facts=facts)
        line = progress.step * _LOG_LINES // progress.iterations
        if not self._console.is_terminal and line > self._logged:
            self._logged = line
            self._console.print(f"step {progress.step}: {facts}")

    def __enter__(self) -> "TrainProgress":
        """Shows the bar."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Takes the bar down."""
        self._bar.stop()
