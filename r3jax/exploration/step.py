"""One step of the loop: decide, move, render, map.

On the host, around jitted parts. A step takes one frame: the chosen view, or one on the path to it
if frames are captured while moving. The time of the simulator and of bookkeeping is not on the
mission clock.
"""

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from r3jax.exploration.captures import Leg, aim, begin_leg, observe_view
from r3jax.exploration.coverage import measure_coverage, view_renderability
from r3jax.exploration.guard import first_pose
from r3jax.exploration.state import LoopState, Mission, PlannedAhead, Stop, StopReason, timed
from r3jax.exploration.taken_views import (
    StepRow,
    TakenView,
    frame_hash,
    make_choice,
    stored_form,
)
from r3jax.frame import Frame
from r3jax.geometry.cameras import angle_between
from r3jax.planning.planner import (
    Planner,
    at_hand,
    decide,
    decide_ahead,
    follow,
    reconsider,
    start,
)
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.robot.motion import motion_of


def start_state(
    mission: Mission, init_key: jax.Array, other_starts: Iterable[np.ndarray] = ()
) -> LoopState:
    """Makes the state before the first view.

    Args:
        mission: settings of the run.
        init_key: key for the policy's initial memory.
        other_starts: initial poses [4, 4] of other cameras, around which space is free, too.

    Raises:
        ValueError: see `guard.first_pose`.
    """
    simulator, config = mission.simulator, mission.config
    pose = first_pose(simulator, motion_of(mission.policy), config)
    planner = start(
        simulator.camera,
        np.asarray(simulator.bounds, dtype=np.float64),
        mission.policy,
        starts=[pose, *other_starts],
        config=config,
        key=init_key,
    )
    return LoopState(0, planner, pose)


def step(
    state: LoopState, mission: Mission, *, exchange: float = 0.0
) -> tuple[LoopState, TakenView | Stop]:
    """Takes one frame: decides on a view (except at the start), moves, renders and maps.

    During a path there is no decision: its next frame is taken.

    Args:
        state: before the frame.
        mission: settings of the run.
        exchange: time on the mission clock for receiving frames of other cameras since the last
            view [s].

    Returns:
        The state after the view and its record; or, if the run ends, the unchanged state and the
        reason.
    """
    charged = {"exchange": exchange} if exchange else {}
    if state.views == 0:
        # Free of charge: the camera is there already, and no policy chose the view.
        here = state.T_world_camera
        return _look(state, mission, here, None, {}, {"planning": 0.0} | charged)
    if state.leg is not None:
        return _next_frame(state, mission, state.leg, {}, {"planning": 0.0} | charged)
    # Before deciding: with a spent budget the decision could not be carried out.
    stop = _spent(state, mission, seconds=exchange, metres=0.0)
    # After the budget: a forecast takes almost a second, and a finished run needs none.
    if stop is None:
        stop = _good_enough(state, mission)
    if stop is not None:
        return state, stop
    chosen = _choose(state, mission)
    if chosen.decision is None:
        return replace(state, planner=chosen.planner), _no_decision(state, mission, chosen.info)
    state, leg, stages = _depart(state, mission, chosen.decision, chosen)
    return _next_frame(state, mission, leg, stages, {"planning": chosen.charge} | charged)


class _Chosen(NamedTuple):
    """A decision and its costs."""

    decision: Decision | None
    planner: Planner
    info: PlanInfo
    charge: float
    """Cost on the mission clock [s]."""
    hidden: float
    """Time hidden by the flight before [s]."""
    stages: dict[str, float]
    """Measured time [s]."""


def _choose(state: LoopState, mission: Mission) -> _Chosen:
    """Chooses the next view; reconsiders a decision made while moving."""
    mission.on_stage("plan")
    clock, planned = mission.clock, state.planned
    # By the number of the view, so that a resumed run draws the same numbers.
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


