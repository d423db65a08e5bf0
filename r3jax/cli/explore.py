"""`r3jax explore`: set up a run, let it go, write what comes out of it."""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from r3jax.cli.errors import UserError, one_line
from r3jax.cli.options import Explore
from r3jax.cli.progress import RunProgress
from r3jax.evaluation.report import write_report
from r3jax.exploration.budget import Budget, parse_budget
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.loop import Result, explore
from r3jax.exploration.state import StopReason
from r3jax.formats.pointcloud import voxel_points, write_points
from r3jax.formats.transforms import write_transforms
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Policy, make_policy
from r3jax.scenes.registry import open_scene, scene_hash
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.base import Simulator
from r3jax.trace.errors import RunError
from r3jax.trace.header import RunHeader, camera_fields, package_versions, plain_settings
from r3jax.trace.reader import Run, read_run
from r3jax.trace.writer import RunWriter

_PLAIN: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}
"""Text as it is: paths must stay whole for copying."""

_EXIT_CODES = {StopReason.RECORDING_STOPPED: 1, StopReason.INTERRUPTED: 130}


def run_explore(options: Explore) -> int:
    """Explores a scene and writes the data set and the report.

    Raises:
        UserError: an unknown scene or policy, a setting that cannot work, a run that exists.
    """
    console = Console(stderr=True)
    try:
        # What can be checked quickly comes before the scene is built.
        budget, config, policy = _plan(options)
        path = options.out / (options.name or _default_name(options))
        with console.status(f"opening {options.scene} ..."):
            simulator = _open(options)
        header = _header(options, budget, config, policy, simulator)
        recorder = RunWriter(path, header, overwrite=options.overwrite)
    except (ValueError, OSError) as error:
        raise UserError(one_line(error)) from error
    with recorder, RunProgress(console, budget) as progress:
        result = explore(
            simulator,
            policy,
            budget=budget,
            seed=options.seed,
            config=config,
            recorder=recorder,
            on_step=progress.on_step,
            on_stage=progress.on_stage,
        )
    _conclude(console, path, result)
    return _EXIT_CODES.get(result.reason, 0)


def _plan(options: Explore) -> tuple[Budget, ExplorationConfig, Policy]:
    """Everything but the scene."""
    if not 16 <= options.resolution <= 4096:
        raise ValueError(f"--resolution must lie between 16 and 4096, got {options.resolution}")
    config = ExplorationConfig(
        voxel_size=options.voxel_size,
        cell_size=options.cell_size,
        max_range=options.max_range,
        capacity=options.capacity,
        allow_growth=not options.fixed_capacity,
        clock=options.clock,
    )
    scoring = ScoringConfig(max_range=jnp.asarray(options.max_range, jnp.float32))
    if options.lambda1 is not None:
        lambda1 = jnp.asarray(options.lambda1, jnp.float32)
        scoring = eqx.tree_at(lambda config: config.lambda1, scoring, lambda1)
    settings: dict[str, Any] = {
        "scoring": scoring,
        "num_candidates": options.candidates,
        "lambda2": options.lambda2,
    }
    if options.candidates is not None:
        # Keeps the share that is aimed at the frontier, whatever the number.
        default = PlannerConfig()
        share = default.num_frontier / default.num_candidates
        settings["num_frontier"] = round(share * options.candidates)
    given = {name: value for name, value in settings.items() if value is not None}
    return parse_budget(options.budget), config, make_policy(options.policy, **given)


def _open(options: Explore) -> Simulator:
    start = None
    if options.start is not None:
        start = pose_along(jnp.asarray(options.start), jnp.asarray([1.0, 0.0, 0.0]))
    return open_scene(
        options.scene,
        up=options.up,
        camera=Camera.from_fov(options.resolution, options.resolution, options.fov),
        noise=options.noise,
        seed=options.seed,
        max_range=options.max_range,
        start_pose=None if start is None else np.asarray(start, dtype=np.float64),
    )


def _default_name(options: Explore) -> str:
    scene = options.scene.removeprefix("mesh:")
    stem = Path(scene).stem if scene != options.scene else scene
    return f"{stem}-{options.policy}-seed{options.seed}"


def _header(
    options: Explore,
    budget: Budget,
    config: ExplorationConfig,
    policy: Policy,
    simulator: Simulator,
) -> RunHeader:
    how = {name: getattr(options, name) for name in ("up", "noise", "max_range", "start")}
    return RunHeader(
        scene={"name": options.scene, "hash": scene_hash(simulator), **how},
        policy={"name": policy.name, "settings": plain_settings(getattr(policy, "config", {}))},
        budget=str(budget),
        seed=options.seed,
        config=dataclasses.asdict(config),
        camera=camera_fields(simulator.camera),
        bounds=np.asarray(simulator.bounds).tolist(),
        packages=package_versions(),
    )


def _conclude(console: Console, path: Path, result: Result) -> None:
    """Data set, report, and a few words; a full disk must not hide how the run ended."""
    console.print(f"{result.reason.value}: {result.message}", **_PLAIN)
    if result.state.views == 0:
        return
    try:
        with console.status("writing the data set and the report ..."):
            run = read_run(path)
            write_data_set(run, result)
            page = write_report(run, result.state.map_state, result.state.grid)
    except (RunError, OSError) as error:
        console.print(f"the report could not be written: {one_line(error)}", **_PLAIN)
        return
    last = result.rows[-1]
    console.print(
        f"{len(result.rows)} views, {last.metres:.1f} m, {last.seconds:.1f} s on the clock; "
        f"{100 * last.coverage.known_share:.0f} % of the box explored, mean renderability "
        f"{last.coverage.mean_renderability:.2f}",
        **_PLAIN,
    )
    console.print(f"data set  {path / 'transforms.json'}", **_PLAIN)
    console.print(f"report    {page}", **_PLAIN)


def write_data_set(run: Run, result: Result) -> None:
    """transforms.json and the points that 3DGS starts from."""
    points = run.path / "exports" / "points.ply"
    points.parent.mkdir(exist_ok=True)
    write_points(points, *voxel_points(result.state.map_state))
    write_transforms(run, points.relative_to(run.path).as_posix())
