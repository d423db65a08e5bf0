"""`r3jax team`: several cameras in one scene at once, each with a run of its own."""

import contextlib
import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r3jax.apps.report.report import Progress, write_report
from r3jax.apps.team.team import Member, TeamResult, TeamView, explore_team
from r3jax.cli.checks import singles_of, team_folder
from r3jax.cli.console import Console
from r3jax.cli.errors import UserError, one_line, resumable, resume_command
from r3jax.cli.explore import EXIT_CODES, refuse_others, warn_of_versions
from r3jax.cli.options import Explore, Team
from r3jax.cli.progress import RunProgress, Stages
from r3jax.cli.setup import (
    Plan,
    header_of,
    plan_of_options,
    plan_of_run,
    simulator_of_options,
    simulator_of_run,
)
from r3jax.exploration.budget import parse_budget
from r3jax.files import lock_folder, write_atomic
from r3jax.formats.pointcloud import voxel_points, write_points
from r3jax.formats.transforms import write_team_transforms, write_transforms
from r3jax.planning.limits import begin_at
from r3jax.planning.motion import motion_of
from r3jax.simulators.base import Simulator
from r3jax.simulators.start import APART, places_beside
from r3jax.trace.errors import RunError
from r3jax.trace.header import RunHeader
from r3jax.trace.reader import Run, read_run
from r3jax.trace.writer import RunWriter

DEFAULT_BUDGET = "seconds:120"

_WITH_RESUME = ("resume", "budget")


@dataclass(frozen=True)
class _Crew:
    """Everything that `explore_team` is called with."""

    plan: Plan
    """Of the first member: budget and configuration are those of all."""

    members: list[Member]
    recorders: list[RunWriter]
    seed: int
    meet_every: float
    recorded: list[Run] | None = None


def run_team(options: Team) -> int:
    """Explores a scene with several cameras and writes their runs, and what they share.

    Raises:
        UserError: an unknown scene or policy, a setting that cannot work, no room beside the
            start, a team that exists, or one that cannot be gone on with.
    """
    console = Console(stderr=True)
    with contextlib.ExitStack() as stack:
        try:
            if options.resume is None:
                folder, crew = _set_out(options, console, stack)
            else:
                folder, crew = options.resume, _go_on(options, options.resume, console, stack)
        except (ValueError, OSError, ImportError) as error:
            raise UserError(one_line(error)) from error
        stack.enter_context(resumable("team", folder))
        progress = stack.enter_context(RunProgress(console, crew.plan.budget))
        try:
            result = explore_team(
                crew.members,
                budget=crew.plan.budget,
                seed=crew.seed,
                config=crew.plan.config,
                meet_every=crew.meet_every,
                recorders=crew.recorders,
                resume=crew.recorded,
                on_step=lambda number, row: progress.on_step(row),
                on_stage=progress.on_stage,
            )
        except RunError as error:
            raise UserError(one_line(error)) from error
    with resumable("team", folder):
        _conclude(console, folder, result)
    return max(EXIT_CODES.get(member.reason, 0) for member in result.members)


def _set_out(options: Team, console: Console, stack: contextlib.ExitStack) -> tuple[Path, _Crew]:
    """A new team: what can be checked quickly comes before the scene is built."""
    assert options.scene is not None
    singles = [
        dataclasses.replace(single, budget=options.budget or DEFAULT_BUDGET)
        for single in singles_of(options)
    ]
    plans = [plan_of_options(single) for single in singles]
    folder = team_folder(options, options.scene)
    _check_leftovers(folder, options.cameras)
    with console.status(f"opening {options.scene} {options.cameras} times ..."):
        singles, simulators = _with_starts(singles)
    members = [Member(s, plan.policy) for s, plan in zip(simulators, plans, strict=True)]
    for member in members:  # refused before there is a folder
        begin_at(motion_of(member.policy), member.simulator.start_pose)
    headers = [
        _header(options, single, plan, simulator, number)
        for number, (single, plan, simulator) in enumerate(
            zip(singles, plans, simulators, strict=True)
        )
    ]
    folder.mkdir(parents=True, exist_ok=True)
    _only_writer(folder, stack)
    _check_leftovers(folder, options.cameras)  # another process may have been faster
    recorders = [
        stack.enter_context(RunWriter(folder / str(number), header, overwrite=options.overwrite))
        for number, header in enumerate(headers)
    ]
    return folder, _Crew(plans[0], members, recorders, options.seed, options.meet_every)


