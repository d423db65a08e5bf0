"""A motion at a moment: which views the carrier of the camera may take next, and at what cost.

A view without roll is a position and two angles: the azimuth of its line of sight and the
elevation above the horizon. A view that is not allowed becomes the nearest one that is: its height
and its elevation are clipped, then the turn towards it ends early. On the host: NumPy.

Shape symbols: C candidates; B directions.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from r3jax.geometry.cameras import angle_between
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.motion import MOTIONS, UNLIMITED, Motion

_SAME = 1e-6
"""Angles that differ by no more than this are one [rad]: float32 poses are no better."""


@dataclass(frozen=True)
class Limits:
    """What the carrier may do next. The default allows everything."""

    motion: Motion = MOTIONS["free"]

    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Where it is, [4, 4], without roll."""

    heights: tuple[float, float] = UNLIMITED
    """Lowest and highest place of the camera [m], world."""

    def project_to_feasible(self, poses: np.ndarray) -> np.ndarray:
        """The allowed poses nearest to poses [C, 4, 4]: those that are allowed are left as is."""
        positions = self.at_height(poses[:, :3, 3])
        wanted = _angles_of(poses)
        allowed = self._turned(positions, *wanted)
        is_turned = _distance(wanted, allowed) > _SAME
        obeyed = np.array(poses)
        obeyed[:, :3, 3] = positions
        obeyed[is_turned, :3, :3] = _rotations(*allowed)[is_turned]
        return obeyed

    def at_height(self, positions: np.ndarray) -> np.ndarray:
        """Positions [..., 3] [m] at the nearest allowed height."""
        allowed = np.array(positions)
        allowed[..., 2] = np.clip(allowed[..., 2], *self.heights)
        return allowed

    def nearness(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Cosine between each unit direction and the nearest one allowed; 1: it is allowed.

        Args:
            positions: [C, 1, 3] or [C, 3] [m].
            directions: [B, 3] for each position, or [C, 3].

        Returns:
            [C, B], or [C].
        """
        nearest = _directions(*self._turned(positions, *_angles_along(directions)))
        return np.clip(np.sum(nearest * directions, axis=-1), -1.0, 1.0)

    def allowed_axes(self, positions: np.ndarray, num_bins: int) -> np.ndarray:
        """Axes of a panorama of B bins that a view at positions [C, 3] may have, [C, B] bool.

        Those whose bins, caps of 1 / B of the sphere, reach into what is allowed. At least one is
        allowed everywhere, so that a tilt between the lattice's directions has its nearest one.
        """
        if self.motion.looks_anywhere:  # a search of paths asks often: 3 ms for six positions
            return np.ones((len(positions), num_bins), dtype=bool)
        nearness = self.nearness(positions[:, None, :], fibonacci_lattice(num_bins))
        cap = 1.0 - 2.0 / num_bins
        return nearness >= np.minimum(cap, nearness.max(axis=1, keepdims=True))

    def may_turn(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Where the way is long enough for the turn, elevation clipped; as `nearness` [bool]."""
        azimuth, elevation = self._clipped(*_angles_along(directions))
        turned = self._turned(positions, azimuth, elevation)
        return _distance((azimuth, elevation), turned) <= _SAME

    def path_costs(self, lengths: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Costs of the ways to poses [C, 4, 4], from their lengths [C] [m].

        Returns:
            Meters, [C]: a turn costs what could be gone meanwhile.
        """
        if self.motion.speed is None or self.motion.turn_rate is None:
            return lengths
        angles = [angle_between(self.T_world_camera, pose) for pose in poses]
        return lengths + self.motion.speed * np.array([self.motion.turning(a) for a in angles])

    def seconds(self, length: float, pose: np.ndarray) -> float | None:
        """Time for a way of `length` [m] to a pose [4, 4]; None: the motion has no speed."""
        return self.motion.seconds(length, angle_between(self.T_world_camera, pose))

    def _turned(
        self, positions: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The nearest angles that are allowed at positions [..., 3].

        A turn by both angles is no longer than the root of the sum of their squares: the axes of
        azimuth and elevation are at right angles to each other.
        """
        shape = np.broadcast_shapes(positions.shape[:-1], azimuth.shape)
        azimuth, elevation = self._clipped(
            np.broadcast_to(azimuth, shape), np.broadcast_to(elevation, shape)
        )
        if self.motion.turn_per_meter is None:
            return azimuth, elevation
        (azimuth_now,), (elevation_now,) = _angles_of(self.T_world_camera[None])
        straight = np.linalg.norm(positions - self.T_world_camera[:3, 3], axis=-1)
        allowed = np.radians(self.motion.turn_per_meter) * straight
        by = _wrapped(azimuth - azimuth_now), elevation - elevation_now
        angle = 2.0 * np.arccos(np.clip(np.cos(0.5 * by[0]) * np.cos(0.5 * by[1]), -1.0, 1.0))
        whole = np.maximum(np.hypot(*by), _SAME)
        share = np.where(angle <= allowed + _SAME, 1.0, np.minimum(allowed / whole, 1.0))
        return azimuth_now + share * by[0], elevation_now + share * by[1]

    def _clipped(self, azimuth: np.ndarray, elevation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return azimuth, np.clip(elevation, *np.radians(self.motion.elevations))


UNBOUND = Limits()
"""Of a carrier that may do anything."""


def begin_at(motion: Motion, T_world_camera: np.ndarray) -> np.ndarray:
    """The pose where a mission begins, [4, 4]: its elevation becomes one that is allowed.

    Raises:
        ValueError: the carrier cannot be at that height.
    """
    height = float(T_world_camera[2, 3])
    low, high = motion.heights_from(height)
    check_height(height, (low, high))
    standing = replace(motion, turn_per_meter=None)  # nobody came from anywhere
    pose = np.asarray(T_world_camera, dtype=np.float64)
    return Limits(standing, pose).project_to_feasible(pose[None])[0]


def check_height(height: float, heights: tuple[float, float]) -> None:
    """Refuses a camera at a height [m] that its carrier cannot be at.

    Raises:
        ValueError: says what to do.
    """
    low, high = heights
    if not low - 1e-3 <= height <= high + 1e-3:
        raise ValueError(
            f"the camera is at a height of {height:.3f} m, but its motion's heights are {low:.3f} "
            f"to {high:.3f} m above the world's z = 0: start within them, or change `heights`"
        )


def _angles_of(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation [rad] of poses [C, 4, 4] without roll, [C] each.

    The azimuth is read off the level axis of the image: it means something straight up, too.
    """
    azimuth = np.arctan2(poses[:, 0, 0], -poses[:, 1, 0])
    forward = poses[:, :3, 2]
    return azimuth, np.arctan2(forward[:, 2], np.hypot(forward[:, 0], forward[:, 1]))


def _angles_along(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation [rad] of the poses along directions [..., 3], [...] each."""
    x, y, z = np.moveaxis(directions, -1, 0)
    level = np.hypot(x, y)
    # As `pose_along` has it: the image's level axis is the world's x axis then.
    azimuth = np.where(level < 1e-6, 0.5 * np.pi, np.arctan2(y, x))
    return azimuth, np.arctan2(z, level)


def _directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Unit vectors along azimuths and elevations [...] [rad], [..., 3]."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def _rotations(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Axes of the cameras that look there without roll, [C, 3, 3]."""
    forward = _directions(azimuth, elevation)
    right = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles [rad] as turns by at most half a circle."""
    return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)


def _distance(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Between pairs of azimuth and elevation [rad]."""
    return np.hypot(_wrapped(second[0] - first[0]), second[1] - first[1])
