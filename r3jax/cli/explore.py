"""`r3jax explore`: begin a run, go on with one, or fork one; write what comes out of it."""

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from r3jax.apps.forecast.goal import parse_goal
from r3jax.apps.forecast.stopping import stopping_rule
from r3jax.apps.report.report import write_report
from r3jax.cli.checks import default_name
from r3jax.cli.console import Console
from r3jax.cli.errors import UserError, one_line, resumable, resume_command
from r3jax.cli.options import Explore, Team
from r3jax.cli.pages import check_viser
from r3jax.cli.progress import RunProgress, Stages
from r3jax.cli.setup import (
    Plan,
    header_of,
    plan_of_options,
    plan_of_run,
    policy_of_options,
    simulator_of_options,
    simulator_of_run,
)
from r3jax.exploration.budget import parse_budget
from r3jax.exploration.loop import Result, explore
from r3jax.exploration.state import StopReason
from r3jax.formats.pointcloud import voxel_points, write_points
from r3jax.formats.transforms import write_transforms
from r3jax.planning.limits import begin_at
from r3jax.planning.motion import motion_of
from r3jax.simulators.base import Simulator
from r3jax.trace.errors import RunError
from r3jax.trace.header import package_versions, policy_fields
from r3jax.trace.reader import Run, read_run
from r3jax.trace.rows import StepRow
from r3jax.trace.writer import RunWriter

EXIT_CODES = {StopReason.RECORDING_STOPPED: 1, StopReason.INTERRUPTED: 130}
"""Of a run that can be gone on with; 0 for all others."""

_WITH_RESUME = ("resume", "budget", "until", "live", "port")
_WITH_FORK = (
    "fork", "at", "policy", "budget", "until", "name", "out", "overwrite", "candidates", "lambda1",
    "lambda2", "refine", "live", "port",
)  # fmt: skip
"""Options that make sense beside these; all others are fixed by the recorded run."""


@dataclasses.dataclass(frozen=True)
class Expedition:
    """Everything that `explore` is called with."""

    plan: Plan
    simulator: Simulator
    recorder: RunWriter
    seed: int
    recorded: Run | None = None
    decided_from: int = 0


def run_explore(options: Explore) -> int:
    """Explores a scene and writes the data set and the report.

    Raises:
        UserError: an unknown scene or policy, a setting that cannot work, a run that exists, or
            one that cannot be gone on with.
    """
    console = Console(stderr=True)
    with contextlib.ExitStack() as stack:
        # A port that is in use must be told before there is a folder.
        page = _open_page(options, stack) if options.live else None
        try:
            expedition = _set_out(options, console)
        except (ValueError, OSError, ImportError) as error:
            raise UserError(one_line(error)) from error
        plan, recorder = expedition.plan, stack.enter_context(expedition.recorder)
        stack.enter_context(resumable("explore", recorder.path))
        policy, on_view = plan.policy, lambda row: None
        if page is not None:
            feed = stack.enter_context(page(expedition))
            policy, on_view = feed.watch(policy), feed.on_step
            console.say(f"live      {feed.url}")
        progress = stack.enter_context(RunProgress(console, plan.budget))

        def on_step(row: StepRow) -> None:
            progress.on_step(row)
            on_view(row)

        try:
            result = explore(
                expedition.simulator,
                policy,
                budget=plan.budget,
                seed=expedition.seed,
                config=plan.config,
                recorder=recorder,
                resume=expedition.recorded,
                decided_from=expedition.decided_from,
                is_enough=stopping_rule(plan.config, expedition.simulator.camera),
                on_step=on_step,
                on_stage=progress.on_stage,
            )
        except RunError as error:
            raise UserError(one_line(error)) from error
    with resumable("explore", recorder.path):
        _conclude(console, recorder.path, result)
    return EXIT_CODES.get(result.reason, 0)


