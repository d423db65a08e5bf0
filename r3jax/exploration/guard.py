"""The loop's own way to a simulator: no image but from where the camera has just arrived.

A policy never gets a simulator. Should one find its way to the loop's all the same, it finds this
one, whose `render` answers for the pose to which the loop has committed itself, once.
"""

import numpy as np

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.simulators.base import Simulator


class OracleReadError(RuntimeError):
    """An image was asked for from where the camera is not."""


class GuardedSimulator:
    """A `Simulator` that renders the poses of one run, each once and in order."""

    def __init__(self, simulator: Simulator, views: int = 0):
        """Wraps `simulator`, which is reachable through the guard only from here on.

        Args:
            simulator: the world.
            views: images of the run that were taken before, by a process that was killed.
        """
        # In a closure: an attribute would hand the whole world to a policy that finds the guard.
        render = simulator.render

        def render_committed(T_world_camera: np.ndarray) -> Frame:
            self._check(T_world_camera)
            # Spent before the world is asked: an image that fails is not asked for again, either.
            self._pose = None
            self.views += 1
            return render(T_world_camera)

        self._render = render_committed
        # Copies, here and below: nobody who holds such an array can move the box or the start.
        self._camera, self._bounds = simulator.camera, np.array(simulator.bounds)
        self._start_pose = np.array(simulator.start_pose)
        self._pose: np.ndarray | None = None
        self.views = views

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""
        return self._camera

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box of the world, [2, 3] [m]."""
        return self._bounds.copy()

    @property
    def start_pose(self) -> np.ndarray:
        """`T_world_camera` at the start, [4, 4]."""
        return self._start_pose.copy()

    def commit(self, view: int, T_world_camera: np.ndarray) -> None:
        """The camera has arrived: the next image is taken from here.

        Args:
            view: its number. Images are counted, so that none is taken behind the loop's back.
            T_world_camera: its pose, [4, 4].

        Raises:
            OracleReadError: another number of images was taken so far.
        """
        if view != self.views:
            raise OracleReadError(
                f"view {view} comes next, but {self.views} pictures were taken: something beside "
                "the loop asked the simulator"
            )
        self._pose = np.array(T_world_camera, dtype=np.float64)

    def render(self, T_world_camera: np.ndarray) -> Frame:
        """The frame at the pose that was committed, once.

        Raises:
            OracleReadError: another pose, or the same one again.
        """
        return self._render(T_world_camera)

    def _check(self, T_world_camera: np.ndarray) -> None:
        pose = np.asarray(T_world_camera, dtype=np.float64)
        if self._pose is None:
            raise OracleReadError(
                f"a picture from {_place(pose)} was asked for while the camera is under way: only "
                "the loop looks, once from each pose that was decided on"
            )
        # Exact: the loop renders the array it committed; a tolerance would let peeks through.
        if not np.array_equal(pose, self._pose):
            raise OracleReadError(
                f"a picture from {_place(pose)} was asked for, but the camera is at "
                f"{_place(self._pose)}"
            )


def _place(pose: np.ndarray) -> str:
    x, y, z = pose[:3, 3]
    return f"({x:.2f}, {y:.2f}, {z:.2f}) m"