def _depart(
    state: LoopState, mission: Mission, decision: Decision, chosen: _Chosen
) -> tuple[LoopState, Leg, dict[str, float]]:
    """Begins the path of a decision; with planning while moving, the next decision is made, too.

    Returns:
        The state, the path, and the times of the stages so far [s].
    """
    leg = begin_leg(decision, chosen.info, state.T_world_camera, mission.rules)
    leg = replace(leg, hidden=chosen.hidden)
    state = replace(state, planner=chosen.planner, planned=None)
    if not mission.config.plan_while_moving:
        return state, leg, chosen.stages
    state, seconds = _plan_ahead(state, mission, leg)
    return state, leg, chosen.stages | {"plan ahead": seconds}


def _plan_ahead(state: LoopState, mission: Mission, leg: Leg) -> tuple[LoopState, float]:
    """Makes the decision for the end of a path in advance; returns the state, and its time [s].

    It predicts the view at the end of the path, but not the frames captured while moving, whose
    directions are only chosen later.
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
    """Moves along the next piece of a path and takes the frame at its end.

    Args:
        state: before the frame.
        mission: settings of the run.
        leg: the path.
        stages: seconds that stages took so far.
        before: time charged until the camera begins to fly [s].
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
    return _look(state, mission, pose, leg, stages, before)


def _no_decision(state: LoopState, mission: Mission, info: PlanInfo) -> Stop:
    """Describes why the policy made no decision."""
    return Stop(
        StopReason(info.outcome.value),
        f"after {state.counts} the policy {state.planner.policy.name!r} drew "
        f"{info.num_candidates} candidates, {info.num_reachable} of them reachable through "
        "known free space",
    )


def _spent(state: LoopState, mission: Mission, *, seconds: float, metres: float) -> Stop | None:
    """Returns the stop reason if a view at this additional cost would exceed the budget."""
    spent = f"{state.counts}, {state.seconds:.1f} s, {state.metres:.1f} m"
    if not mission.budget.allows(
        views=state.chosen + 1,
        frames=state.views + 1,
        seconds=state.seconds + seconds,
        metres=state.metres + metres,
    ):
        return Stop(StopReason.BUDGET, f"{spent}: the budget of {mission.budget.words} is used up")
    # A policy that only turns spends no meters: such a budget alone would never end the run.
    if state.still_views >= mission.config.max_still_views:
        return Stop(
            StopReason.STUCK,
            f"{spent}: the last {state.still_views} views are from one position",
        )
    return None


def _good_enough(state: LoopState, mission: Mission) -> Stop | None:
    """Returns the stop reason if the goal is reached; not on the mission clock."""
    if mission.is_enough is None or state.chosen % mission.config.until_every:
        return None
    mission.on_stage("forecast")
    reason = mission.is_enough(state)
    return None if reason is None else Stop(StopReason.FORECAST, reason)


def _look(
    state: LoopState,
    mission: Mission,
    T_world_camera: np.ndarray,
    leg: Leg | None,
    stages: dict[str, float],
    before: dict[str, float],
) -> tuple[LoopState, TakenView]:
    """Takes a frame, integrates it and measures the coverage.

    Args:
        state: before the frame.
        mission: settings of the run.
        T_world_camera: pose of the frame, [4, 4].
        leg: the path to it; None: the camera is there.
        stages: seconds that stages took so far.
        before: time charged until the camera begins to fly [s].
    """
    captured = leg is not None and not leg.is_last
    # A decision is recorded with the first frame of its path.
    decided = leg if leg is not None and leg.taken == 0 else None
    mission.on_stage("render")
    begin = time.perf_counter()
    frame = _render(mission, state.views, T_world_camera)
    # Read here: what follows is bookkeeping, not time of the simulator.
    stages = stages | {"render": time.perf_counter() - begin}
    mission.on_stage("map")
    measures = mission.clock.measures
    position = np.asarray(frame.T_world_camera)[:3, 3]
    planner, moving = state.planner, 0.0
    if planner.far is not None:
        planner, moving = timed(at_hand, planner, position, repeat_compiled=measures)
    # On the map before the frame, for which the view was chosen.
    arrival = view_renderability(planner.map_state, frame.camera, frame.T_world_camera)
    planner, measured = timed(
        observe_view, planner, frame, mission.rules, captured=captured, repeat_compiled=measures
    )
    measured += moving
    mapping = mission.clock.charge("mapping", measured)
    length, flight = (0.0, 0.0) if leg is None else (leg.length, leg.flight)
    charged = before | {"mapping": mapping, "flight": flight}
    state = _arrive(state, planner, frame, length, charged, captured=captured)
    state = replace(state, leg=None if leg is None else leg.after)
    mission.on_stage("measure")
    begin = time.perf_counter()
    coverage = measure_coverage(
        state.map_state,
        state.grid,
        frame.camera,
        arrival_renderability=arrival,
        num_probes=mission.config.num_probes,
        far=state.planner.far,
    )
    row = StepRow(
        step=state.views - 1,
        # The frame's float32 pose, not that of the decision, as in a replay.
        pose=np.asarray(frame.T_world_camera),
        sha256=frame_hash(frame),
        choice=make_choice(decided.decision, decided.info) if decided else None,
        seconds=state.seconds,
        metres=state.metres,
        radians=state.radians,
        charged=charged,
        coverage=coverage,
        captured=captured,
        hidden=decided.hidden if decided else 0.0,
    )
    stages = stages | {"map": measured, "measure": time.perf_counter() - begin}
    return state, TakenView(row, frame, stages, decided.decision if decided else None)


