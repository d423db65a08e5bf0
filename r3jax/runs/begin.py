"""Runs begun, resumed, forked and merged."""

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
from r3jax.runs.stored_states import map_tables
from r3jax.runs.writer import RunWriter
from r3jax.simulators.base import Simulator


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
    # Refused before there is a folder.
    first_pose(simulator, motion_of(settings.policy), settings.config.cell_size)
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
        raise InputError(f"{path} was merged from other runs: fork it with --fork and --at")
    if run.header.is_of_team:
        raise InputError(
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
        settings: of the fork: those of `settings_of_run`, changed.
        path: folder of the fork.
        overwrite: replace the run that is there.

    Raises:
        ValueError: no such view, a scene that has changed, a frame that cannot be read, or a run
            that is there.
    """
    if not 1 <= at <= len(run.rows):
        raise InputError(
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
    """Refuses a fork that was cut off while it took views over: it would diverge too early."""
    parent = run.header.parent or {}
    wanted = parent.get("views", 0) if "forked" in parent else 0
    if len(run.rows) < wanted:
        raise InputError(
            f"{run.path} was cut off when it had {len(run.rows)} of the {wanted} "
            f"{unit_of(run.rows)} that it takes over from {parent['forked']}: fork again, with "
            "--overwrite"
        )


def _as_flown(rows: Sequence[StepRow]) -> list[StepRow]:
    """Cuts the path of a choice to the part that was flown, if the path was left before its end.

    A policy that takes over is given the path, and must not count what lies ahead as visited.
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
    """Writes a run that holds the views of several, one run after the other.

    The rows of a later run are numbered on, and its totals (clock, path, angle) added to those
    before; what a row says of the map is of that run's own map. The stored map and grid have
    seen all.

    Args:
        runs: of one scene, mapped on the same terms, with the same camera.
        out: folder of the merged run.
        overwrite: replace the run that is there.
        on_frame: called after every frame that has entered the map.

    Returns:
        The map.

    Raises:
        RunError: the runs do not fit together, cannot be read, or `out` cannot be written.
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
    map_state, grid = rebuild(runs, on_frame=on_frame)
    with RunWriter(out, _header(runs), overwrite=overwrite) as writer:
        last: StepRow | None = None
        for run in runs:
            before = last
            for row in run.rows:
                last = _behind(row, before)
                writer.adopt(last, run, row.step)
        writer.checkpoint(writer.views - 1, map_tables(map_state, grid), wait=True)
        writer.finish("merged", f"the views of {' and '.join(str(run.path) for run in runs)}")
    return map_state


def _check_apart(runs: list[Run]) -> None:
    """Refuses views that would count twice.

    Raises:
        RunError: a run is given twice, under whatever path.
    """
    for number, run in enumerate(runs):
        if any(run.path.samefile(other.path) for other in runs[:number]):
            raise RunError(run.path, "a run is not merged with itself: give two different runs")


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
