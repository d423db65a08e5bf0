"""Runs begun, gone on with, and forked: everything that `explore` is called with."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.runs.settings import (
    RunSettings,
    SceneSettings,
    new_header,
    open_run_scene,
    settings_of_run,
)
from r3jax.exploration.loop import Result
from r3jax.exploration.replay import is_decided_apart
from r3jax.exploration.step import check_world
from r3jax.files import make_folder
from r3jax.formats.nerfstudio import write_transforms
from r3jax.formats.points import voxel_points, write_points
from r3jax.planning.robot.limits import begin_at
from r3jax.planning.robot.motion import motion_of
from r3jax.simulators.base import Simulator
from r3jax.trace.header import package_versions, policy_fields
from r3jax.trace.paths import piece_of_path
from r3jax.trace.reader import Run, read_run
from r3jax.trace.rows import StepRow, unit_of
from r3jax.trace.writer import RunWriter


@dataclass(frozen=True)
class Expedition:
    """Everything that `explore` is called with."""

    settings: RunSettings
    simulator: Simulator
    recorder: RunWriter
    seed: int

    recorded: Run | None = None
    """What was recorded before; None for a new run."""

    decided_from: int = 0
    """First view that the run's own policy chose: a fork took the earlier ones over."""


def begin_run(
    settings: RunSettings, scene: SceneSettings, path: Path, *, overwrite: bool = False
) -> Expedition:
    """Opens the scene and makes the folder of a new run, in this order.

    Raises:
        ValueError: the scene is unknown, cannot be explored or begun in; or a run is there.
        ImportError: its simulator is not installed.
    """
    simulator = scene.open()
    check_world(simulator.bounds, settings.config.cell_size)  # refused before there is a folder
    begin_at(motion_of(settings.policy), simulator.start_pose)
    header = new_header(settings, scene, simulator)
    recorder = RunWriter(path, header, overwrite=overwrite)
    return Expedition(settings, simulator, recorder, scene.seed)


def resume_run(path: Path, budget: str | None = None, until: str | None = None) -> Expedition:
    """Goes on with a run that was cut off, interrupted or finished.

    Args:
        path: the run folder.
        budget: another budget; None keeps the run's.
        until: another goal; None keeps the run's.

    Raises:
        ValueError: no run that can be gone on with; says what can be done instead.
    """
    run = read_run(path)
    if run.header.is_merged:
        raise ValueError(f"{path} was merged from other runs: fork it with --fork and --at")
    if run.header.is_of_team:
        raise ValueError(
            f"{path} flew in a team: go on with `r3jax team --resume {path.parent}`, or fork it "
            "with --fork and --at"
        )
    _refuse_half_a_fork(run)
    settings = settings_of_run(run).with_limits(budget, until)
    header = None
    if (budget, until) != (None, None):
        config = asdict(settings.config)
        header = replace(run.header, budget=str(settings.budget), config=config)
    simulator = open_run_scene(run)
    recorder, run = RunWriter.resume(path, header)
    return Expedition(settings, simulator, recorder, run.header.seed, run, _decided_from(run))


def fork_run(
    run: Run, at: int, settings: RunSettings, path: Path, *, overwrite: bool = False
) -> Expedition:
    """Begins a run that takes over the first views of another.

    Args:
        run: the other one.
        at: how many of its views are taken over.
        settings: what is asked of the fork, by `settings_of_run` and then changed.
        path: folder of the fork.
        overwrite: replace the run that is there.

    Raises:
        ValueError: no such view, a scene that has changed, a frame that cannot be read, or a run
            that is there.
    """
    if not 1 <= at <= len(run.rows):
        raise ValueError(
            f"--at must lie between 1 and the run's {len(run.rows)} {unit_of(run.rows)}, got {at}"
        )
    simulator = open_run_scene(run)
    fields = policy_fields(settings.policy)
    # Asked again, a policy must know what it knew: of a merged run and of a team's that is not
    # known from the frames.
    is_alone = not (run.header.is_merged or run.header.is_of_team)
    is_same = is_alone and fields == run.header.policy
    decided_from = min(_decided_from(run), at) if is_same else at
    parent: dict[str, Any] = {"forked": str(run.path), "views": at, "decided_from": decided_from}
    if not is_alone or is_decided_apart(run):
        parent["decided_apart"] = True
    header = replace(
        run.header,
        policy=fields,
        budget=str(settings.budget),
        config=asdict(settings.config),
        packages=package_versions(),
        parent=parent,
    )
    recorder = RunWriter(path, header, overwrite=overwrite)
    try:
        for row in run.rows[:at] if is_same else _as_flown(run.rows[:at]):
            run.frame(row.step)  # says what is wrong with it
            recorder.adopt(row, run, row.step)
        recorded = read_run(recorder.path)
        return Expedition(settings, simulator, recorder, run.header.seed, recorded, decided_from)
    except BaseException:
        recorder.close()
        raise


def _refuse_half_a_fork(run: Run) -> None:
    """A fork that was cut off while it took views over would go its own way too early."""
    parent = run.header.parent or {}
    wanted = parent.get("views", 0) if "forked" in parent else 0
    if len(run.rows) < wanted:
        raise ValueError(
            f"{run.path} was cut off when it had {len(run.rows)} of the {wanted} "
            f"{unit_of(run.rows)} that it takes over from {parent['forked']}: fork again, with "
            "--overwrite"
        )


def _as_flown(rows: Sequence[StepRow]) -> list[StepRow]:
    """The rows; where a path was left on the way, with no more of it than was flown.

    Who takes over is told the path, and must not take for visited what lies ahead.
    """
    flown = list(rows)
    begins = [number for number, row in enumerate(rows) if row.choice is not None]
    for number, after in pairwise([*begins, len(rows)]):
        choice = rows[number].choice
        assert choice is not None
        length = rows[after - 1].metres - rows[number - 1].metres
        if length < choice.length - 1e-4:  # totals are rounded
            piece = piece_of_path(choice.waypoints.astype(np.float64), 0.0, length)
            cut = replace(choice, waypoints=piece.astype(np.float32), length=length)
            flown[number] = replace(rows[number], choice=cut)
    return flown


def _decided_from(run: Run) -> int:
    return int((run.header.parent or {}).get("decided_from", 0))


def write_data_set(run: Run, result: Result) -> None:
    """Writes transforms.json and the points that 3DGS starts from into the run folder.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    points = run.path / "exports" / "points.ply"
    make_folder(points.parent)
    write_points(points, *voxel_points(result.state.map_state))
    write_transforms(run, points.relative_to(run.path).as_posix())
