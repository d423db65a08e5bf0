"""Chooses viewing directions while moving: those that the camera can turn to in time, by utility.

A direction is an azimuth and an elevation [rad]. A turn is as long as the straight line between two
directions, azimuth wrapped: what a camera without roll turns through, and no less than the angle of
the rotation. Every piece of a path allows a turn of some size. A direction is feasible if the
camera can turn to it on the piece before, and from it to the view at the end on the pieces after:
no frame captured while moving makes the camera late.

On the host: NumPy. Shape symbols: n pieces of a path, the last one ends at the chosen view; m
directions; B bins of a panorama.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.decide import MAX_FAILED_LOOKS, PlannerState
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.limits import angles_of, rotations, wrapped
from r3jax.scoring.batch import score_positions
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import visible_unexplored

_SAME = 1e-6
"""Turns that differ by less than this are equal [rad], the accuracy of float32 poses."""


@dataclass(frozen=True)
class Turning:
    """Maximum turns of the camera on each piece of a path."""

    start: np.ndarray
    """Direction of the view at the start of the path, [2] [rad]."""

    end: np.ndarray
    """Direction of the chosen view, [2] [rad]."""

    allowed: np.ndarray
    """Maximum turn on each piece, [n] [rad]; inf: no limit."""

    elevations: tuple[float, float]
    """Lowest and highest elevation of a viewing direction [rad]."""

    @property
    def is_possible(self) -> bool:
        """True if the camera can turn from the start to the end on the path."""
        return bool(turn(self.start, self.end) <= self.allowed.sum() + _SAME)

    def feasible(self, piece: int, now: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Finds the directions that the camera may have after a piece.

        Args:
            piece: number of the piece.
            now: direction before it, [2].
            directions: to choose from, [m, 2].

        Returns:
            [m] bool.
        """
        in_time = turn(now, directions) <= self.allowed[piece] + _SAME
        return in_time & (turn(directions, self.end) <= self.allowed[piece + 1 :].sum() + _SAME)

    def nearest(self, piece: int, now: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Finds the feasible direction nearest to a wanted one, [2].

        It is exact up to the spacing of a lattice.
        """
        wanted = np.array([wanted[0], np.clip(wanted[1], *self.elevations)])
        allowed = self.allowed[piece]
        own = np.stack([wanted, _towards(now, wanted, allowed), _towards(now, self.end, allowed)])
        directions = np.concatenate([own, axes_within(self.elevations)[1]])
        return self.best(piece, now, directions, -turn(directions, wanted))

    def best(
        self, piece: int, now: np.ndarray, directions: np.ndarray, scores: np.ndarray
    ) -> np.ndarray:
        """Finds the feasible direction with the greatest score.

        If there is none, the camera turns towards the direction at the end.

        Args:
            piece: number of the piece.
            now: direction before it, [2].
            directions: to choose from, [m, 2].
            scores: of each, [m].
        """
        is_feasible = self.feasible(piece, now, directions)
        if not is_feasible.any():
            return _towards(now, self.end, self.allowed[piece])
        return directions[np.argmax(np.where(is_feasible, scores, -np.inf))]


def turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Computes the length of the turn between directions [..., 2], [...] [rad]."""
    difference = _difference(first, second)
    return np.asarray(np.hypot(difference[..., 0], difference[..., 1]))


def _difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Computes the turn from one direction to another, [..., 2], round the shorter side."""
    difference = np.asarray(second, dtype=np.float64) - first
    return np.stack([wrapped(difference[..., 0]), difference[..., 1]], axis=-1)


def _towards(now: np.ndarray, goal: np.ndarray, most: float) -> np.ndarray:
    """Turns by at most `most` [rad] straight to a goal, and returns the new direction."""
    whole = float(turn(now, goal))
    return now + min(1.0, most / max(whole, 1e-12)) * _difference(now, goal)


def direction_of(T_world_camera: np.ndarray) -> np.ndarray:
    """Computes azimuth and elevation [2] of a pose [4, 4] without roll, by its level axis."""
    return np.concatenate(angles_of(T_world_camera[None]))


def pose_towards(position: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Makes the pose [4, 4] without roll at a position [3] that looks in a direction [2]."""
    pose = np.eye(4)
    pose[:3, :3] = rotations(*np.asarray(direction, dtype=np.float64)[:, None])[0]
    pose[:3, 3] = position
    return pose


def along(offset: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Computes the direction [2] of an offset [3].

    If the offset is vertical or zero, the azimuth stays.
    """
    level = float(np.hypot(offset[0], offset[1]))
    azimuth = now[0] if level < 1e-6 else np.arctan2(offset[1], offset[0])
    return np.array([azimuth, np.arctan2(offset[2], level)])


def axes_within(
    elevations: tuple[float, float], num_bins: int = 526
) -> tuple[np.ndarray, np.ndarray]:
    """Finds the axes of a panorama that a camera may have, moved into its range of tilt.

    These are the axes whose bins, caps of 1 / B of the sphere, overlap the allowed elevations; at
    least the nearest ones.

    Returns:
        Their numbers [m] and directions [m, 2].
    """
    x, y, z = fibonacci_lattice(num_bins).T
    elevation = np.arcsin(z)
    allowed = np.clip(elevation, *elevations)
    gap = np.abs(elevation - allowed)
    chosen = np.flatnonzero(gap <= max(np.arccos(1.0 - 2.0 / num_bins), gap.min()))
    return chosen, np.stack([np.arctan2(y, x), allowed], axis=1)[chosen]


def worthwhile_grid(
    grid: OccupancyGrid, places: np.ndarray, exhausted: np.ndarray | None
) -> OccupancyGrid:
    """Excludes, for frames captured while moving, cells that cannot be seen or were given up.

    Args:
        grid: the grid.
        places: positions of the robot, now and on its path, [n, 3] [m].
        exhausted: cells that enough views failed to show, [X, Y, Z] bool; None: not known.
    """
    shape = np.array(grid.log_odds.shape)
    cells = np.floor((places - np.asarray(grid.origin)) / float(grid.cell_size)).astype(int)
    reached = np.zeros(tuple(shape), dtype=bool)
    reached[tuple(np.clip(cells, 0, shape - 1).T)] = True
    return mask_unexplorable(grid, reached, exhausted)


def exhausted_cells(policy_state: Any) -> np.ndarray | None:
    """Finds cells that enough views failed to show, [X, Y, Z] bool.

    It is None if the policy does not count them.
    """
    if not isinstance(policy_state, PlannerState):
        return None
    return np.asarray(policy_state.looks) >= MAX_FAILED_LOOKS


def count_look(
    policy_state: Any,
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    scoring: ScoringConfig,
) -> Any:
    """Counts in the policy's memory the cells that a mapped frame failed to show.

    `look_round` does the same for the view before a decision.
    """
    if not isinstance(policy_state, PlannerState):
        return policy_state
    visible = visible_unexplored(map_state, grid, camera, T_world_camera, scoring)
    return replace(policy_state, looks=policy_state.looks + np.asarray(visible, dtype=np.int32))


def panorama_scores(
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    position: np.ndarray,
    scoring: ScoringConfig,
) -> np.ndarray:
    """Scores the views in the directions of all axes of a panorama, [B].

    They share one depth buffer.
    """
    place = np.asarray(position, dtype=np.float32)[None]
    return np.asarray(
        score_positions(map_state, grid, camera, place, scoring).direction_scores[0], np.float64
    )