def _go_on(options: Team, folder: Path, console: Console, stack: contextlib.ExitStack) -> _Crew:
    """A team that was cut off: its members' runs say what it was."""
    refuse_others(options, "--resume", _WITH_RESUME)
    read_run(folder / "0")  # says what is wrong before anything is written
    _only_writer(folder, stack)
    first = read_run(folder / "0")
    if not first.header.is_of_team:
        raise ValueError(f"{first.path} did not fly in a team: `r3jax explore --resume` it")
    parent: dict[str, Any] = first.header.parent or {}
    warn_of_versions(console, first)
    members: list[Member] = []
    recorders: list[RunWriter] = []
    recorded: list[Run] = []
    plan = plan_of_run(first)
    if options.budget is not None:
        plan = dataclasses.replace(plan, budget=parse_budget(options.budget))
    for name in parent["team"]:
        run = read_run(folder / name)
        with console.status(f"opening {run.header.scene['name']} ..."):
            simulator = simulator_of_run(run)
        header = dataclasses.replace(run.header, budget=str(plan.budget))
        recorder, run = RunWriter.resume(run.path, header)
        recorders.append(stack.enter_context(recorder))
        members.append(Member(simulator, plan_of_run(run).policy))
        recorded.append(run)
    views = " + ".join(str(len(run.rows)) for run in recorded)
    console.say(f"goes on behind views {views} of {folder}, decided and mapped anew")
    meet_every = float(parent["meet_every"])
    return _Crew(plan, members, recorders, first.header.seed, meet_every, recorded)


def _only_writer(folder: Path, stack: contextlib.ExitStack) -> None:
    """Until the stack ends no other process writes this team."""
    try:
        stack.enter_context(lock_folder(folder))
    except BlockingIOError:
        raise ValueError(f"{folder}: another process is writing this team") from None


def _with_starts(singles: list[Explore]) -> tuple[list[Explore], list[Simulator]]:
    """The scene as each camera sees it; all but the first start beside the first.

    Raises:
        ValueError: there is no room.
    """
    simulators = [simulator_of_options(singles[0])]
    placed = [singles[0]]
    places = places_beside(simulators[0].start_pose[:3, 3])
    for single in singles[1:]:
        for place in places:
            x, y, z = place.tolist()
            single = dataclasses.replace(single, start=(x, y, z))
            try:
                simulators.append(simulator_of_options(single))
            except ValueError:
                continue  # in a wall, or too close to one
            placed.append(single)
            break
        else:
            raise ValueError(
                f"there is no room for {len(singles)} cameras {APART} m apart beside the start "
                f"{simulators[0].start_pose[:3, 3].round(2).tolist()}: give a roomier --start"
            )
    return placed, simulators


def _check_leftovers(folder: Path, cameras: int) -> None:
    """A smaller team must not be written over a larger one: whose run would the last one be?"""
    present = {path.name for path in folder.iterdir()} if folder.is_dir() else set[str]()
    if present - {"lock"} and "0" not in present:
        raise ValueError(f"{folder} holds something that is not a team: give another --name")
    if (folder / str(cameras)).exists():
        raise ValueError(f"{folder} holds a team of more than {cameras}: give another --name")


def _header(
    options: Team, single: Explore, plan: Plan, simulator: Simulator, number: int
) -> RunHeader:
    names = [str(i) for i in range(options.cameras)]
    parent = {"team": names, "member": number, "meet_every": options.meet_every}
    return dataclasses.replace(header_of(single, plan, simulator), parent=parent)


def _conclude(console: Console, folder: Path, result: TeamResult) -> None:
    """Data sets, reports, and a few words; a full disk must not hide how the team ended."""
    for number, member in enumerate(result.members):
        console.say(f"{number}: {member.reason.value}: {member.message}")
    if any(member.reason in EXIT_CODES for member in result.members):
        console.say(f"go on     {resume_command('team', folder)}")
    if any(member.state.views == 0 for member in result.members):
        return
    try:
        with Stages(console) as stages:
            stages.on_progress("writing the data sets", 0)
            pages = _write(folder, result, stages.on_progress)
    except (RunError, OSError) as error:
        console.say(f"the data set could not be written: {one_line(error)}")
        return
    for line in _against_time(result.views):
        console.say(line)
    console.say(f"data set  {folder / 'transforms.json'}")
    for page in pages:
        console.say(f"report    {page}")


def _write(folder: Path, result: TeamResult, on_progress: Progress) -> list[Path]:
    """What all have in common beside the runs, and what every run has; returns the reports."""
    lines = "".join(json.dumps(dataclasses.asdict(view)) + "\n" for view in result.views)
    write_atomic(folder / "coverage.jsonl", lines.encode())
    runs = [read_run(folder / str(number)) for number in range(len(result.members))]
    points = voxel_points(result.map_state)
    pages: list[Path] = []
    for place in (folder, *(run.path for run in runs)):
        (place / "exports").mkdir(exist_ok=True)
        write_points(place / "exports" / "points.ply", *points)
    for run in runs:
        write_transforms(run, "exports/points.ply")
        pages.append(write_report(run, result.map_state, result.grid, on_progress))
    write_team_transforms(folder, runs, "exports/points.ply")
    return pages


def _against_time(views: tuple[TeamView, ...]) -> list[str]:
    """What all knew together at the quarters of the mission."""
    lines: list[str] = []
    for quarter in (0.25, 0.5, 0.75, 1.0):
        seen = [view for view in views if view.seconds <= quarter * views[-1].seconds]
        if seen:
            last = seen[-1]
            lines.append(
                f"{last.seconds:6.1f} s on the clock: {len(seen)} views, "
                f"{100 * last.known_share:.0f} % of the box explored, {last.voxels} voxels"
            )
    return lines
