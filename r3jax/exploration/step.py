"""One step of the loop: decide, fly, look, map. On the host, round jitted parts.

A step takes one frame: the view that was chosen, or one on the path to it if the settings ask for
captures; without them only the frame at the end of a path enters the map. What the simulator and
the bookkeeping take is not on the mission clock.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np

from r3jax.exploration.captures import (
    Leg,
    Rules,
    aim,
    begin_leg,
    observe_on_the_way,
)
from r3jax.exploration.clock import timed
from r3jax.exploration.coverage import measure_coverage, view_renderability
from r3jax.exploration.state import (
    LoopState,
    Mission,
    PlannedAhead,
    Stop,
    StopReason,
    TakenView,
)
from r3jax.frame import Frame
from r3jax.geometry.cameras import angle_between
from r3jax.mapping.occupancy import MAX_CELLS
from r3jax.planning.planner import (
    Planner,
    decide,
    decide_ahead,
    follow,
    observe,
    reconsider,
    start,
)
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.robot.limits import begin_at
from r3jax.planning.robot.motion import motion_of
from r3jax.trace.images import frame_hash, stored_form
from r3jax.trace.rows import Choice, Coverage, StepRow, make_choice

_LEAST_EXTENT = 1.0
"""Smaller worlds have no place with half a meter free all round [m]."""

_LEAST_HEIGHT = 0.1
"""Thinner ones are surfaces [m]."""

_LEAST_HOUSE, _LARGEST_HOUSE = 2.0, 500.0
"""Extents that what is explored usually has [m]."""


def start_state(
    mission: Mission, init_key: jax.Array, other_starts: Iterable[np.ndarray] = ()
) -> LoopState:
    """The state before the first view.

    Args:
        mission: what the run is asked for.
        init_key: of the policy's first state.
        other_starts: poses [4, 4] where others start at the same time: space that is free, too.

    Raises:
        ValueError: a start pose outside the world's box, or at a height where what carries the
            camera cannot be; a world that cannot be explored (see `check_world`).
    """
    simulator, config = mission.simulator, mission.config
    pose = np.asarray(simulator.start_pose, dtype=np.float64)
    lower, upper = np.asarray(simulator.bounds, dtype=np.float64)
    # The grid ends just beyond the box: outside it no cell is there to fly through.
    if not np.all((pose[:3, 3] >= lower) & (pose[:3, 3] <= upper)):
        raise ValueError(
            f"the start position {pose[:3, 3].round(3).tolist()} lies outside the scene's box "
            f"{lower.round(3).tolist()} .. {upper.round(3).tolist()}"
        )
    # Before the grid is made: its own refusal names no scale that would mend the mesh.
    check_world(simulator.bounds, config.cell_size)
    # The start must be a view that the robot could take itself.
    pose = begin_at(motion_of(mission.policy), pose)
    planner = start(
        simulator.camera,
        np.stack([lower, upper]),
        mission.policy,
        starts=[pose, *other_starts],
        config=config,
        key=init_key,
    )
    return LoopState(0, planner, pose)


def check_world(bounds: np.ndarray, cell_size: float, setting: str = "--cell-size") -> None:
    """Refuses a world that is too small, too flat or too large to be explored.

    Args:
        bounds: its box, [2, 3] [m].
        cell_size: edge of a cell of the coarse grid [m].
        setting: where the user said so.

    Raises:
        ValueError: says what is odd, and which scale would mend it.
    """
    extent = np.ptp(np.asarray(bounds, np.float64), axis=0)
    size = f"the world is {' x '.join(f'{length:.6g}' for length in extent)} m large"
    units = {0.001: "millimeters", 0.01: "centimeters", 1000.0: "kilometers"}
    hints = [
        f"; if its mesh is in {unit}, give --scale {scale:g}"
        for scale, unit in units.items()
        if _LEAST_HOUSE <= scale * extent.max() <= _LARGEST_HOUSE
    ]
    hint = hints[0] if hints else ""
    # Each check is written so that NaN fails it, too.
    if not extent.max() >= _LEAST_EXTENT:
        raise ValueError(f"{size}: too small for a camera with {_LEAST_EXTENT / 2:g} m free{hint}")
    if not extent.min() >= _LEAST_HEIGHT:
        raise ValueError(f"{size}: it is flat, there is no space to explore")
    # The grid has a cell more on every side, as walls lie on the faces of the box.
    cells = float(np.prod(extent / cell_size + 2.0))
    if not cells <= MAX_CELLS:
        raise ValueError(
            f"{size}: {cells:.2g} cells of {cell_size:g} m, more than {MAX_CELLS:.0e}"
            f"{hint or f'; give a larger {setting}, or cut the mesh'}"
        )


def step(
    state: LoopState, mission: Mission, *, exchange: float = 0.0
) -> tuple[LoopState, TakenView | Stop]:
    """One frame: decide where to go (the first view is taken at the start), fly, look, map.

    Where a path is under way nothing is decided: the next frame on it is taken.

    Args:
        state: before the frame.
        mission: what the run is asked for.
        exchange: seconds on the mission clock that went into hearing from others since the last
            view.

    Returns:
        The state after the view and what to record; or, if the run ends here, the state as it
        was and the reason.
    """
    charged = {"exchange": exchange} if exchange else {}
    if state.views == 0:
        # Free of charge: the camera stands there already, and nobody chose the view.
        return _look(state, mission, _Shot(state.T_world_camera), {}, {"planning": 0.0} | charged)
    if state.leg is not None:
        return _next_frame(state, mission, state.leg, {}, {"planning": 0.0} | charged)
    # Before deciding: a spent budget must not pay for a decision that cannot be carried out.
    stop = _spent(state, mission, seconds=exchange, metres=0.0)
    # After the budget: a forecast takes most of a second, and a spent run needs none.
    if stop is None:
        stop = _good_enough(state, mission)
    if stop is not None:
        return state, stop
    chosen = _choose(state, mission)
    if chosen.decision is None:
        return replace(state, planner=chosen.planner), _no_decision(state, mission, chosen.info)
    leg = begin_leg(chosen.decision, chosen.info, state.T_world_camera, mission.rules)
    leg = replace(leg, hidden=chosen.hidden)
    state = replace(state, planner=chosen.planner, planned=None)
    if mission.config.plan_while_moving:
        state, seconds = _plan_ahead(state, mission, leg)
        chosen.stages["plan ahead"] = seconds
    return _next_frame(state, mission, leg, chosen.stages, {"planning": chosen.charge} | charged)


class _Chosen(NamedTuple):
    """A decision, and what it takes."""

    decision: Decision | None
    planner: Planner
    info: PlanInfo
    charge: float
    """Seconds on the mission clock."""
    hidden: float
    """Seconds that the flight before hid."""
    stages: dict[str, float]
    """Seconds that it really took."""


def _choose(state: LoopState, mission: Mission) -> _Chosen:
    """Decides where to go; what was decided on the way is only reconsidered, if it still holds."""
    mission.on_stage("plan")
    clock, planned = mission.clock, state.planned
    # By the number of the view, so that a resumed run draws what it would have drawn.
    key = jax.random.fold_in(mission.key, state.views)
    here, charge, hidden, stages = state.T_world_camera, 0.0, 0.0, dict[str, float]()
    if planned is not None:
        (decision, planner, info), measured = timed(
            reconsider, state.planner, here, planned.decision, key, repeat_compiled=clock.measures
        )
        hidden = planned.hidden
        charge = planned.charge - hidden + clock.charge("reconsidering", measured)
        stages = {"reconsider": measured}
        if decision is not None:
            return _Chosen(decision, planner, info, charge, hidden, stages)
    (decision, planner, info), measured = timed(
        decide, state.planner, here, key, repeat_compiled=clock.measures
    )
    stages |= {"plan": measured} | {f"plan.{k}": v for k, v in info.stage_seconds.items()}
    charge += clock.charge("planning", measured)
    return _Chosen(decision, planner, info, charge, hidden, stages)


def _plan_ahead(state: LoopState, mission: Mission, leg: Leg) -> tuple[LoopState, float]:
    """The state with the decision for when the camera has flown a path, and the seconds it took.

    The decision takes the view at the end of the path as taken, and nothing of those on the way:
    where the camera looks there is found on the way.
    """
    mission.on_stage("plan ahead")
    rules, clock = mission.rules, mission.clock
    key = jax.random.fold_in(mission.key, state.views + len(leg.places))
    target = leg.decision.T_world_camera
    (decision, planner, _), measured = timed(
        decide_ahead,
        state.planner,
        rules.camera,
        target,
        key,
        rules.scoring,
        repeat_compiled=clock.measures,
    )
    if decision is None:
        return state, measured
    charge = clock.charge("planning", measured)
    planned = PlannedAhead(decision, charge, float(leg.seconds.sum()))
    return replace(state, planner=planner, planned=planned), measured


def _next_frame(
    state: LoopState,
    mission: Mission,
    leg: Leg,
    stages: dict[str, float],
    before: dict[str, float],
) -> tuple[LoopState, TakenView | Stop]:
    """Flies the next piece of a path and takes the frame at its end.

    Args:
        state: before the frame.
        mission: what the run is asked for.
        leg: the path.
        stages: seconds that stages took so far.
        before: what is charged for the time until the camera begins to fly [s].
    """
    pose = leg.decision.T_world_camera
    if not leg.is_last:
        mission.on_stage("gaze")
        clock = mission.clock
        pose, measured = timed(
            aim, leg, state.T_world_camera, state.planner, mission.rules,
            repeat_compiled=clock.measures,
        )  # fmt: skip
        stages = stages | {"gaze": measured}
        before = before | {"gaze": clock.charge("gaze", measured)}
    seconds = sum(before.values()) + leg.flight
    # The view has to arrive within the budget, its path included.
    stop = _spent(state, mission, seconds=seconds, metres=leg.length)
    if stop is not None:
        return state, stop
    return _look(state, mission, _Shot(pose, leg), stages, before)


def _no_decision(state: LoopState, mission: Mission, info: PlanInfo) -> Stop:
    """The policy's reason, in words."""
    return Stop(
        StopReason(info.outcome.value),
        f"after {state.in_words} the policy {state.planner.policy.name!r} drew "
        f"{info.num_candidates} candidates, {info.num_reachable} of them reachable through "
        "known free space",
    )


