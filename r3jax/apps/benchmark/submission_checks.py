"""What a submission must keep to be judged: scene, start, free space, speed, clock, budget.

Every rule is one that the loop keeps by itself for a policy that runs here. They bound what is
possible from outside: how a policy came to its views is its own affair.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from r3jax.exploration.captures import Rules, allowed_turns, elevations_of
from r3jax.exploration.clock import model_clock
from r3jax.exploration.config import Budget, ExplorationConfig, as_written, parse_budget
from r3jax.formats.submissions import Submission, SubmittedFrame
from r3jax.geometry.cameras import Camera, angle_between
from r3jax.planning.robot.limits import begin_at
from r3jax.planning.robot.motion import Motion
from r3jax.planning.turning import Turning, along, direction_of, turn
from r3jax.simulators.base import Simulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import scene_hash

CLEARANCE = 0.15
"""Least distance of the camera's path to every surface [m]. Paths of policies keep a cell of 0.2 m
between them and what is not known to be free; a surface may reach 0.05 m into a cell before a hit
marks it. Glass that the depth sensor does not see is left out, as no policy can know of it."""

_MAX_LENGTH = 20_000.0
"""Of all paths together [m]; eleven hours of flight at the speed of the protocol."""

_SAME_PLACE = 2e-3
"""Places this close are one [m]."""

_SAME_ANGLE = 0.1
"""Angles this close are one [deg]."""


@dataclass(frozen=True)
class Problem:
    """A rule that a submission breaks."""

    frame: int | None
    """Number of the frame; None: of the terms, in the first line."""

    text: str
    """What is wrong, and what to do."""

    def __str__(self) -> str:
        """Says where, then what."""
        where = "line 1" if self.frame is None else f"line {self.frame + 2}, frame {self.frame}"
        return f"{where}: {self.text}"


@dataclass(frozen=True)
class _Terms:
    """What all frames keep."""

    budget: Budget
    config: ExplorationConfig
    motion: Motion
    heights: tuple[float, float]
    """Lowest and highest place of the camera [m], world."""

    camera: Camera
    """Of every frame."""

    @property
    def speed(self) -> float:
        """Along the path [m/s]."""
        return self.motion.speed or self.config.speed

    def cost(self, stage: str) -> float:
        """The least that a stage takes on the mission clock [s]."""
        return model_clock(self.config).costs[stage] if self.config.clock == "model" else 0.0


@dataclass(frozen=True)
class _Step:
    """A frame, and how the camera came to it."""

    frame: SubmittedFrame
    before: SubmittedFrame
    """The frame before."""

    path: np.ndarray
    """Waypoints from there, [K, 3] [m]."""

    metres: float
    """Path up to the frame [m]."""

    metres_before: float
    """Path up to the frame before [m]."""

    views: int
    """Views that were chosen, this one or the one on the way to which it was captured included."""

    @property
    def length(self) -> float:
        """Length of the path from the frame before [m]."""
        return float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    @property
    def seconds(self) -> float:
        """Mission clock from the frame before until the camera arrives [s]."""
        return self.frame.seconds - self.frame.mapping - self.before.seconds

    @property
    def turn(self) -> float:
        """Angle between the two views [deg]."""
        views = (self.before.pose.astype(np.float64), self.frame.pose.astype(np.float64))
        return math.degrees(angle_between(*views))


def check_submission(submission: Submission, simulator: Simulator) -> list[Problem]:
    """Lists the rules that a submission breaks, in the order of its lines.

    Args:
        submission: as it was read.
        simulator: its scene, opened as it says.

    Raises:
        ValueError: the simulator has no mesh to check paths against; a budget, or a start, that
            cannot be.
    """
    found = scene_hash(simulator)
    if found != submission.scene["hash"]:
        told = (
            f"the scene {submission.scene['name']} has the hash {found[:12]} here, "
            f"{submission.scene['hash'][:12]} in the submission: use the file of the scene, and "
            "the r3jax, that the views were chosen with"
        )
        return [Problem(None, told)]
    motion, truth = submission.robot, GroundTruth(simulator)
    start = begin_at(motion, simulator.start_pose)
    heights = motion.heights_from(float(start[2, 3]))
    budget, camera = parse_budget(submission.budget), submission.intrinsics
    terms = _Terms(budget, submission.config, motion, heights, camera)
    legs = list(_legs(submission))
    steps = [step for leg in legs for step in leg]
    length = sum(step.length for step in steps)
    if not length <= _MAX_LENGTH:
        told = f"its paths are {length:.3g} m long, more than {_MAX_LENGTH:g} m are not checked"
        return [Problem(None, f"{told}: are the positions in meters? Submit a shorter run")]
    # All paths at once: one by one, ten thousand frames would take a minute.
    rooms = truth.room_along([step.path for step in steps], CLEARANCE)
    room_of = {step.frame.frame: found for step, *found in zip(steps, *rooms, strict=True)}
    problems: list[Problem] = []
    for leg in legs:
        of_leg = [*_on_the_way(leg, terms), *_looks_ahead(leg, terms)]
        for step in leg:
            texts = [
                *_in_budget(step, terms),
                *_within_limits(step, terms),
                *_in_free_space(*room_of[step.frame.frame]),
                *_is_mapped(step, terms),
                *(_at_start(step, start, submission.seed) if step.frame.frame == 0 else ()),
                *(_in_time(step, terms) if step.frame.frame > 0 else ()),
            ]
            of_leg += [Problem(step.frame.frame, text) for text in texts]
        problems += sorted(of_leg, key=lambda problem: problem.frame or 0)
    return problems


def _legs(submission: Submission) -> Iterator[list[_Step]]:
    """The frames on the way to each view that was chosen, and that view.

    The last leg may end on its way, as a run does that has spent its budget there.
    """
    leg: list[_Step] = []
    for step in _steps(submission):
        leg.append(step)
        if not step.frame.captured:
            yield leg
            leg = []
    if leg:
        yield leg


def _steps(submission: Submission) -> Iterator[_Step]:
    before, metres, views = submission.frames[0], 0.0, 0
    for frame, path in zip(submission.frames, submission.paths(), strict=True):
        # A frame on the way belongs to the view that it was captured on the way to.
        step = _Step(frame, before, path, metres, metres, views + 1)
        flown = metres + step.length if frame.metres is None else frame.metres
        yield _Step(frame, before, path, flown, metres, views + 1)
        before, metres, views = frame, flown, views + (not frame.captured)


def _at_start(step: _Step, start: np.ndarray, seed: int) -> Iterator[str]:
    """The first frame is taken at the scene's start, at no cost."""
    apart = float(np.linalg.norm(step.frame.position - start[:3, 3]))
    turned = math.degrees(angle_between(step.frame.pose.astype(np.float64), start))
    if apart > _SAME_PLACE or turned > _SAME_ANGLE:
        yield (
            f"it lies {apart:.3f} m and {turned:.2f} degrees from the scene's start at "
            f"{start[:3, 3].round(4).tolist()}: begin there; the seed {seed} decides where that is"
        )
    if step.frame.captured:
        yield "it is captured on the way from nowhere: leave `captured` out"
    if step.frame.seconds < _less(step.frame.mapping):
        yield f"`seconds` is {step.frame.seconds:g}, less than its mapping: the clock begins at 0"
    if step.frame.metres:
        yield f"it comes after {step.frame.metres:g} m: the path begins here"


