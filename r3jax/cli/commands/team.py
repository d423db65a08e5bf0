"""`r3jax team`: several cameras in one scene at once, each with a run of its own."""

import contextlib
from pathlib import Path

from r3jax.apps.report.report import write_report
from r3jax.apps.team.crew import Crew, begin_team, resume_team, write_team_data
from r3jax.apps.team.team import TeamResult, TeamView, explore_team
from r3jax.cli.commands.explore import (
    EXIT_CODES,
    run_settings,
    scene_settings,
    warn_of_versions,
)
from r3jax.cli.console import Console
from r3jax.cli.errors import one_line, resumable, resume_command
from r3jax.cli.options.explore import TeamOptions
from r3jax.cli.progress import RunProgress, Stages
from r3jax.errors import InputError
from r3jax.interrupts import settle_interrupt
from r3jax.planning.policy import PolicyError
from r3jax.runs.header import RunError


def run_team(options: TeamOptions) -> int:
    """Explores a scene with several cameras and writes their runs, and what they share.

    Raises:
        ValueError, OSError, ImportError: an unknown scene, a setting that cannot work, no room
            beside the start, a team that exists, or one that cannot be resumed.
    """
    console = Console(stderr=True)
    with contextlib.ExitStack() as stack:
        folder, crew = _crew(options, console, stack)
        stack.enter_context(resumable("team", folder))
        progress = stack.enter_context(RunProgress(console, crew.settings.budget))
        try:
            result = explore_team(
                crew.members,
                budget=crew.settings.budget,
                seed=crew.seed,
                config=crew.settings.config,
                meet_every=crew.meet_every,
                recorders=crew.recorders,
                resume=crew.recorded,
                on_row=lambda number, row: progress.on_row(row),
                on_stage=progress.on_stage,
            )
        except PolicyError as error:
            raise InputError(one_line(error)) from error
    with resumable("team", folder):
        _conclude(console, folder, result)
    return max(EXIT_CODES.get(member.reason, 0) for member in result.members)


def _crew(options: TeamOptions, console: Console, stack: contextlib.ExitStack) -> tuple[Path, Crew]:
    """The team that the options ask for, resumed or new, and its folder."""
    if options.resume is not None:
        with console.status(f"opening {options.resume} and its scene ..."):
            crew = resume_team(options.resume, stack, options.budget)
        recorded = crew.recorded or []
        warn_of_versions(console, recorded[0])
        views = " + ".join(str(len(run.rows)) for run in recorded)
        console.say(f"resuming {options.resume} after views {views}, decided and mapped again")
        return options.resume, crew
    singles, folder = options.singles(), options.path
    settings = [run_settings(single) for single in singles]
    with console.status(f"opening {options.scene} {options.cameras} times ..."):
        crew = begin_team(
            settings,
            [scene_settings(single) for single in singles],
            folder,
            stack,
            meet_every=options.meet_every,
            overwrite=options.folder.overwrite,
        )
    return folder, crew


def _conclude(console: Console, folder: Path, result: TeamResult) -> None:
    """Data sets, reports, and a few words; a full disk must not hide how the team ended."""
    settle_interrupt()  # it has ended the runs; what was recorded is written out
    for number, member in enumerate(result.members):
        console.say(f"{number}: {member.reason.value}: {member.message}")
    if any(member.reason in EXIT_CODES for member in result.members):
        console.say(f"go on     {resume_command('team', folder)}")
    if any(member.state.views == 0 for member in result.members):
        return
    try:
        with Stages(console) as stages:
            stages.on_progress("writing the data sets", 0)
            runs = write_team_data(folder, result)
            pages = [
                write_report(run, result.map_state, result.grid, stages.on_progress) for run in runs
            ]
    except (RunError, OSError) as error:
        console.say(f"the data set could not be written: {one_line(error)}")
        return
    for line in _against_time(result.views):
        console.say(line)
    console.say(f"data set  {folder / 'transforms.json'}")
    for page in pages:
        console.say(f"report    {page}")
    console.next("train", folder)


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