def _render(mission: Mission, view: int, T_world_camera: np.ndarray) -> Frame:
    """Takes the image of a view, in stored form."""
    # Rounded as in the trace: the image is taken at exactly the recorded pose, so that poses
    # suffice to render the images again.
    pose = np.asarray(T_world_camera, dtype=np.float32).astype(np.float64)
    # Committed first, so that other images are detected.
    mission.simulator.commit(view, pose)
    # Rounded as on disk before it enters the map, so that a replay integrates the same bits.
    return stored_form(mission.simulator.render(pose))


def relive(
    state: LoopState, mission: Mission, row: StepRow, frame: Frame, *, decides: bool = True
) -> tuple[LoopState, Decision | None]:
    """Recomputes the state after a recorded frame, as `step` leaves it, without the simulator.

    Args:
        state: before the frame.
        mission: settings of the run.
        row: its row in the trace.

        frame: the frame, read back.
        decides: let the policy decide again, to restore its memory. Policies are pure: the same
            state and key give the same decision. False if the policy did not choose this view: it
            only gets the path.

    Returns:
        The state after the frame, and the policy's decision, if it made one.
    """
    leg, decision = state.leg, None
    if row.choice is not None:
        if decides:
            # Only the memory after the decision is used: pose and times are in the row, and
            # measuring again would change the mission clock.
            chosen = _choose(state, mission)
            decision = chosen.decision
            if decision is None:
                state, leg = replace(state, planner=chosen.planner, planned=None), None
            else:
                state, leg, _ = _depart(state, mission, decision, chosen)
        else:
            planner = follow(state.planner, state.T_world_camera, row.choice.waypoints)
            state, leg = replace(state, planner=planner, planned=None), None
    planner = observe_view(state.planner, frame, mission.rules, captured=row.captured)
    length, metres = row.metres - state.metres, row.metres
    if row.choice is not None and not row.captured:  # a whole path
        length = row.choice.length
        metres = state.metres + length
    state = _arrive(state, planner, frame, length, row.charged, captured=row.captured)
    # A path ends with the chosen view.
    leg = leg.after if leg is not None and row.captured else None
    return replace(state, metres=metres, leg=leg), decision


def _arrive(
    state: LoopState,
    planner: Planner,
    frame: Frame,
    length: float,
    charged: dict[str, float],
    *,
    captured: bool,
) -> LoopState:
    """Adds one frame: the pose is the frame's, and the totals include the path to it.

    The recorded pose (float32) is used from here on, so that a resumed run is identical.
    """
    pose = np.asarray(frame.T_world_camera, dtype=np.float64)
    return replace(
        state,
        planner=planner,
        views=state.views + 1,
        captured=state.captured + captured,
        T_world_camera=pose,
        # One sum per view, as in the original run: `_agrees` compares the clock bit by bit.
        seconds=state.seconds + sum(charged.values()),
        metres=state.metres + length,
        radians=state.radians + angle_between(state.T_world_camera, pose),
        # Paths below a centimeter are rounding: turning in place does not count as moving.
        still_views=state.still_views + 1 if length < 0.01 else 0,
    )
