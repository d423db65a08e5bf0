"""What a command is refused for before JAX is imported: names, budgets, paths.

Importing JAX takes a second and more, and a scene or a run may take a minute to open: a slip of
the keyboard should be told at once. Nothing here imports JAX.
"""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

from r3jax.apps.forecast.goal import parse_goal
from r3jax.cli.errors import UserError, check_folder_name, check_resolution, one_line
from r3jax.cli.options import (
    Audit,
    Benchmark,
    Demo,
    Evaluate,
    Explore,
    Export,
    Forecast,
    Info,
    Merge,
    Replay,
    Team,
    Train,
    View,
)
from r3jax.exploration.budget import parse_budget
from r3jax.exploration.config import ExplorationConfig
from r3jax.planning.motion import Motion, make_motion
from r3jax.planning.policies import check_policy
from r3jax.simulators.scenes.names import check_scene

DEFAULT_POLICY = "ours-pano"
DEFAULT_BUDGET = "views:100"

LEAST_CAPACITY = 1 << 14
"""Rows that a map which may grow has at the start: all is compiled anew whenever it doubles."""


def check_options(options: object) -> None:
    """Refuses what can be seen to be wrong at once.

    Raises:
        UserError: an unknown name, a budget or a setting that cannot work, a path that leads
            nowhere.
    """
    try:
        _check(options)
    except (ValueError, OSError) as error:
        raise UserError(one_line(error)) from error


@functools.singledispatch
def _check(options: object) -> None:
    """By kind of options; some commands take nothing that could be wrong."""


@_check.register
def _(options: Demo) -> None:
    parse_budget(f"views:{options.views}")
    loop_of_options(Explore(resolution=options.resolution))
    check_resolution(options.train_resolution)
    _check_folder(options.out)


@_check.register
def _(options: Explore) -> None:
    if options.name is not None:
        check_folder_name(options.name)
    if options.resume is not None and options.fork is not None:
        raise ValueError("--resume goes on with a run, --fork begins another one: give one of them")
    if (options.at is None) != (options.fork is None):
        raise ValueError("--fork RUN and --at VIEW belong together")
    old = options.resume or options.fork
    if old is not None:
        _check_run(old)
    elif options.scene is None:
        raise ValueError("give a --scene, or --resume RUN; `r3jax info` lists the scenes")
    else:
        check_scene(options.scene, options.scale)
        policy = options.policy or DEFAULT_POLICY
        name = options.name or default_name(options, options.scene, policy)
        _check_free(options.out / name, options.overwrite)
    if options.policy is not None:
        _check_policy(options.policy)
    if options.budget is not None:
        parse_budget(options.budget)
    loop_of_options(options)
    motion_of_options(options)


@_check.register
def _(options: Team) -> None:
    if options.name is not None:
        check_folder_name(options.name)
    if options.budget is not None:
        parse_budget(options.budget)
    if options.resume is not None:
        _check_run(options.resume / "0")
        return
    if options.scene is None:
        raise ValueError("give a --scene, or --resume TEAM; `r3jax info` lists the scenes")
    check_scene(options.scene, options.scale)
    if not options.meet_every >= 0.0:
        raise ValueError(f"--meet-every must be a time >= 0 [s], got {options.meet_every}")
    for single in singles_of(options):
        _check_policy(single.policy or DEFAULT_POLICY)
        loop_of_options(single)
    _check_free(team_folder(options, options.scene) / "0", options.overwrite)


@_check.register
def _(options: Benchmark) -> None:
    for scene in words(options.scenes):
        check_scene(scene, options.scale)
    for policy in words(options.policies):
        _check_policy(policy)
    for budget in (options.budget, *words(options.snapshots or "")):
        parse_budget(budget)
    seeds_of(options)
    _check_folder(options.out)


@_check.register
def _(options: Train) -> None:
    check_folder_name(options.name)
    check_resolution(options.resolution)
    check_capture(options.path)


@_check.register
def _(options: Evaluate) -> None:
    check_folder_name(options.name)
    check_resolution(options.resolution)
    if options.worst < 0:
        raise ValueError(f"--worst must not be negative, got {options.worst}")
    check_capture(options.path)


@_check.register
def _(options: Audit) -> None:
    check_capture(options.capture)
    if options.out is not None:
        _check_folder(options.out)
    if options.path is not None and not options.path.exists():
        raise UserError(f"{options.path}: there is no such folder or file")


@_check.register
def _(options: Info) -> None:
    if options.path is not None:
        check_capture(options.path)


@_check.register(Replay)
@_check.register(Forecast)
@_check.register(Export)
def _(options: Replay | Forecast | Export) -> None:
    _check_run(options.path)


@_check.register
def _(options: View) -> None:
    _check_run(options.path)
    if options.name is not None:
        check_folder_name(options.name)


@_check.register
def _(options: Merge) -> None:
    for path in (options.first, options.second):
        _check_run(path)


def _check_policy(name: str) -> None:
    """Refuses a policy that is not there; a class may be in the folder that the user is in.

    Raises:
        ValueError: as `check_policy`.
    """
    here = str(Path.cwd())
    if ":" in name and here not in sys.path:
        sys.path.insert(0, here)
    check_policy(name)


