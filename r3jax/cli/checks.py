"""What a command is refused for before JAX is imported: names, budgets, paths.

Importing JAX takes a second and more, and a scene or a run may take a minute to open: a slip of
the keyboard should be told at once. Nothing here imports JAX.
"""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

from r3jax.apps.forecast.psnr import parse_goal
from r3jax.cli.errors import UserError, check_folder_name, check_resolution, one_line
from r3jax.cli.options import (
    AuditOptions,
    BenchmarkOptions,
    DemoOptions,
    EvaluateOptions,
    ExploreOptions,
    ExportOptions,
    ForecastOptions,
    InfoOptions,
    MergeOptions,
    ReplayOptions,
    TeamOptions,
    TrainOptions,
    ViewOptions,
)
from r3jax.exploration.config import LEAST_PIECE, ExplorationConfig, parse_budget
from r3jax.files import check_own
from r3jax.formats.errors import check_capture
from r3jax.formats.ros.bags import parse_topics
from r3jax.planning.policies import check_policy
from r3jax.planning.policies.foreign.commands import short_name
from r3jax.planning.robot.motion import Motion, make_motion
from r3jax.simulators.scenes.names import check_scene

DEFAULT_POLICY = "ours-pano"
DEFAULT_BUDGET = "views:100"

LEAST_CAPACITY = 1 << 14
"""Rows that a map which may grow has at the start: all is compiled anew whenever it doubles."""


_WITH_RESUME = ("resume", "budget", "until", "live", "port")
_WITH_FORK = (
    "fork", "at", "policy", "budget", "until", "name", "out", "overwrite", "candidates", "lambda1",
    "lambda2", "refine", "live", "port",
)  # fmt: skip
_WITH_SUBMISSION = (
    "submission", "check", "scenes", "snapshots", "out", "train_resolution", "iterations",
    "gaussians", "capacity", "test_views", "lpips", "backend", "engine", "jobs", "slurm",
)  # fmt: skip
_WITH_PHOTOS = (
    "photos", "choose", "first", "nearest", "every", "policies", "seeds", "out", "up",
    "max_range", "voxel_size", "train_resolution", "iterations", "gaussians", "capacity", "lpips",
    "backend",
)  # fmt: skip
"""Options that make sense beside these; all others are fixed by what was recorded."""


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
def _(options: DemoOptions) -> None:
    parse_budget(f"views:{options.views}")
    loop_of_options(ExploreOptions(resolution=options.resolution))
    check_resolution(options.train_resolution)
    _check_folder(options.out)


@_check.register
def _(options: ExploreOptions) -> None:
    if options.name is not None:
        check_folder_name(options.name)
    if options.resume is not None and options.fork is not None:
        raise ValueError("--resume goes on with a run, --fork begins another one: give one of them")
    if (options.at is None) != (options.fork is None):
        raise ValueError("--fork RUN and --at FRAME belong together")
    if options.resume is not None:
        _refuse_others(options, "--resume", _WITH_RESUME)
        _check_run(options.resume)
    elif options.fork is not None:
        _refuse_others(options, "--fork", _WITH_FORK)
        _check_run(options.fork)
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
    config, motion = loop_of_options(options), motion_of_options(options)
    _check_captures(options, config, motion)


@_check.register
def _(options: TeamOptions) -> None:
    if options.name is not None:
        check_folder_name(options.name)
    if options.budget is not None:
        parse_budget(options.budget)
    if options.resume is not None:
        _refuse_others(options, "--resume", ("resume", "budget"))
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
def _(options: BenchmarkOptions) -> None:
    if options.site is not None:
        _refuse_others(options, "--site", ("site", "out"))
        _check_folder(options.site)
    if options.submission:
        _refuse_others(options, "--submission", _WITH_SUBMISSION)
        for path in options.submission:
            if not path.is_file():
                what = "there is no such file"
                if path.is_dir():
                    what = "this is a folder; a submission is a file"
                raise UserError(f"{path}: {what}")
        if options.scenes != BenchmarkOptions.scenes and not options.scenes.startswith("mesh:"):
            raise ValueError("--scenes tells where the mesh of a submission lies: mesh:<file>")
    elif options.check:
        raise ValueError("--check belongs to --submission FILE")
    if options.photos:
        _refuse_others(options, "--photos", _WITH_PHOTOS)
        check_resolution(options.train_resolution)
        for path in options.photos:
            check_capture(path)
    for scene in words(options.scenes):
        check_scene(scene, options.scale)
    for policy in words(options.policies):
        _check_policy(policy)
    for budget in (options.budget, *words(options.snapshots or "")):
        parse_budget(budget)
    seeds_of(options)
    if options.jobs < (1 if options.engine == "slurm" else 0):
        raise ValueError(f"--jobs must not be negative (slurm: at least 1), got {options.jobs}")
    _check_folder(options.out)