def _open_page(options: Explore, stack: contextlib.ExitStack) -> Callable[[Expedition], Any]:
    """A server for a page that will show an expedition; the stack closes it.

    Returns:
        Makes the `viewer.live.LiveFeed` of the expedition, once there is one.

    Raises:
        UserError: viser is not installed, or the port is in use.
    """
    check_viser()
    from r3jax.apps.viewer.live import open_live
    from r3jax.apps.viewer.server import close_server, open_server

    try:
        server = open_server("127.0.0.1", options.port)
    except (ValueError, OSError) as error:
        raise UserError(one_line(error)) from error
    stack.callback(close_server, server)

    def fill(expedition: Expedition) -> Any:
        return open_live(
            server,
            expedition.simulator.camera,
            expedition.simulator.bounds,
            expedition.plan.config,
            title=f"{expedition.plan.policy.name}, live",
            subtitle=str(expedition.recorder.path),
            earlier=expedition.recorded,
        )

    return fill


def _set_out(options: Explore, console: Console) -> Expedition:
    """What can be checked quickly comes before the scene is built."""
    if options.resume is not None:
        return _resume(options, options.resume, console)
    if options.fork is not None:
        return _fork(options, options.fork, console)
    assert options.scene is not None
    plan = plan_of_options(options)
    name = options.name or default_name(options, options.scene, plan.policy.name)
    with console.status(f"opening {options.scene} ..."):
        simulator = simulator_of_options(options)
    begin_at(motion_of(plan.policy), simulator.start_pose)  # refused before there is a folder
    header = header_of(options, plan, simulator)
    recorder = RunWriter(options.out / name, header, overwrite=options.overwrite)
    return Expedition(plan, simulator, recorder, options.seed)


def _resume(options: Explore, path: Path, console: Console) -> Expedition:
    refuse_others(options, "--resume", _WITH_RESUME)
    run = read_run(path)
    if run.header.is_merged:
        raise ValueError(f"{path} was merged from other runs: fork it with --fork and --at")
    if run.header.is_of_team:
        raise ValueError(
            f"{path} flew in a team: go on with `r3jax team --resume {path.parent}`, or fork it "
            "with --fork and --at"
        )
    _refuse_half_a_fork(run)
    plan = plan_of_run(run)
    plan = _with_limits(plan, options)
    header = None
    if (options.budget, options.until) != (None, None):
        header = dataclasses.replace(
            run.header, budget=str(plan.budget), config=dataclasses.asdict(plan.config)
        )
    warn_of_versions(console, run)
    with console.status(f"opening {run.header.scene['name']} ..."):
        simulator = simulator_of_run(run)
    recorder, run = RunWriter.resume(path, header)
    console.say(f"goes on behind view {len(run.rows)} of {path}")
    return Expedition(plan, simulator, recorder, run.header.seed, run, _decided_from(run))


def _fork(options: Explore, path: Path, console: Console) -> Expedition:
    refuse_others(options, "--fork", _WITH_FORK)
    run, at = read_run(path), options.at
    assert at is not None
    if not 1 <= at <= len(run.rows):
        raise ValueError(f"--at must lie between 1 and the run's {len(run.rows)} views, got {at}")
    plan = plan_of_run(run)
    given = (
        options.policy, options.candidates, options.lambda1, options.lambda2, options.refine
    )  # fmt: skip
    if any(value is not None for value in given):
        policy = policy_of_options(options, run.header.scene["max_range"], motion_of(plan.policy))
        plan = dataclasses.replace(plan, policy=policy)
    plan = _with_limits(plan, options)
    with console.status(f"opening {run.header.scene['name']} ..."):
        simulator = simulator_of_run(run)
    fields = policy_fields(plan.policy)
    # What a team's policy decided on is not known from the run's own frames.
    is_same = fields == run.header.policy and not run.header.is_of_team
    decided_from = _decided_from(run) if is_same else at
    header = dataclasses.replace(
        run.header,
        policy=fields,
        budget=str(plan.budget),
        config=dataclasses.asdict(plan.config),
        packages=package_versions(),
        parent={"forked": str(path), "views": at, "decided_from": decided_from},
    )
    name = options.name or f"{path.name}-{plan.policy.name}-from{at}"
    recorder = RunWriter(options.out / name, header, overwrite=options.overwrite)
    try:
        for row in run.rows[:at]:
            run.frame(row.step)  # says what is wrong with it
            recorder.adopt(row, run, row.step)
        recorded = read_run(recorder.path)
        return Expedition(plan, simulator, recorder, run.header.seed, recorded, decided_from)
    except BaseException:
        recorder.close()
        raise


