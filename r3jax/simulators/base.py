"""What the loop may know of a world: a camera, a box, a start, and images from where it is."""

from typing import Protocol, runtime_checkable

import numpy as np

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera


@runtime_checkable
class Simulator(Protocol):
    """A world with a camera in it. No mesh, no ground truth, no second pose."""

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
        """Where the camera starts: `T_world_camera`, [4, 4] float64.

        The ball of 0.5 m round it is promised to be free.
        """
        ...

    def render(self, T_world_camera: np.ndarray) -> Frame:
        """The RGB-D frame at a pose. The same pose gives the same frame, noise included."""
        ...