def _spent(state: LoopState, mission: Mission, *, seconds: float, metres: float) -> Stop | None:
    """Why a view that costs so much more must not be taken: it must arrive within the budget."""
    spent = f"{state.in_words}, {state.seconds:.1f} s, {state.metres:.1f} m"
    if not mission.budget.allows(
        views=state.chosen + 1,
        frames=state.views + 1,
        seconds=state.seconds + seconds,
        metres=state.metres + metres,
    ):
        return Stop(
            StopReason.BUDGET, f"{spent}: the next view would exceed {mission.budget.shown}"
        )
    # A policy that only turns spends no meters: such a budget alone would never end the run.
    if state.still_views >= mission.config.max_still_views:
        return Stop(
            StopReason.STUCK, f"{spent}: the last {state.still_views} views were taken on one spot"
        )
    return None


def _good_enough(state: LoopState, mission: Mission) -> Stop | None:
    """Why no further view is needed; asked beside the mission, not on its clock."""
    if mission.is_enough is None or state.chosen % mission.config.until_every:
        return None
    mission.on_stage("forecast")
    reason = mission.is_enough(state)
    return None if reason is None else Stop(StopReason.FORECAST, reason)


@dataclass(frozen=True)
class _Shot:
    """A frame that is to be taken."""

    T_world_camera: np.ndarray
    """Its pose, [4, 4]."""

    leg: Leg | None = None
    """The path to it; None: the camera is there."""

    @property
    def captured(self) -> bool:
        """True for a frame on the way."""
        return self.leg is not None and not self.leg.is_last

    @property
    def decision(self) -> Decision | None:
        """The decision, with the first frame of its path."""
        return None if self.leg is None or self.leg.taken > 0 else self.leg.decision

    @property
    def choice(self) -> Choice | None:
        """What is recorded of the decision."""
        if self.leg is None or self.decision is None:
            return None
        return make_choice(self.decision, self.leg.info)


