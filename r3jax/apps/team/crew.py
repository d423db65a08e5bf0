"""Begins, resumes and finishes teams on disk: a folder with a run for every camera."""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r3jax.apps.team.team import Member, TeamResult
from r3jax.errors import InputError
from r3jax.exploration.guard import check_world, first_pose
from r3jax.files import (
    check_own,
    clear_partial,
    lock_folder,
    make_folder,
    own_folder,
    write_atomic,
)
from r3jax.formats.exports import write_data_set
from r3jax.formats.nerfstudio import write_team_transforms
from r3jax.formats.points import voxel_points, write_points
from r3jax.planning.robot.motion import motion_of
from r3jax.runs.reader import Run, read_run
from r3jax.runs.settings import (
    RunSettings,
    SceneSettings,
    new_header,
    open_run_scene,
    settings_of_run,
)
from r3jax.runs.writer import RunWriter
from r3jax.simulators.base import Simulator
from r3jax.simulators.clearance import APART, places_beside


@dataclass(frozen=True)
class Crew:
    """Arguments of `explore_team`."""

    settings: RunSettings
    """Settings of the first member: budget and configuration are those of all."""

    members: list[Member]
    recorders: list[RunWriter]
    seed: int

    meet_every: float
    """Mission time between two meetings [s]; 0 for permanent contact."""

    recorded: list[Run] | None = None
    """Runs recorded so far; None for a new team."""


def begin_team(
    settings: Sequence[RunSettings],
    scenes: Sequence[SceneSettings],
    folder: Path,
    stack: contextlib.ExitStack,
    *,
    meet_every: float,
    overwrite: bool = False,
) -> Crew:
    """Opens the scene for every camera and makes the folders, in this order.

    Args:
        settings: of each camera.
        scenes: how each camera sees the scene; all but the first start beside the first.
        folder: the team's folder.
        stack: closes the recorders and frees the team's lock.
        meet_every: mission clock between two meetings [s].
        overwrite: replace the team that is there.

    Raises:
        ValueError: the scene is unknown, there is no room beside the start, or the folder holds
            something.
        ImportError: the scene's simulator is not installed.
    """
    _check_leftovers(folder, len(scenes))
    placed, simulators = _with_starts(scenes, settings[0].config.cell_size)
    members = [Member(s, each.policy) for s, each in zip(simulators, settings, strict=True)]
    for member in members:  # refused before there is a folder
        first_pose(member.simulator, motion_of(member.policy), settings[0].config)
    names = [str(number) for number in range(len(scenes))]
    headers = [
        dataclasses.replace(
            new_header(each, scene, simulator),
            parent={"team": names, "member": number, "meet_every": meet_every},
        )
        for number, (each, scene, simulator) in enumerate(
            zip(settings, placed, simulators, strict=True)
        )
    ]
    _only_writer(folder, stack)
    _check_leftovers(folder, len(scenes))  # another process may have been faster
    recorders = [
        stack.enter_context(RunWriter(folder / name, header, overwrite=overwrite))
        for name, header in zip(names, headers, strict=True)
    ]
    return Crew(settings[0], members, recorders, scenes[0].seed, meet_every)


def resume_team(folder: Path, stack: contextlib.ExitStack, budget: str | None = None) -> Crew:
    """Resumes an interrupted team with the settings recorded in its members' runs.

    Args:
        folder: the team's folder.
        stack: closes the recorders and frees the team's lock.
        budget: another budget; None keeps the team's.

    Raises:
        ValueError: no team, a damaged one, or one that another process writes.
    """
    read_run(folder / "0")  # says what is wrong before anything is written
    _only_writer(folder, stack)
    first = read_run(folder / "0")
    if not first.header.is_of_team:
        raise InputError(f"{first.path} did not fly in a team: `r3jax explore --resume` it")
    parent: dict[str, Any] = first.header.parent or {}
    members: list[Member] = []
    recorders: list[RunWriter] = []
    recorded: list[Run] = []
    settings = settings_of_run(first).with_limits(budget, None)
    for name in parent["team"]:
        run = read_run(folder / name)
        simulator = open_run_scene(run)
        header = dataclasses.replace(run.header, budget=str(settings.budget))
        recorder, run = RunWriter.resume(run.path, header)
        recorders.append(stack.enter_context(recorder))
        members.append(Member(simulator, settings_of_run(run).policy))
        recorded.append(run)
    meet_every = float(parent["meet_every"])
    return Crew(settings, members, recorders, first.header.seed, meet_every, recorded)


def _only_writer(folder: Path, stack: contextlib.ExitStack) -> None:
    """Locks the team's folders against other processes until the stack ends."""
    own_folder(folder, "team", "give another --name")
    try:
        stack.enter_context(lock_folder(folder))
    except BlockingIOError:
        raise InputError(f"{folder}: another process is writing this team") from None
    clear_partial(folder)


def _with_starts(
    scenes: Sequence[SceneSettings], cell_size: float
) -> tuple[list[SceneSettings], list[Simulator]]:
    """Opens the scene for each camera; all but the first camera start beside the first.

    Raises:
        ValueError: there is no room.
    """
    placed, simulators = [scenes[0]], [scenes[0].open()]
    check_world(simulators[0].bounds, cell_size)  # the search for a start names no scale
    places = places_beside(simulators[0].start_pose[:3, 3])
    for scene in scenes[1:]:
        for place in places:
            x, y, z = place.tolist()
            scene = dataclasses.replace(scene, start=(x, y, z))
            try:
                simulators.append(scene.open())
            except ValueError:
                continue  # in a wall, or too close to one
            placed.append(scene)
            break
        else:
            raise InputError(
                f"there is no room for {len(scenes)} cameras {APART} m apart beside the start "
                f"{simulators[0].start_pose[:3, 3].round(2).tolist()}: give a roomier --start"
            )
    return placed, simulators


def _check_leftovers(folder: Path, cameras: int) -> None:
    """Refuses to write a smaller team over a larger one, whose last runs would remain."""
    check_own(folder, "team", "give another --name")
    if (folder / str(cameras)).exists():
        raise InputError(f"{folder} holds a team of more than {cameras}: give another --name")


def write_team_data(
    folder: Path, result: TeamResult, on_run: Callable[[Run], None] = lambda run: None
) -> list[Run]:
    """Writes the common data set of the team, and that of every run.

    Args:
        folder: the team's folder.
        result: result of the team's exploration.
        on_run: called with every run whose data set is written.

    Returns:
        The runs.

    Raises:
        RunError: a run cannot be read back.
        OSError: the disk is full, not writable, ...
    """
    lines = "".join(json.dumps(dataclasses.asdict(view)) + "\n" for view in result.views)
    write_atomic(folder / "coverage.jsonl", lines.encode())
    runs = [read_run(folder / str(number)) for number in range(len(result.members))]
    for run in runs:
        write_data_set(run, result.map_state)
        on_run(run)
    make_folder(folder / "exports")
    write_points(folder / "exports" / "points.ply", *voxel_points(result.map_state))
    write_team_transforms(folder, runs, "exports/points.ply")
    return runs
