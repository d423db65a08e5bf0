"""Explores a scene with several cameras: each flies its own mission, and they share frames.

They fly at the same time. Every member has its own lens, policy, map and mission clock. The member
whose clock is behind steps next, so a mission lasts as long as its longest clock. At a meeting all
receive the frames taken until then; between meetings each member adds only its own frames. When a
member decides, it assumes that the views that the others were heading for at the last meeting have
been taken, and leaves cells that are nearer to the others to them (`ReservedViews`).

A frame is shared once it has been taken, and a member receives it at the next meeting. Members that
decide at the same time decide in turn.

Members share frames, not maps. Their own maps would not merge into the map of a single camera: a
frame also marks voxels that others added as seen, and the grid clips its log-odds. Frames in the
order of the clock do merge: two members that received the same frames have the same map, bit for
bit.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.errors import InputError
from r3jax.exploration.config import Budget, ExplorationConfig, parse_budget
from r3jax.exploration.guard import GuardedSimulator
from r3jax.exploration.loop import Result
from r3jax.exploration.state import (
    LoopState,
    Mission,
    RecordingStopped,
    Stop,
    StopReason,
    make_clock,
    timed,
)
from r3jax.exploration.step import relive, start_state, step
from r3jax.exploration.taken_views import StepRow
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, frontier_unexplored, squared_distance
from r3jax.mapping.state import MapState
from r3jax.planning.planner import add_frame, first_map, tell_policy
from r3jax.planning.policy import Decision, LivesOutside, PlanInfo, Policy
from r3jax.runs.reader import Run
from r3jax.runs.writer import RunWriter
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import imagine_view
from r3jax.simulators.base import Simulator


@dataclass(frozen=True)
class PromisedView:
    """A view that one robot has decided on but not yet taken."""

    camera: Camera

    T_world_camera: np.ndarray
    """Its pose, [4, 4]."""


@dataclass
class ReservedViews:
    """Decides like another policy, on the map expected after the promised views."""

    policy: Policy
    """The robot that decides."""

    promised: tuple[PromisedView, ...]

    scoring: ScoringConfig
    """How far the promised views see."""

    def __post_init__(self) -> None:
        """Goes by the name of the policy, and by its settings."""
        # Others ask a policy for them, `motion_of` for one: they get what the inner one plans with.
        self.name, self.config = self.policy.name, getattr(self.policy, "config", None)

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Any:
        """Does what the policy does."""
        return self.policy.init(camera, grid, key=key)

    def observe(self, state: Any, map_state: MapState, frame: Frame) -> Any:
        """Does what the policy does."""
        return self.policy.observe(state, map_state, frame)

    def decide(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, Any, PlanInfo]:
        """Chooses the view that the policy would choose after the promised views."""
        # One after the other: what the first promises to show, the second cannot promise again.
        for view in self.promised:
            pose = jnp.asarray(view.T_world_camera, dtype=jnp.float32)
            map_state, grid = imagine_view(map_state, grid, view.camera, pose, self.scoring)
        others = jnp.asarray([view.T_world_camera[:3, 3] for view in self.promised], jnp.float32)
        here = jnp.asarray(T_world_camera[:3, 3], dtype=jnp.float32)
        # After the promises, so that "nothing left" counts what they leave.
        grid = without_yielded(grid, here, others)
        return self.policy.decide(state, map_state, grid, T_world_camera, key=key)

    def follow(
        self,
        state: Any,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> Any:
        """Does what the policy does."""
        return self.policy.follow(state, map_state, grid, T_world_camera, waypoints)


@jax.jit
def without_yielded(
    grid: OccupancyGrid, here: Float[Array, " 3"], others: Float[Array, "K 3"]
) -> OccupancyGrid:
    """Returns the grid for a decision that leaves cells nearer to others to them.

    Cells that are nearer to one of the others than to here do not count, unless that would leave
    nothing to explore.

    Args:
        grid: the coarse grid.
        here: position of the camera [m].
        others: destinations of the others [m].
    """
    # Two arrays at a time, never [K, X, Y, Z]; and squares order as distances do, without roots.
    nearest = functools.reduce(jnp.minimum, [squared_distance(grid, other) for other in others])
    is_yielded = nearest < squared_distance(grid, here)
    # Only frontier cells matter: no robot can explore cells that border on no free cell.
    is_left = jnp.any(frontier_unexplored(grid.ignoring(is_yielded)))
    return grid.ignoring(is_yielded & is_left)


@dataclass(frozen=True)
class Member:
    """One camera of a team."""

    simulator: Simulator
    """The scene as its camera sees it: lens, resolution, start."""

    policy: Policy
    """Chooses its views."""


@dataclass(frozen=True)
class TeamView:
    """Progress of the whole team after a view."""

    seconds: float
    """Mission clock of the member that took it [s]."""

    member: int

    voxels: int
    """Occupied voxels of the common map."""

    known_share: float
    """Known cells over all cells of the scene's box."""


