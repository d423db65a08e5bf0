"""The frames of one path: those captured while moving, and the chosen view at its end.

A path is divided into equal pieces, with a frame at the end of each. Captures do not change the
time of the flight: the camera turns while it moves, but never so far that it would be late for the
chosen view (`planning.turning`). Without captures a path is one piece.

Shape symbols: n frames; K waypoints.
"""

import math
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.planning.planner import Planner, take_in
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.robot.motion import Motion
from r3jax.planning.turning import (
    Turning,
    along,
    axes_within,
    count_look,
    direction_of,
    exhausted_cells,
    panorama_scores,
    pose_towards,
    worthwhile_grid,
)
from r3jax.scoring.config import ScoringConfig


@dataclass(frozen=True)
class CaptureSettings:
    """Everything that is fixed during a run and determines the frames along paths."""

    config: ExplorationConfig
    """Settings of the pieces and of the gaze."""

    motion: Motion
    """The robot."""

    camera: Camera
    """Camera of the frames."""

    @property
    def scoring(self) -> ScoringConfig:
        """Settings of the utility of a frame captured while moving."""
        return scoring_on_the_way(self.config)

    @property
    def gaze(self) -> str:
        """The gaze; a camera that cannot turn by itself looks ahead."""
        return "ahead" if self.motion.fixed_camera else self.config.gaze

    @property
    def speed(self) -> float:
        """Speed along the path [m/s]."""
        return self.motion.speed or self.config.speed

    def flight(self, decision: Decision) -> float:
        """Returns the time of the flight to the chosen view [s].

        If the policy plans its own motion, it is the policy's.
        """
        if decision.seconds is not None:
            return decision.seconds
        return decision.length / self.config.speed


def scoring_on_the_way(config: ExplorationConfig) -> ScoringConfig:
    """Returns the settings of the utility of a frame captured while moving.

    They are the same for every policy.
    """
    return ScoringConfig(max_range=jnp.asarray(config.max_range, jnp.float32))


@dataclass(frozen=True)
class Leg:
    """A path under way."""

    decision: Decision
    info: PlanInfo

    places: np.ndarray
    """Positions of the frames, [n, 3] [m]; the last one is that of the chosen view."""

    lengths: np.ndarray
    """Lengths of the pieces of the path, [n] [m]."""

    seconds: np.ndarray
    """Time for each piece, [n] [s]; the last one includes the rest of the turn."""

    turning: Turning
    """Maximum turn of the camera on each piece."""

    taken: int = 0
    """Number of frames captured so far."""

    hidden: float = 0.0
    """Planning time of the decision that was hidden by the flight before it [s]."""

    @property
    def is_last(self) -> bool:
        """True if the next frame is the chosen view."""
        return self.taken == len(self.places) - 1

    @property
    def length(self) -> float:
        """Length of the piece to the next frame [m]."""
        return float(self.lengths[self.taken])

    @property
    def flight(self) -> float:
        """Time for the piece to the next frame [s]."""
        return float(self.seconds[self.taken])

    @property
    def after(self) -> "Leg | None":
        """The leg once the next frame is taken; None: it has ended."""
        return None if self.is_last else replace(self, taken=self.taken + 1)


def begin_leg(
    decision: Decision, info: PlanInfo, T_world_camera: np.ndarray, rules: CaptureSettings
) -> Leg:
    """Divides the path of a decision into pieces.

    A path no longer than a piece, or too short for its turn, has no frame before its end.

    Args:
        decision: the decision.

        info: information on it.
        T_world_camera: pose at the start of the path, [4, 4].

        rules: settings of the pieces.
    """
    longest = rules.config.piece_at(rules.speed)
    num = max(1, math.ceil(decision.length / longest - 1e-6))
    if num > 1:
        leg = _in_pieces(num, decision, info, T_world_camera, rules)
        if leg.turning.is_possible:
            return leg
    ends = direction_of(T_world_camera), direction_of(decision.T_world_camera)
    return Leg(
        decision,
        info,
        places=decision.T_world_camera[None, :3, 3],
        lengths=np.array([decision.length]),
        seconds=np.array([rules.flight(decision)]),
        turning=Turning(*ends, np.array([np.inf]), elevations_of(rules.motion)),
    )