def _on_the_way(leg: list[_Step], terms: _Terms) -> Iterator[Problem]:
    """There are no more frames on the way than the loop takes, nor closer together."""
    captured = [step for step in leg if step.frame.captured]
    if not captured:
        return
    first, num = captured[0].frame.frame, len(captured)
    if not terms.config.captures:
        told = "`exploration` in line 1 has neither `capture_every` nor `capture_rate`"
        yield Problem(first, f"it is captured on the way, but {told}: leave `captured` out")
        return
    # Of the path itself: `metres` may say more than was flown.
    length, longest = sum(step.length for step in leg), terms.config.piece_at(terms.speed)
    if num == len(leg) - 1 and length < num * _less(longest):
        told = f"{num} frames are captured on the {length:.3f} m to frame {leg[-1].frame.frame}"
        yield Problem(first, f"{told}, one each {longest:g} m are allowed: capture fewer")
    # The loop cuts a path into the fewest equal pieces that are not too long: where there are n + 1
    # of them or more, they are longer than n / (n + 1) of the longest one.
    least = longest * num / (num + 1)
    for step in captured:
        if step.length < _less(least):
            told = f"it is captured {step.length:.3f} m after the frame before"
            yield Problem(step.frame.frame, f"{told}: keep {least:.3f} m on this leg")


def _looks_ahead(leg: list[_Step], terms: _Terms) -> Iterator[Problem]:
    """On the way a fixed camera looks along it, as nearly as the loop lets it turn.

    Where a leg does not end, nobody knows what the camera must be able to turn to.
    """
    if not terms.motion.fixed_camera or leg[-1].frame.captured:
        return
    turning = _turning_on(leg, terms)
    low, high = turning.elevations
    for piece, (step, after) in enumerate(itertools.pairwise(leg)):
        now = direction_of(step.before.pose)
        azimuth, elevation = along(after.frame.position - step.frame.position, now)
        wanted = np.array([azimuth, np.clip(elevation, low, high)])
        off = math.degrees(turn(direction_of(step.frame.pose), wanted))
        least = math.degrees(turn(turning.nearest(piece, now, wanted), wanted))
        if off > least + _SAME_ANGLE:
            told = f"it looks {off:.1f} degrees off the way to the next frame"
            text = f"{told}, a fixed camera at most {least:.1f}: look ahead"
            yield Problem(step.frame.frame, text)


