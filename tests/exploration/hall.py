"""A hall with pillars, as large as asked, seen by an exact ray caster in NumPy."""

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along
from tests.exploration.toys import rays_of, wavy_frame

PITCH = 6.0
"""Distance between pillars, along x and y [m]."""

HALF_WIDTH = 0.3
"""Of a pillar [m]."""


@dataclass
class Hall:
    """A box on the ground with square pillars in rows; the walls carry waves of color."""

    size: tuple[float, float, float] = (60.0, 60.0, 6.0)
    camera: Camera = field(default_factory=lambda: Camera.from_fov(96, 96, 90.0))

    @property
    def bounds(self) -> np.ndarray:
        return np.stack([np.zeros(3), np.asarray(self.size)])

    @property
    def start_pose(self) -> np.ndarray:
        start = jnp.asarray([1.5, 1.5, 1.5], jnp.float32)
        return np.asarray(pose_along(start, jnp.asarray([1.0, 1.0, 0.0])), np.float64)

    def render(self, T_world_camera: np.ndarray) -> Frame:
        rays, position = rays_of(self.camera, T_world_camera), T_world_camera[:3, 3]
        upper = np.asarray(self.size)
        depth = np.where(rays > 0, (upper - position) / rays, -position / rays).min(-1)
        for center in self._pillars_near(position[:2]):
            low = (center - HALF_WIDTH - position[:2]) / rays[..., :2]
            high = (center + HALF_WIDTH - position[:2]) / rays[..., :2]
            enter = np.minimum(low, high).max(-1)
            leave = np.maximum(low, high).min(-1)
            depth = np.where((enter < leave) & (enter > 0.0), np.minimum(depth, enter), depth)
        return wavy_frame(self.camera, T_world_camera, rays, depth)

    def _pillars_near(self, place: np.ndarray, reach: float = 9.0) -> np.ndarray:
        """Centers [n, 2] of the pillars that a sensor of 5 m may see."""
        axes = [np.arange(0.5 * PITCH, length, PITCH) for length in self.size[:2]]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        return centers[np.linalg.norm(centers - place, axis=1) < reach]