def loop_of_options(options: Explore) -> ExplorationConfig:
    """What the loop of a new run is told.

    Raises:
        ValueError: a setting that cannot work.
    """
    if not 16 <= options.resolution <= 4096:
        raise ValueError(f"--resolution must lie between 16 and 4096, got {options.resolution}")
    if not 0 <= options.seed < 1 << 32:
        raise ValueError(f"--seed must lie between 0 and 2^32 - 1, got {options.seed}")
    if options.until is not None:
        parse_goal(options.until)
    config = ExplorationConfig(
        voxel_size=options.voxel_size,
        cell_size=options.cell_size,
        max_range=options.max_range,
        capacity=options.capacity,
        allow_growth=not options.fixed_capacity,
        clock=options.clock,
        until=options.until,
    )
    if config.allow_growth and config.capacity < LEAST_CAPACITY:
        config = dataclasses.replace(config, capacity=LEAST_CAPACITY)
    config.check_scales()
    return config


def motion_of_options(options: Explore) -> Motion:
    """What carries the camera: a preset, and what the options change of it.

    Raises:
        ValueError: a setting that cannot work.
    """
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(Motion)}
    return make_motion(options.motion, **{k: v for k, v in given.items() if v is not None})


def default_name(options: Explore, scene: str, policy: str) -> str:
    """A run's name where none is given."""
    kind, colon, rest = scene.partition(":")
    stem = Path(rest).stem if colon else scene
    if kind == "habitat" and colon:
        stem = f"habitat-{stem.removesuffix('.stage_config')}"
    motion = "" if options.motion == "free" else f"-{options.motion}"
    own = policy.rpartition(":")[2]  # of package.module:Class
    return f"{stem}-{own}{motion}-seed{options.seed}"


def team_folder(options: Team, scene: str) -> Path:
    """The folder of a new team."""
    stem = Path(scene.partition(":")[2] or scene).stem
    return options.out / (options.name or f"{stem}-team{options.cameras}-seed{options.seed}")


def singles_of(options: Team) -> list[Explore]:
    """The options of each camera as if it flew alone.

    Raises:
        ValueError: neither one value for all cameras nor one for each.
    """
    if not 1 <= options.cameras <= 16:
        raise ValueError(f"--cameras must lie between 1 and 16, got {options.cameras}")
    for name in ("policy", "fov", "resolution"):
        num = len(getattr(options, name))
        if num not in (1, options.cameras):
            raise ValueError(
                f"--{name} takes one value for all {options.cameras} cameras or one for each, "
                f"got {num}"
            )
    shared: dict[str, Any] = {
        field.name: getattr(options, field.name)
        for field in dataclasses.fields(options)
        if field.name not in ("cameras", "policy", "fov", "resolution", "meet_every")
    }
    return [
        Explore(
            **shared,
            policy=options.policy[number % len(options.policy)],
            fov=options.fov[number % len(options.fov)],
            resolution=options.resolution[number % len(options.resolution)],
        )
        for number in range(options.cameras)
    ]


def words(text: str) -> tuple[str, ...]:
    """What stands between commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def seeds_of(options: Benchmark) -> tuple[int, ...]:
    """The seeds of a benchmark.

    Raises:
        ValueError: not whole numbers.
    """
    try:
        return tuple(int(seed) for seed in words(options.seeds))
    except ValueError:
        raise ValueError(f"--seeds are whole numbers with commas, got {options.seeds!r}") from None


def _check_run(path: Path) -> None:
    """Refuses what is no folder of a run."""
    if not path.is_dir():
        what = "this is a file; a run is a folder" if path.exists() else "there is no such folder"
        raise UserError(f"{path}: {what}")
    if not (path / "run.json").exists():
        raise UserError(f"{path}: this folder is not a run (it has no run.json)")


def _check_free(folder: Path, overwrite: bool) -> None:
    """Refuses to begin a run where one is, unless it is to be replaced."""
    if (folder / "run.json").exists() and not overwrite:
        raise UserError(
            f"{folder}: the run exists already: choose another name or give --overwrite"
        )


def _check_folder(path: Path) -> None:
    """Refuses a file where a folder is to be written, and what no folder can be called."""
    if "\0" in str(path):
        raise UserError("--out: this cannot be the name of a folder")
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: this is a file, --out is a folder")


def check_capture(path: Path) -> None:
    """Refuses what is neither a folder nor nerfstudio's file.

    Raises:
        UserError: says what a capture is.
    """
    if not path.exists():
        raise UserError(f"{path}: there is no such folder")
    if path.is_file() and path.suffix != ".json":
        raise UserError(f"{path}: this is a file; {_advice(path)}")


def _advice(path: Path) -> str:
    if path.suffix.lower() == ".r3d":
        return (
            "the archives of Record3D are not read: make nerfstudio's transforms.json of it, with "
            "a depth_file_path for every frame"
        )
    return "a capture is a folder, or nerfstudio's transforms.json"
