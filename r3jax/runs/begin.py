"""Begins, resumes, forks and merges runs."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.errors import InputError
from r3jax.exploration.guard import first_pose
from r3jax.exploration.taken_views import StepRow, unit_of
from r3jax.mapping.state import MapState
from r3jax.planning.planner import start
from r3jax.planning.robot.motion import motion_of
from r3jax.runs.header import RunError, RunHeader, package_versions, policy_fields
from r3jax.runs.reader import Run, read_run
from r3jax.runs.replay import check_alike, is_decided_apart, parts_of, rebuild
from r3jax.runs.rows import piece_of_path
from r3jax.runs.settings import (
    RunSettings,
    SceneSettings,
    new_header,
    open_run_scene,
    settings_of_run,
)
from r3jax.runs.stored_states import planner_tables
from r3jax.runs.writer import RunWriter
from r3jax.simulators.base import Simulator


@dataclass(frozen=True)
class Expedition:
    """The arguments of `explore`."""

    settings: RunSettings
    simulator: Simulator
    recorder: RunWriter
    seed: int

    recorded: Run | None = None
    """The earlier record; None for a new run."""

    decided_from: int = 0
    """First view chosen by the run's own policy; earlier ones were taken over by a fork."""


def begin_run(
    settings: RunSettings, scene: SceneSettings, path: Path, *, overwrite: bool = False
) -> Expedition:
    """Opens the scene, then makes the folder of a new run.

    Raises:
        ValueError: the scene is unknown or cannot be explored, or the run exists.
        ImportError: its simulator is not installed.
    """
    simulator = scene.open()
    # Refused before there is a folder.
    pose = first_pose(simulator, motion_of(settings.policy), settings.config)
    if settings.config.tiles:  # not for every policy
        start(simulator.camera, simulator.bounds, settings.policy, starts=[pose],
              config=settings.config)  # fmt: skip
    header = new_header(settings, scene, simulator)
    recorder = RunWriter(path, header, overwrite=overwrite)
    return Expedition(settings, simulator, recorder, scene.seed)


def resume_run(path: Path, budget: str | None = None, until: str | None = None) -> Expedition:
    """Resumes a run that was interrupted or has finished.

    Args:
        path: the run folder.
        budget: another budget; None keeps the run's.
        until: another goal; None keeps the run's.

    Raises:
        ValueError: a run that cannot be resumed; says what to do instead.
    """
    run = read_run(path)
    if run.header.is_merged:
        raise InputError(f"{path} was merged from other runs: fork it with --fork and --at")
    if run.header.is_of_team:
        raise InputError(
            f"{path} is part of a team: resume it with `r3jax team --resume {path.parent}`, "
            "or fork it with --fork and --at"
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
    """Begins a run with the first views of another run.

    Args:
        run: the other run.
        at: number of its views to take over.
        settings: of the fork: changed settings of `settings_of_run`.
        path: folder of the fork.
        overwrite: replace the run that is there.

    Raises:
        ValueError: no such view, a scene that has changed, a frame that cannot be read, or a run
            that exists.
    """
    if not 1 <= at <= len(run.rows):
        raise InputError(
            f"--at must lie between 1 and the run's {len(run.rows)} {unit_of(run.rows)}, got {at}"
        )
    simulator = open_run_scene(run)
    fields = policy_fields(settings.policy)
    # To decide again, a policy needs its earlier map, which frames of a merged run or a team do not
    # give.
    is_alone = not (run.header.is_merged or run.header.is_of_team)
    # Earlier versions also recorded the limits of a program.
    is_same = is_alone and fields.items() <= run.header.policy.items()
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
    """Refuses a fork that was interrupted while it took views over: it would diverge too early."""
    parent = run.header.parent or {}
    wanted = parent.get("views", 0) if "forked" in parent else 0
    if len(run.rows) < wanted:
        raise InputError(
            f"{run.path} was interrupted after {len(run.rows)} of the {wanted} "
            f"{unit_of(run.rows)} that it takes over from {parent['forked']}: fork again, with "
            "--overwrite"
        )


def _as_flown(rows: Sequence[StepRow]) -> list[StepRow]:
    """Cuts the path of a choice to its traveled part, if it was left before its end.

    The new policy gets the path, and must not count the rest as visited.
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


def merge_runs(
    runs: list[Run],
    out: Path,
    *,
    overwrite: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> MapState:
    """Writes a run with the views of several runs, one after the other.

    Rows are numbered consecutively, and totals (clock, path, angle) are continued; the coverage in
    a row is that of its own run's map. The stored map and grid contain all frames.

    Args:
        runs: of one scene, mapped on the same terms, with the same camera.
        out: folder of the merged run.
        overwrite: replace the run that is there.
        on_frame: called after every mapped frame.

    Returns:
        The map.

    Raises:
        RunError: the runs do not match, cannot be read, or `out` cannot be written.
    """
    _check_apart(runs)
    for run in runs[1:]:
        check_alike(runs[0], run)
        if run.header.camera != runs[0].header.camera:
            raise RunError(
                run.path,
                f"its camera is not that of {runs[0].path}, and a run has one: {run.header.camera} "
                f"instead of {runs[0].header.camera}",
            )
    planner = rebuild(runs, on_frame=on_frame)
    with RunWriter(out, _header(runs), overwrite=overwrite) as writer:
        last: StepRow | None = None
        for run in runs:
            before = last
            for row in run.rows:
                last = _behind(row, before)
                writer.adopt(last, run, row.step)
        writer.checkpoint(writer.views - 1, planner_tables(planner), wait=True)
        writer.finish("merged", f"the views of {' and '.join(str(run.path) for run in runs)}")
    return planner.whole_map


def _check_apart(runs: list[Run]) -> None:
    """Refuses views that would count twice.

    Raises:
        RunError: a run is given twice, possibly by different paths.
    """
    for number, run in enumerate(runs):
        if any(run.path.samefile(other.path) for other in runs[:number]):
            raise RunError(run.path, "both runs are the same: give two different ones")


def _header(runs: list[Run]) -> RunHeader:
    views = [views for run in runs for views in parts_of(run)]
    unit = unit_of(row for run in runs for row in run.rows)
    return replace(
        runs[0].header,
        budget=f"{unit}:{sum(views)}",
        packages=package_versions(),
        parent={"merged": [str(run.path) for run in runs], "merged_views": views},
    )


def _behind(row: StepRow, before: StepRow | None) -> StepRow:
    """Renumbers a row of a later run to follow the last row of the runs before."""
    if before is None:
        return row
    return replace(
        row,
        step=before.step + 1 + row.step,
        seconds=before.seconds + row.seconds,
        metres=before.metres + row.metres,
        radians=before.radians + row.radians,
    )