@_check.register
def _(options: TrainOptions) -> None:
    check_folder_name(options.name)
    check_resolution(options.resolution)
    parse_topics(options.topics)
    check_capture(options.path)


@_check.register
def _(options: EvaluateOptions) -> None:
    check_folder_name(options.name)
    check_resolution(options.resolution)
    if options.worst < 0:
        raise ValueError(f"--worst must not be negative, got {options.worst}")
    parse_topics(options.topics)
    check_capture(options.path)


@_check.register
def _(options: AuditOptions) -> None:
    parse_topics(options.topics)
    if options.live:
        _check_live(options.capture)
    else:
        check_capture(options.capture)
    if options.live and options.path is not None:
        raise ValueError("--live follows a capture, --path judges a path in one: give one of them")
    if not options.live and (options.port, options.host) != (AuditOptions.port, AuditOptions.host):
        raise ValueError("--port and --host are for the page of --live")
    if not 0 <= options.port <= 65535:
        raise ValueError(f"--port must lie between 0 and 65535, got {options.port}")
    if options.out is not None:
        _check_folder(options.out)
        _check_replaceable(options.out)
    if options.path is not None and not options.path.exists():
        raise UserError(f"{options.path}: there is no such folder or file")


_GROWING = (".json", ".mcap", ".db3", ".bag", ".active")
"""Suffixes of files that may grow; of those that may not be followed their reader says why."""


def _check_live(path: Path) -> None:
    """Refuses what does not grow, and what can never come to be, such as the name of a topic."""
    if path.is_file() and path.suffix not in _GROWING:
        raise ValueError(f"{path}: this is a file that does not grow; --live is without")
    if path.exists() or path.absolute().parent.is_dir():
        return
    raise ValueError(
        f"{path}: there is no such capture, and no folder in which it could be recorded. Topics of "
        "a running ROS 2 are followed by the node, which shows the same page: python "
        f"examples/ros2_node.py --ros-args -p page_port:=8080 -r color:={path} -r depth:=... -r "
        "camera_info:=...; or follow a bag: ros2 bag record -o drive --storage mcap TOPICS, and "
        "r3jax audit drive --live"
    )


@_check.register
def _(options: InfoOptions) -> None:
    if options.path is not None:
        check_capture(options.path)


@_check.register(ReplayOptions)
@_check.register(ForecastOptions)
def _(options: ReplayOptions | ForecastOptions) -> None:
    _check_run(options.path)


@_check.register
def _(options: ExportOptions) -> None:
    _check_run(options.path)
    if options.format == "submission":
        if options.out.exists():
            raise UserError(f"{options.out}: something is there already: give another file")
        return
    _check_folder(options.out)
    if options.out.is_dir() and any(options.out.iterdir()):
        raise UserError(f"{options.out}: something is there already: give another folder")


@_check.register
def _(options: ViewOptions) -> None:
    _check_run(options.path)
    if options.name is not None:
        check_folder_name(options.name)
    if options.video and options.export is None:
        raise ValueError("--video belongs to --export FOLDER")


@_check.register
def _(options: MergeOptions) -> None:
    for path in (options.first, options.second):
        _check_run(path)
    if options.first.samefile(options.second):
        raise UserError(
            f"{options.first}: a run is not merged with itself: give two different runs"
        )


def _refuse_others(
    options: ExploreOptions | TeamOptions | BenchmarkOptions, flag: str, allowed: tuple[str, ...]
) -> None:
    """A setting that would be ignored is a mistake.

    Raises:
        ValueError: one was given beside `flag`; names it.
    """
    fields = [field for field in dataclasses.fields(options) if field.name not in allowed]
    given = [field.name for field in fields if getattr(options, field.name) != field.default]
    if given:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        sources = {"--submission": "submission", "--site": "records", "--photos": "captures"}
        source = sources.get(flag, "recorded run")
        raise ValueError(f"{flag} takes these from the {source}, leave them out: {names}")