@dataclass(frozen=True)
class TeamResult:
    """A finished exploration by several cameras."""

    members: tuple[Result, ...]
    """Results with each member's own rows; map and grid of each final state are the common ones."""

    views: tuple[TeamView, ...]
    """All views in the order of the clock, with the team's progress after each."""

    map_state: MapState
    """Map of all frames, in that order."""

    grid: OccupancyGrid

    @property
    def seconds(self) -> float:
        """Duration of the mission: the longest clock [s]."""
        return max(result.state.seconds for result in self.members)


@dataclass(frozen=True)
class Observation:
    """A frame taken by a member."""

    seconds: float
    """Its mission clock when the frame was in its own map [s]."""

    member: int

    frame: Frame


@dataclass(frozen=True)
class SharedFrame:
    """A frame in the common map."""

    frame: Frame

    mapping: float
    """Time to join the common map [s]."""

    view: TeamView
    """The member that took it, and the team's progress since then."""


@dataclass(frozen=True)
class Common:
    """The map of all frames that were shared, and the frames that were not yet."""

    map_state: MapState
    """Of the frames that were shared."""

    grid: OccupancyGrid

    waiting: tuple[Observation, ...] = ()
    """Frames taken but not yet shared."""


def last_meeting(seconds: float, meet_every: float) -> float:
    """Returns the clock at the last meeting [s]; 0 for `meet_every` means always in contact."""
    return math.floor(seconds / meet_every) * meet_every if meet_every > 0.0 else seconds


def in_order(observations: tuple[Observation, ...]) -> list[Observation]:
    """Sorts by the clock; of two at the same time, the first member's comes first."""
    return sorted(observations, key=attrgetter("seconds", "member"))


def share(
    common: Common, until: float, config: ExplorationConfig, *, repeat_compiled: bool
) -> tuple[Common, list[SharedFrame]]:
    """Integrates all frames up to a time into the common map: a meeting.

    Args:
        common: before.
        until: mission clock [s]. Later calls share no frame from before it.
        config: of the maps.
        repeat_compiled: False where the exact time is not needed.

    Returns:
        The common map after the meeting, and the frames that joined it, in order.
    """
    shared: list[SharedFrame] = []
    map_state, grid = common.map_state, common.grid
    for observation in in_order(common.waiting):
        if observation.seconds > until:
            continue
        (map_state, grid), seconds = timed(
            add_frame, map_state, grid, observation.frame, config, repeat_compiled=repeat_compiled
        )
        known_share = 1.0 - float(np.mean(np.asarray(grid.unexplored)))
        view = TeamView(
            observation.seconds, observation.member, int(map_state.num_present), known_share
        )
        shared.append(SharedFrame(observation.frame, seconds, view))
    waiting = tuple(observation for observation in common.waiting if observation.seconds > until)
    return Common(map_state, grid, waiting), shared


@dataclass(frozen=True)
class _Flying:
    """One member during the mission."""

    number: int
    mission: Mission
    state: LoopState
    recorded: Run | None = None
    recorder: RunWriter | None = None
    rows: tuple[StepRow, ...] = ()

    received: tuple[SharedFrame, ...] = ()
    """Frames that were shared since this member last received any."""

    owed: float = 0.0
    """Time of receiving frames that no row has been charged for [s]."""

    stop: Stop | None = None