def _turning_on(leg: list[_Step], terms: _Terms) -> Turning:
    """How far the camera can turn between the frames of a leg: as the loop has it."""
    begin, end, motion = leg[0].before, leg[-1].frame, terms.motion
    seconds = np.array([step.length for step in leg]) / terms.speed
    # To the chosen view the robot turns after it has flown.
    seconds[-1] += motion.turning(angle_between(begin.pose.astype(np.float64), end.pose))
    stops = np.stack([begin.position, *(step.frame.position for step in leg)])
    allowed = allowed_turns(stops, seconds, Rules(terms.config, motion, terms.camera))
    # Rounded, a turn that the loop takes for too long may seem to fit.
    allowed *= 1.0 - 1e-4
    ends = direction_of(begin.pose), direction_of(end.pose)
    return Turning(*ends, allowed, elevations_of(motion))


def _in_budget(step: _Step, terms: _Terms) -> Iterator[str]:
    """The frame arrives within the budget."""
    arrival, frames = step.frame.seconds - step.frame.mapping, step.frame.frame + 1
    spent = {"views": step.views, "frames": frames, "seconds": arrival, "metres": step.metres}
    if not terms.budget.allows(
        views=step.views, frames=frames, seconds=arrival, metres=step.metres
    ):
        spent_of_it = f"{spent[terms.budget.unit]:g} {terms.budget.unit}"
        told = f"it takes {spent_of_it}, beyond the budget {terms.budget}: end before it"
        yield as_written(told)


def _within_limits(step: _Step, terms: _Terms) -> Iterator[str]:
    """What carries the camera can be there, and look there."""
    motion, (low, high) = terms.motion, terms.heights
    lowest, highest = float(step.path[:, 2].min()), float(step.path[:, 2].max())
    if lowest < low - _SAME_PLACE or highest > high + _SAME_PLACE:
        yield (
            f"its path reaches from {lowest:.3f} to {highest:.3f} m in height, the robot from "
            f"{low:.3f} to {high:.3f} m: stay there"
        )
    elevation = math.degrees(math.asin(max(-1.0, min(1.0, float(step.frame.pose[2, 2])))))
    least, most = motion.elevations
    if not least - _SAME_ANGLE <= elevation <= most + _SAME_ANGLE:
        yield (
            f"it looks {elevation:.2f} degrees above the horizon, the robot can from {least:g} to "
            f"{most:g}: turn the view"
        )
    straight = float(np.linalg.norm(step.frame.position - step.before.position))
    allowed = math.inf if motion.turn_per_meter is None else motion.turn_per_meter * straight
    if step.turn > allowed + _SAME_ANGLE:
        yield (
            f"it turns by {step.turn:.1f} degrees over {straight:.3f} m, the robot by at most "
            f"{allowed:.1f}: turn less, or go farther"
        )


def _in_free_space(room: float, place: np.ndarray) -> Iterator[str]:
    """Nothing is nearer to the path than the clearance."""
    if room < CLEARANCE:
        what = "runs through a surface" if room == 0.0 else f"comes as near as {room:.3f} m to one"
        yield (
            f"its path {what} at {place.round(3).tolist()}: keep {CLEARANCE} m, or give the "
            "waypoints of a path round it as `path`"
        )


def _is_mapped(step: _Step, terms: _Terms) -> Iterator[str]:
    """Mapping takes its time."""
    mapping, least = step.frame.mapping, terms.cost("mapping")
    if mapping < _less(least):
        clock = f"on the model clock it takes {least:g} s" if least else "it takes no less than 0 s"
        yield f"`mapping` is {mapping:g} s, {clock}"


def _in_time(step: _Step, terms: _Terms) -> Iterator[str]:
    """The path begins and ends at the views, and the clock leaves time for it."""
    ends = np.stack([step.before.position, step.frame.position])
    apart = np.linalg.norm(step.path[[0, -1]] - ends, axis=1)
    if apart.max() > _SAME_PLACE:
        yield f"its path ends {apart.max():.3f} m from a view: begin at the one before, end at it"
    flown = step.metres - step.metres_before
    if flown < _less(step.length):
        yield f"`metres` grows by {flown:.4f}, the path has {step.length:.4f} m: count all of it"
    needed, why = _least_seconds(step, terms, max(flown, step.length))
    if step.seconds < _less(needed):
        yield (
            f"it arrives {step.seconds:.4f} s after the frame before, {why} take {needed:.4f} s: "
            "count planning and flight"
        )


def _least_seconds(step: _Step, terms: _Terms, length: float) -> tuple[float, str]:
    """The least time that a decision and a flight take, and what it is made of."""
    rate, flight = terms.motion.turn_rate, length / terms.speed
    turning = 0.0 if rate is None else step.turn / rate
    # On the way the camera turns while it flies; to a view it flies first.
    is_whole = not (step.frame.captured or step.before.captured)
    flight = flight + turning if is_whole else max(flight, turning)
    why = f"{length:.3f} m at {terms.speed:g} m/s"
    if rate is not None:
        why += f" and a turn by {step.turn:.1f} degrees at {rate:g} degrees/s"
    if step.before.captured or terms.config.clock != "model":  # decided before, or measured
        return flight, why
    stage = "reconsidering" if terms.config.plan_while_moving else "planning"
    return flight + terms.cost(stage), f"a decision on the model clock and {why}"


def _less(value: float) -> float:
    """A length [m] or a time [s] with what rounding may take from it."""
    return value * (1.0 - 1e-4) - 1e-4