def _with_limits(plan: Plan, options: Explore) -> Plan:
    """The plan of a recorded run, with another budget or goal if one is given."""
    if options.budget is not None:
        plan = dataclasses.replace(plan, budget=parse_budget(options.budget))
    if options.until is not None:
        parse_goal(options.until)
        config = dataclasses.replace(plan.config, until=options.until)
        plan = dataclasses.replace(plan, config=config)
    return plan


def _refuse_half_a_fork(run: Run) -> None:
    """A fork that was cut off while it took views over would go its own way too early."""
    parent = run.header.parent or {}
    wanted = parent.get("views", 0) if "forked" in parent else 0
    if len(run.rows) < wanted:
        raise ValueError(
            f"{run.path} was cut off when it had {len(run.rows)} of the {wanted} views that it "
            f"takes over from {parent['forked']}: fork again, with --overwrite"
        )


def _decided_from(run: Run) -> int:
    """The first view that the run's own policy chose: a fork took the earlier ones over."""
    return int((run.header.parent or {}).get("decided_from", 0))


def refuse_others(options: Explore | Team, flag: str, allowed: tuple[str, ...]) -> None:
    """A setting that would be ignored is a mistake.

    Raises:
        ValueError: one was given beside `flag`; names it.
    """
    fields = [field for field in dataclasses.fields(options) if field.name not in allowed]
    given = [field.name for field in fields if getattr(options, field.name) != field.default]
    if given:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ValueError(f"{flag} takes these from the recorded run, leave them out: {names}")


def warn_of_versions(console: Console, run: Run) -> None:
    """Says which packages are not those that a run was begun with."""
    now, then = package_versions(), run.header.packages
    changed = [f"{k} {then.get(k)} -> {v}" for k, v in now.items() if then.get(k) != v]
    if changed:
        console.say(
            f"the run was begun with other versions ({', '.join(changed)}): what follows may "
            "differ in the last digits from what would have followed then",
        )


def _conclude(console: Console, path: Path, result: Result) -> None:
    """Data set, report, and a few words; a full disk must not hide how the run ended."""
    console.say(f"{result.reason.value}: {result.message}")
    if result.reason in EXIT_CODES:
        console.say(f"go on     {resume_command('explore', path)}")
    if result.state.views == 0:
        return
    try:
        with Stages(console) as stages:
            stages.on_progress("writing the data set", 0)
            run = read_run(path)
            write_data_set(run, result)
            state = result.state
            page = write_report(run, state.map_state, state.grid, stages.on_progress)
    except (RunError, OSError) as error:
        console.say(f"the report could not be written: {one_line(error)}")
        return
    last = result.rows[-1]
    console.say(
        f"{len(result.rows)} views, {last.metres:.1f} m, {last.seconds:.1f} s on the clock; "
        f"{100 * last.coverage.known_share:.0f} % of the box explored, mean renderability "
        f"{last.coverage.mean_renderability:.2f}",
    )
    console.say(f"data set  {path / 'transforms.json'}")
    console.say(f"report    {page}")


def write_data_set(run: Run, result: Result) -> None:
    """transforms.json and the points that 3DGS starts from."""
    points = run.path / "exports" / "points.ply"
    points.parent.mkdir(exist_ok=True)
    write_points(points, *voxel_points(result.state.map_state))
    write_transforms(run, points.relative_to(run.path).as_posix())