def explore_team(
    members: Sequence[Member],
    *,
    budget: Budget | str,
    seed: int = 0,
    config: ExplorationConfig | None = None,
    meet_every: float = 0.0,
    recorders: Sequence[RunWriter] | None = None,
    resume: Sequence[Run] | None = None,
    on_row: Callable[[int, StepRow], None] | None = None,
    on_stage: Callable[[str], None] | None = None,
) -> TeamResult:
    """Explores an unknown scene with several cameras at once.

    Args:
        members: the cameras; all in the same world. Each one's start is free space for all.
        budget: budget of each member: seconds of its mission clock, its meters, or its views.
        seed: random seed. The first member uses the random numbers of `explore`.
        config: settings of every member's loop.
        meet_every: time between two meetings [s]; 0 for permanent contact. In any case all meet
            at the end. The frames between two meetings are kept in memory.
        recorders: writers of the members' runs; None to record nothing.
        resume: the recorded run of each member of an interrupted team. All decisions and maps are
            computed again, only the images are reused; under the model clock the result is that of
            an uninterrupted team, bit for bit.
        on_row: called with a member's number and the row of every view.
        on_stage: called with the name of the next stage.

    Returns:
        Each member's result, and the map of all frames, which equals that of a single camera that
        took them in the order of the clock.

    Raises:
        ValueError: no member, worlds with different boxes, a budget that is not understood, a
            negative interval, a start outside the scene's box.
        RunError: a recorded frame is missing or broken.
        PolicyError: a program that chooses views has died, hangs, or sends invalid answers.
        OracleReadError: code outside of the loop rendered an image with a simulator.
    """
    config = config or ExplorationConfig()
    budget = parse_budget(budget) if isinstance(budget, str) else budget
    if config.tiles:
        raise InputError(
            "a team shares one map without tiles: explore alone with tiles (`r3jax explore`), and "
            "merge the runs (`r3jax merge`)"
        )
    _check(members, meet_every)
    try:
        flying = [
            _Flying(
                number,
                *_start(number, members, budget, seed, config, on_stage, recorded),
                recorded=recorded,
                recorder=None if recorders is None else recorders[number],
            )
            for number, recorded in enumerate(resume or [None] * len(members))
        ]
        return _fly(flying, meet_every, on_row or (lambda number, row: None))
    finally:
        for member in members:
            if isinstance(member.policy, LivesOutside):
                member.policy.close()


def _check(members: Sequence[Member], meet_every: float) -> None:
    """Refuses invalid teams.

    Raises:
        ValueError: says what is wrong.
    """
    if not members:
        raise InputError("a team needs at least one member")
    if not meet_every >= 0.0:
        raise InputError(f"meet_every must be a time >= 0 [s], got {meet_every}")
    box = np.asarray(members[0].simulator.bounds)
    for number, member in enumerate(members):
        if not np.array_equal(member.simulator.bounds, box):
            raise InputError(
                f"member {number} is in another world than member 0: its box is "
                f"{np.asarray(member.simulator.bounds).tolist()}, not {box.tolist()}"
            )


def _start(
    number: int,
    members: Sequence[Member],
    budget: Budget,
    seed: int,
    config: ExplorationConfig,
    on_stage: Callable[[str], None] | None,
    recorded: Run | None,
) -> tuple[Mission, LoopState]:
    """Prepares one member: its mission, and its state before the first view."""
    key = jax.random.key(seed)
    # The first member is the camera that `explore` would fly alone.
    init_key, key = jax.random.split(jax.random.fold_in(key, number) if number else key)
    mission = Mission(
        GuardedSimulator(members[number].simulator, views=len(recorded.rows) if recorded else 0),
        members[number].policy,
        budget,
        key,
        config,
        make_clock(config),
        on_stage=on_stage or (lambda stage: None),
    )
    others = [m.simulator.start_pose for i, m in enumerate(members) if i != number]
    return mission, start_state(mission, init_key, others)


def _fly(
    flying: list[_Flying], meet_every: float, on_row: Callable[[int, StepRow], None]
) -> TeamResult:
    """Steps until no member flies any more, and lets all meet at the end."""
    first = flying[0]
    config = first.mission.config
    common = Common(first_map(config), first.state.grid)
    views: list[TeamView] = []
    try:
        while any(me.stop is None for me in flying):
            # Of two with the same clock the first one: `min` keeps the order.
            me = min((me for me in flying if me.stop is None), key=lambda me: me.state.seconds)
            until = last_meeting(me.state.seconds, meet_every)
            common = _meet(flying, common, until, views)
            me = _take_over(flying[me.number], common)
            me, observation = _step(me, _promised_to(me, common))
            flying[me.number] = me
            if observation is not None:
                common = replace(common, waiting=(*common.waiting, observation))
                on_row(me.number, me.rows[-1])
    except KeyboardInterrupt:
        _stop_all(flying, StopReason.INTERRUPTED, "interrupted by the user")
    except RecordingStopped as error:
        _stop_all(flying, StopReason.RECORDING_STOPPED, str(error))
    except Exception as error:
        _stop_all(flying, StopReason.FAILED, f"{type(error).__name__}: {error}")
        for me in flying:
            _finish(me, me.state)
        raise
    common = _meet(flying, common, math.inf, views)
    results = tuple(_finish(me, _with_common(me.state, common)) for me in flying)
    return TeamResult(results, tuple(views), common.map_state, common.grid)