def _look(
    state: LoopState,
    mission: Mission,
    shot: _Shot,
    stages: dict[str, float],
    before: dict[str, float],
) -> tuple[LoopState, TakenView]:
    """Takes a frame, integrates it and measures what is known now.

    `before` holds what is charged for the time until the camera begins to fly [s].
    """
    mission.on_stage("render")
    begin = time.perf_counter()
    # Rounded as the trace has it: the image is taken from the very pose that is recorded, so that
    # whoever has the poses has the images.
    pose = np.asarray(shot.T_world_camera, dtype=np.float32).astype(np.float64)
    # Announced first, so that an image that nobody chose is noticed.
    mission.simulator.commit(state.views, pose)
    # Rounded as it will be on disk before the map sees it: a replay integrates the same bits.
    frame = stored_form(mission.simulator.render(pose))
    # Read here: what follows is bookkeeping, which the simulator must not be blamed for.
    rendered = time.perf_counter()
    # Of the map before the frame: what had been promised of this view.
    arrival = view_renderability(state.map_state, frame.camera, frame.T_world_camera)
    stages = stages | {"render": rendered - begin}

    mission.on_stage("map")
    planner, measured = timed(
        _observe,
        state.planner,
        frame,
        mission.rules,
        captured=shot.captured,
        repeat_compiled=mission.clock.measures,
    )
    mapping = mission.clock.charge("mapping", measured)
    length, flight = (0.0, 0.0) if shot.leg is None else (shot.leg.length, shot.leg.flight)
    charged = before | {"mapping": mapping, "flight": flight}
    state = _arrive(state, planner, frame, length, charged, captured=shot.captured)
    state = replace(state, leg=None if shot.leg is None else shot.leg.after)
    mission.on_stage("measure")
    begin = time.perf_counter()
    coverage = measure_coverage(
        state.map_state,
        state.grid,
        frame.camera,
        arrival_renderability=arrival,
        num_probes=mission.config.num_probes,
    )
    row = _row(state, frame, shot, charged, coverage)
    stages = stages | {"map": measured, "measure": time.perf_counter() - begin}
    return state, TakenView(row, frame, stages, shot.decision)