def _in_pieces(
    num: int, decision: Decision, info: PlanInfo, T_world_camera: np.ndarray, rules: CaptureSettings
) -> Leg:
    """Divides a path into `num` pieces, two or more."""
    places = points_along(decision.waypoints, num)
    places[-1] = decision.T_world_camera[:3, 3]
    flight = rules.flight(decision)
    piece = min(decision.length / rules.speed, flight) / num
    seconds = np.full(num, piece)
    seconds[-1] = flight - (num - 1) * piece
    stops = np.concatenate([T_world_camera[None, :3, 3], places])
    ends = direction_of(T_world_camera), direction_of(decision.T_world_camera)
    turning = Turning(*ends, allowed_turns(stops, seconds, rules), elevations_of(rules.motion))
    return Leg(decision, info, places, np.full(num, decision.length / num), seconds, turning)


def allowed_turns(stops: np.ndarray, seconds: np.ndarray, rules: CaptureSettings) -> np.ndarray:
    """Computes the largest turn on each piece of a path, [n] [rad]; inf if it is not limited.

    Args:
        stops: ends of the pieces, [n + 1, 3] [m].
        seconds: time for each piece, [n] [s].
        rules: settings that limit turns.
    """
    config, motion = rules.config, rules.motion
    allowed = np.full(len(seconds), np.inf)
    if config.exposure > 0.0:  # the chosen view is taken at rest
        allowed[:-1] = config.blur * seconds[:-1] / (float(rules.camera.focal) * config.exposure)
    if motion.turn_rate is not None:
        allowed = np.minimum(allowed, math.radians(motion.turn_rate) * seconds)
    if motion.turn_per_meter is not None:
        straight = np.linalg.norm(np.diff(stops, axis=0), axis=1)
        allowed = np.minimum(allowed, math.radians(motion.turn_per_meter) * straight)
    return allowed


def elevations_of(motion: Motion) -> tuple[float, float]:
    """Returns the lowest and highest elevation of a line of sight [rad]."""
    low, high = np.radians(motion.elevations)
    return float(low), float(high)


def points_along(waypoints: np.ndarray, num: int) -> np.ndarray:
    """Divides the path over waypoints [K, 3] into `num` equal pieces; their ends, [num, 3]."""
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    done = np.concatenate([[0.0], np.cumsum(lengths)])
    at = done[-1] * np.arange(1, num + 1) / num
    return np.stack([np.interp(at, done, waypoints[:, axis]) for axis in range(3)], axis=1)


def aim(
    leg: Leg, T_world_camera: np.ndarray, planner: Planner, rules: CaptureSettings
) -> np.ndarray:
    """Finds the pose of the next frame captured while moving, [4, 4] float64.

    Args:
        leg: the path.

        T_world_camera: of the frame before, [4, 4].
        planner: the planner, including that frame.

        rules: settings of the gaze.
    """
    now, piece, place = direction_of(T_world_camera), leg.taken, leg.places[leg.taken]
    turning = leg.turning
    if rules.gaze == "panorama":
        exhausted = exhausted_cells(planner.policy_state)
        grid = worthwhile_grid(planner.grid, leg.places[leg.taken :], exhausted)
        scores = panorama_scores(planner.map_state, grid, rules.camera, place, rules.scoring)
        axes, directions = axes_within(turning.elevations, len(scores))
        return pose_towards(place, turning.best(piece, now, directions, scores[axes]))
    wanted = along(leg.places[piece + 1] - place, now)
    return pose_towards(place, turning.nearest(piece, now, wanted))


def observe_view(
    planner: Planner, frame: Frame, rules: CaptureSettings, *, captured: bool
) -> Planner:
    """Calls `observe` with a frame of the loop.

    No decision follows a frame captured while moving, so that cells that it failed to show are
    counted here.
    """
    planner = take_in(planner, frame)
    if not captured:
        return planner
    state = count_look(
        planner.policy_state,
        planner.map_state,
        planner.grid,
        frame.camera,
        frame.T_world_camera,
        rules.scoring,
    )
    return replace(planner, policy_state=state)