def _meet(flying: list[_Flying], common: Common, until: float, views: list[TeamView]) -> Common:
    """Adds all frames up to a time to the common map, and sends them to every member.

    Their views are appended to `views`.
    """
    mission = flying[0].mission
    common, shared = share(common, until, mission.config, repeat_compiled=mission.clock.measures)
    for me in flying:
        if shared and me.stop is None:
            flying[me.number] = replace(me, received=(*me.received, *shared))
    views += [frame.view for frame in shared]
    return common


def _take_over(me: _Flying, common: Common) -> _Flying:
    """Replaces a member's map by the common one, with its own unshared frames on top."""
    received = me.received
    if all(shared.view.member == me.number for shared in received):
        return replace(me, received=())  # one's own map is just that already
    me.mission.on_stage("map")
    clock, config = me.mission.clock, me.mission.config
    map_state, grid = common.map_state, common.grid
    owed = me.owed
    for observation in in_order(common.waiting):
        if observation.member == me.number:
            (map_state, grid), seconds = timed(
                add_frame,
                map_state,
                grid,
                observation.frame,
                config,
                repeat_compiled=clock.measures,
            )
            owed += clock.charge("mapping", seconds)
    planner = replace(me.state.planner, map_state=map_state, grid=grid)
    for shared in received:
        seconds = 0.0
        if shared.view.member != me.number:
            planner, seconds = timed(
                tell_policy, planner, shared.frame, repeat_compiled=clock.measures
            )
        owed += clock.charge("mapping", shared.mapping + seconds)
    return replace(me, state=replace(me.state, planner=planner), received=(), owed=owed)


def _with_common(state: LoopState, common: Common) -> LoopState:
    """Returns the state with the common map and grid."""
    planner = replace(state.planner, map_state=common.map_state, grid=common.grid)
    return replace(state, planner=planner)


def _promised_to(me: _Flying, common: Common) -> tuple[PromisedView, ...]:
    """Returns the views that the others were heading for at the last meeting."""
    first: dict[int, Observation] = {}
    for observation in in_order(common.waiting):
        if observation.member != me.number:
            first.setdefault(observation.member, observation)
    return tuple(
        PromisedView(s.frame.camera, np.asarray(s.frame.T_world_camera)) for s in first.values()
    )


def _step(me: _Flying, promised: tuple[PromisedView, ...]) -> tuple[_Flying, Observation | None]:
    """Takes the next frame of one member, or ends its mission.

    A recorded frame is processed again instead.
    """
    mission, state = me.mission, me.state
    if promised:
        scoring = ScoringConfig(max_range=jnp.asarray(mission.config.max_range, jnp.float32))
        state = _decided_by(state, ReservedViews(mission.policy, promised, scoring))
    if me.recorded is not None and me.state.views < len(me.recorded.rows):
        row = me.recorded.rows[me.state.views]
        frame = me.recorded.frame(row.step)
        after, _ = relive(state, mission, row, frame)
        after = _decided_by(after, mission.policy)
    else:
        after, output = step(state, mission, exchange=me.owed)
        after = _decided_by(after, mission.policy)
        if isinstance(output, Stop):
            return replace(me, stop=output), None
        row, frame = output.row, output.frame
        if me.recorder is not None:
            mission.on_stage("record")
            me.recorder.record_view(output, after, mission.config)
    me = replace(me, state=after, rows=(*me.rows, row), owed=0.0)
    return me, Observation(after.seconds, me.number, frame)


def _decided_by(state: LoopState, policy: Policy) -> LoopState:
    """Returns the state with its planner's policy replaced."""
    return replace(state, planner=replace(state.planner, policy=policy))


def _stop_all(flying: list[_Flying], reason: StopReason, why: str) -> None:
    for me in flying:
        if me.stop is None:
            message = f"{why}, after {me.state.counts}"
            flying[me.number] = replace(me, stop=Stop(reason, message))


def _finish(me: _Flying, state: LoopState) -> Result:
    """Records how a member ended, and returns its result."""
    assert me.stop is not None
    stop = me.stop if me.recorder is None else me.recorder.record_end(state, me.stop)
    return Result(state, me.rows, stop.reason, stop.message)
