"""The loop's interface to a world: a camera, a box, a start, and images at the camera's poses.

`NoisySimulator` adds depth noise to another simulator.
"""

import hashlib
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera


@runtime_checkable
class Simulator(Protocol):
    """A world with a camera; gives no access to meshes or ground truth."""

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame that `render` returns."""
        ...

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box of the world, [2, 3] float64: lower and upper corner [m], z up."""
        ...

    @property
    def start_pose(self) -> np.ndarray:
        """Initial `T_world_camera`, [4, 4] float64, with a free ball of 0.5 m around it."""
        ...

    def render(self, T_world_camera: np.ndarray) -> Frame:
        """Renders the RGB-D frame at a pose. The same pose gives the same frame, noise included."""
        ...


class NoisySimulator:
    """Adds depth noise N(0, (sigma d)^2) to another simulator's frames.

    This is the sensor model of Active-GS (Jin et al., RA-L 2025), with sigma = 0.01. The noise is a
    pure function of the seed and the pose, so that rendering a pose again gives the same frame.
    """

    def __init__(
        self, simulator: Simulator, relative_sigma: float | int = 0.01, seed: int = 0
    ) -> None:
        """Wraps `simulator`.

        Args:
            simulator: renders the frames without noise.
            relative_sigma: standard deviation of the depth noise, relative to the depth.
            seed: random seed of the noise, 0 or more.

        Raises:
            ValueError: a share outside [0, 0.2], or a negative seed.
        """
        if not 0.0 <= relative_sigma <= 0.2:
            raise InputError(
                f"relative_sigma is a share of the depth and must lie in [0, 0.2], "
                f"got {relative_sigma}"
            )
        if seed < 0:
            raise InputError(f"seed must be 0 or more, got {seed}")
        self.simulator = simulator
        self._sigma = relative_sigma
        self._seed = seed

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""
        return self.simulator.camera

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box of the world, [2, 3] [m]."""
        return self.simulator.bounds

    @property
    def start_pose(self) -> np.ndarray:
        """`T_world_camera` at the start, [4, 4]."""
        return self.simulator.start_pose

    def render(self, T_world_camera: np.ndarray | jax.Array) -> Frame:
        """Renders the frame at a pose, with noise on its depth; 0 and inf keep their meaning."""
        frame = self.simulator.render(np.asarray(T_world_camera))
        depth = np.asarray(frame.depth)
        noise = self._generator(frame).standard_normal(depth.shape, dtype=np.float32)
        # Cut at 4.5 sigma: a rare outlier must not make a depth negative.
        factor = 1.0 + np.float32(self._sigma) * np.clip(noise, -4.5, 4.5)
        is_measured = (depth > 0.0) & np.isfinite(depth)
        noisy = np.where(is_measured, depth * factor, depth)
        return Frame(
            rgb=frame.rgb,
            depth=jnp.asarray(noisy),
            T_world_camera=frame.T_world_camera,
            camera=frame.camera,
            far=True,
        )

    def _generator(self, frame: Frame) -> np.random.Generator:
        """Makes a generator that depends on the seed and the frame's pose only."""
        pose = np.asarray(frame.T_world_camera, dtype=np.float32) + np.float32(0.0)  # no -0
        digest = hashlib.sha256(pose.tobytes()).digest()
        return np.random.default_rng([self._seed, *np.frombuffer(digest, dtype=np.uint32)])