def _check_policy(name: str) -> None:
    """Refuses a policy that is not there; a class may be in the folder that the user is in.

    Raises:
        ValueError: as `check_policy`.
    """
    here = str(Path.cwd())
    if ":" in name and here not in sys.path:
        sys.path.insert(0, here)
    check_policy(name)


def loop_of_options(options: ExploreOptions) -> ExplorationConfig:
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
        capture_every=options.capture_every,
        capture_rate=options.capture_rate,
        gaze=options.gaze,
        exposure=options.exposure,
        blur=options.blur,
        plan_while_moving=options.plan_while_moving,
    )
    if config.allow_growth and config.capacity < LEAST_CAPACITY:
        config = dataclasses.replace(config, capacity=LEAST_CAPACITY)
    config.check_scales()
    return config


def _check_captures(options: ExploreOptions, config: ExplorationConfig, motion: Motion) -> None:
    """Refuses settings of the frames on the way that would be ignored, or not be kept.

    Raises:
        ValueError: names one, and says what to add or leave out.
    """
    default = ExploreOptions()
    for name in ("gaze", "exposure", "blur"):
        if getattr(options, name) != getattr(default, name) and not config.captures:
            raise ValueError(
                f"--{name} is for frames on the way: add --capture-every or --capture-rate, or "
                "leave it out"
            )
    if options.blur != default.blur and options.exposure == 0.0:
        raise ValueError("--blur does nothing while nothing blurs: add --exposure, or leave it out")
    largest = (motion.speed or config.speed) / LEAST_PIECE
    if config.capture_rate is not None and config.capture_rate > largest * (1.0 + 1e-9):
        raise ValueError(
            f"--capture-rate must be at most {largest:g} Hz at this speed, one frame every "
            f"{LEAST_PIECE:g} m, got {config.capture_rate:g}"
        )


def motion_of_options(options: ExploreOptions) -> Motion:
    """What carries the camera: a preset, and what the options change of it.

    Raises:
        ValueError: a setting that cannot work.
    """
    names = [field.name for field in dataclasses.fields(Motion)]
    given = {name: getattr(options, name, None) for name in names}
    return make_motion(options.motion, **{k: v for k, v in given.items() if v is not None})


def default_name(options: ExploreOptions, scene: str, policy: str) -> str:
    """A run's name where none is given."""
    kind, colon, rest = scene.partition(":")
    stem = Path(rest).stem if colon else scene
    if kind == "habitat" and colon:
        stem = f"habitat-{stem.removesuffix('.stage_config')}"
    motion = "" if options.motion == "free" else f"-{options.motion}"
    return f"{stem}-{short_name(policy)}{motion}-seed{options.seed}"


def team_folder(options: TeamOptions, scene: str) -> Path:
    """The folder of a new team."""
    stem = Path(scene.partition(":")[2] or scene).stem
    return options.out / (options.name or f"{stem}-team{options.cameras}-seed{options.seed}")


def singles_of(options: TeamOptions) -> list[ExploreOptions]:
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
        ExploreOptions(
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


def seeds_of(options: BenchmarkOptions) -> tuple[int, ...]:
    """The seeds of a benchmark.

    Raises:
        ValueError: not whole numbers, or one that no training takes.
    """
    try:
        seeds = tuple(int(seed) for seed in words(options.seeds))
    except ValueError:
        raise ValueError(f"--seeds are whole numbers with commas, got {options.seeds!r}") from None
    for seed in seeds:
        if not 0 <= seed < 1 << 31:
            raise ValueError(f"--seeds must lie between 0 and 2^31 - 1, got {seed}")
    return seeds


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


def _check_replaceable(folder: Path) -> None:
    """Refuses to write an audit over anything but an earlier one."""
    try:
        check_own(folder, "audit", "give another --out")
    except OSError as error:
        raise UserError(one_line(error)) from error


def _check_folder(path: Path) -> None:
    """Refuses a file where a folder is to be written, and what no folder can be called."""
    if "\0" in str(path):
        raise UserError("--out: this cannot be the name of a folder")
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: this is a file, --out is a folder")