def _row(
    state: LoopState,
    frame: Frame,
    shot: _Shot,
    charged: dict[str, float],
    coverage: Coverage,
) -> StepRow:
    """What the trace says of a frame, given the state after it."""
    return StepRow(
        step=state.views - 1,
        # The frame's float32, not what was asked for: a replay has no other pose.
        pose=np.asarray(frame.T_world_camera),
        sha256=frame_hash(frame),
        choice=shot.choice,
        seconds=state.seconds,
        metres=state.metres,
        radians=state.radians,
        charged=charged,
        coverage=coverage,
        captured=shot.captured,
        hidden=0.0 if shot.leg is None or shot.leg.taken else shot.leg.hidden,
    )


def relive(
    state: LoopState, mission: Mission, row: StepRow, frame: Frame, *, decides: bool = True
) -> tuple[LoopState, Decision | None]:
    """The state after a frame that was recorded: as `step` leaves it, without the simulator.

    Args:
        state: before the frame.
        mission: what the run was asked for.
        row: what the trace says of it.
        frame: its frame, read back.
        decides: ask the policy again, for what it remembers of its decision. Policies are pure:
            the same state and key give the same decision. False for a policy that did not
            choose this view: it is told the path.

    Returns:
        The state after the frame, and what the policy decided, where it was asked.
    """
    leg, decision = state.leg, None
    if row.choice is not None:
        if decides:
            # Of the decision only its memory is used: the row knows pose and seconds, and one
            # that is timed again would put other seconds on the mission clock.
            chosen = _choose(state, mission)
            decision = chosen.decision
            state = replace(state, planner=chosen.planner, planned=None)
            state, leg = _leg_again(state, mission, chosen)
        else:
            planner = follow(state.planner, state.T_world_camera, row.choice.waypoints)
            state, leg = replace(state, planner=planner, planned=None), None
    planner = _observe(state.planner, frame, mission.rules, captured=row.captured)
    length, metres = row.metres - state.metres, row.metres
    if row.choice is not None and not row.captured:  # a whole path
        length = row.choice.length
        metres = state.metres + length
    state = _arrive(state, planner, frame, length, row.charged, captured=row.captured)
    # A path ends with the view that was chosen, whatever became of it.
    leg = leg.after if leg is not None and row.captured else None
    return replace(state, metres=metres, leg=leg), decision


def _leg_again(state: LoopState, mission: Mission, chosen: _Chosen) -> tuple[LoopState, Leg | None]:
    """The path of a decision that was made again, and what was decided on that path."""
    if chosen.decision is None:
        return state, None
    leg = begin_leg(chosen.decision, chosen.info, state.T_world_camera, mission.rules)
    if mission.config.plan_while_moving:
        state, _ = _plan_ahead(state, mission, leg)
    return state, leg


def _observe(planner: Planner, frame: Frame, rules: Rules, *, captured: bool) -> Planner:
    """The planner with one frame more."""
    if captured:
        return observe_on_the_way(planner, frame, rules)
    return observe(planner, frame)


def _arrive(
    state: LoopState,
    planner: Planner,
    frame: Frame,
    length: float,
    charged: dict[str, float],
    *,
    captured: bool,
) -> LoopState:
    """One frame more: the pose is the frame's, and the totals count the path to it.

    The recorded pose (float32) is the pose from here on: a run read back goes on the same way.
    """
    pose = np.asarray(frame.T_world_camera, dtype=np.float64)
    return replace(
        state,
        planner=planner,
        views=state.views + 1,
        captured=state.captured + captured,
        T_world_camera=pose,
        # One sum per view, as when it was flown: `_agrees` compares the clock bit by bit.
        seconds=state.seconds + sum(charged.values()),
        metres=state.metres + length,
        radians=state.radians + angle_between(state.T_world_camera, pose),
        # Below a centimeter a path is rounding: turning on the spot does not count as moving.
        still_views=state.still_views + 1 if length < 0.01 else 0,
    )
