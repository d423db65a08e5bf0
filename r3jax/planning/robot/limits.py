"""The limits of a motion at a pose: which views the robot may take next, and their costs.

A view without roll is a position and two angles: the azimuth and the elevation of its viewing
direction. A view that is not allowed is projected to the nearest allowed one: its height and its
elevation are clipped, then the turn towards it is shortened. On the host: NumPy.

Shape symbols: C candidates; B directions.
"""

from dataclasses import dataclass, field

import numpy as np

from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.candidates import Candidates
from r3jax.planning.robot.motion import MOTIONS, UNLIMITED, Motion, check_height

_SAME = 1e-6
"""Angles that differ by less than this are equal [rad], the accuracy of float32 poses."""


@dataclass(frozen=True)
class Limits:
    """Limits of the robot's next view. The default allows everything."""

    motion: Motion = MOTIONS["free"]

    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Its current pose, [4, 4], without roll."""

    heights: tuple[float, float] = UNLIMITED
    """Lowest and highest camera position [m], world."""

    def project_to_feasible(self, candidates: Candidates) -> Candidates:
        """Projects views to the nearest allowed ones; allowed views stay unchanged."""
        positions = self.at_height(candidates.position)
        wanted = angles_along(candidates.direction)
        allowed = self._turned(positions, *wanted)
        # Converting to angles and back would round: only views that must change are converted.
        is_turned = _distance(wanted, allowed) > _SAME
        directions = np.where(is_turned[:, None], directions_along(*allowed), candidates.direction)
        return Candidates(positions, directions, candidates.valid)

    def at_height(self, positions: np.ndarray) -> np.ndarray:
        """Moves positions [..., 3] [m] to the nearest allowed height."""
        allowed = np.array(positions)
        # Straight up or down is the shortest path into a range of heights.
        allowed[..., 2] = np.clip(allowed[..., 2], *self.heights)
        return allowed

    def nearness(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Computes the cosine between each unit direction and the nearest one allowed.

        It is 1 for a direction that is allowed.

        Args:
            positions: [C, 1, 3] or [C, 3] [m].
            directions: [B, 3] for each position, or [C, 3].

        Returns:
            [C, B], or [C].
        """
        nearest = directions_along(*self._turned(positions, *angles_along(directions)))
        return np.clip(np.sum(nearest * directions, axis=-1), -1.0, 1.0)

    def allowed_axes(self, positions: np.ndarray, num_bins: int) -> np.ndarray:
        """Finds axes of a panorama of B bins that a view at positions [C, 3] may have, [C, B] bool.

        These are the axes whose bins, caps of 1 / B of the sphere, overlap the allowed directions.
        At least one is allowed at each position, so that a tilt between the lattice's directions
        has a nearest axis.
        """
        if self.motion.looks_anywhere:  # the rest takes 3 ms for six positions
            return np.ones((len(positions), num_bins), dtype=bool)
        nearness = self.nearness(positions[:, None, :], fibonacci_lattice(num_bins))
        # The cosine of half the opening of a cap that covers 1 / B of the sphere.
        cap = 1.0 - 2.0 / num_bins
        return nearness >= np.minimum(cap, nearness.max(axis=1, keepdims=True))

    def may_turn(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Checks whether the path is long enough for the turn, with the elevation clipped.

        Shapes are those of `nearness`, the result is bool.
        """
        # The elevation is clipped first: a clipped tilt does not shorten the turn.
        azimuth, elevation = self.clipped(*angles_along(directions))
        turned = self._turned(positions, azimuth, elevation)
        return _distance((azimuth, elevation), turned) <= _SAME

    def path_costs(self, lengths: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Adds the cost of the turn to the lengths [C] [m] of paths to views along directions.

        Args:
            lengths: of the paths.

            directions: viewing directions at their ends, [C, 3].

        Returns:
            Costs [m], [C]: a turn costs the length that the robot could move in the same time.
        """
        if self.motion.speed is None or self.motion.turn_rate is None:
            return lengths
        seconds = np.degrees(self.turns(directions)) / self.motion.turn_rate
        return lengths + self.motion.speed * seconds

    def seconds(self, length: float, direction: np.ndarray) -> float | None:
        """Computes the time for a path of `length` [m] and a turn to a direction [3] [s].

        It is None if no speed is set.
        """
        return self.motion.seconds(length, float(self.turns(direction[None])[0]))

    def turns(self, directions: np.ndarray) -> np.ndarray:
        """Computes the angles from the present view to those along directions [C, 3] [rad]."""
        (azimuth_now,), (elevation_now,) = angles_of(self.T_world_camera[None])
        azimuth, elevation = angles_along(directions)
        return _angle_of_turn(wrapped(azimuth - azimuth_now), elevation - elevation_now)

    def _turned(
        self, positions: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Finds the nearest angles that are allowed at positions [..., 3].

        A turn by both angles is no longer than the root of the sum of their squares: the axes of
        azimuth and elevation are at right angles to each other.
        """
        shape = np.broadcast_shapes(positions.shape[:-1], azimuth.shape)
        azimuth, elevation = self.clipped(
            np.broadcast_to(azimuth, shape), np.broadcast_to(elevation, shape)
        )
        if self.motion.turn_per_meter is None:
            return azimuth, elevation
        (azimuth_now,), (elevation_now,) = angles_of(self.T_world_camera[None])
        # The straight line, not the path: a detour does not allow a larger turn.
        straight = np.linalg.norm(positions - self.T_world_camera[:3, 3], axis=-1)
        allowed = np.radians(self.motion.turn_per_meter) * straight
        by = wrapped(azimuth - azimuth_now), elevation - elevation_now
        angle = _angle_of_turn(*by)
        # Without a turn there is no direction: avoid 0 / 0.
        whole = np.maximum(np.hypot(*by), _SAME)
        # Both angles in proportion: the view is on the line towards the requested one.
        share = np.where(angle <= allowed + _SAME, 1.0, np.minimum(allowed / whole, 1.0))
        return azimuth_now + share * by[0], elevation_now + share * by[1]

    def clipped(self, azimuth: np.ndarray, elevation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Clips the elevation of angles [rad] to the allowed range."""
        return azimuth, np.clip(elevation, *np.radians(self.motion.elevations))


UNBOUND = Limits()
"""Limits of a robot without constraints."""


def begin_at(motion: Motion, T_world_camera: np.ndarray) -> np.ndarray:
    """Clips the elevation of the pose where a mission begins, [4, 4].

    Raises:
        ValueError: the robot cannot be at that height.
    """
    height = float(T_world_camera[2, 3])
    low, high = motion.heights_from(height)
    check_height(height, (low, high))
    pose = np.array(T_world_camera, dtype=np.float64)
    wanted = angles_of(pose[None])
    # Only the elevation: without an earlier pose there is no turn.
    allowed = Limits(motion, pose).clipped(*wanted)
    if _distance(wanted, allowed)[0] > _SAME:
        pose[:3, :3] = rotations(*allowed)[0]
    return pose


def angles_of(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes azimuth and elevation [rad] of poses [C, 4, 4] without roll, [C] each.

    The azimuth is computed from the image's level axis, so that it is also defined for views
    straight up.
    """
    azimuth = np.arctan2(poses[:, 0, 0], -poses[:, 1, 0])
    forward = poses[:, :3, 2]
    return azimuth, np.arctan2(forward[:, 2], np.hypot(forward[:, 0], forward[:, 1]))


def angles_along(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes azimuth and elevation [rad] of the poses along directions [..., 3], [...] each."""
    x, y, z = np.moveaxis(directions, -1, 0)
    level = np.hypot(x, y)
    # As in `pose_along`: the image's level axis is then the world's x axis.
    azimuth = np.where(level < 1e-6, 0.5 * np.pi, np.arctan2(y, x))
    return azimuth, np.arctan2(z, level)


def directions_along(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Computes unit vectors along azimuths and elevations [...] [rad], [..., 3]."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def rotations(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Computes the rotations of cameras without roll along these angles, [C, 3, 3]."""
    forward = directions_along(azimuth, elevation)
    # From the azimuth: a cross product with the vertical vanishes straight up and down.
    right = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def _angle_of_turn(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Computes the angle of a rotation from its change of azimuth and elevation [rad].

    The real part of the product of the two rotations' quaternions: their axes are perpendicular, so
    that the other terms vanish.
    """
    cosine = np.cos(0.5 * azimuth) * np.cos(0.5 * elevation)
    return 2.0 * np.arccos(np.clip(cosine, -1.0, 1.0))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Wraps angles [rad] to turns by at most half a circle."""
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi))


def _distance(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Computes the distance between pairs of azimuth and elevation [rad]."""
    return np.hypot(wrapped(second[0] - first[0]), second[1] - first[1])
