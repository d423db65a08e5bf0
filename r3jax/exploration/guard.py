"""Guards the loop's access to the world: checks it, and renders only at the camera's pose.

Policies never get a simulator. If one obtains the loop's nevertheless, it is a guard, which renders
only the pose committed by the loop, and only once.
"""

import numpy as np

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import MAX_CELLS
from r3jax.planning.robot.limits import begin_at
from r3jax.planning.robot.motion import Motion
from r3jax.simulators.base import Simulator

_LEAST_EXTENT = 1.0
"""Smaller worlds have no position with half a meter of free space around it [m]."""

_LEAST_HEIGHT = 0.1
"""Thinner ones are surfaces [m]."""

_LEAST_HOUSE, _LARGEST_HOUSE = 2.0, 500.0
"""Usual extents of explored scenes [m]."""


def first_pose(simulator: Simulator, motion: Motion, config: MappingConfig) -> np.ndarray:
    """Finds the pose of the first view, `T_world_camera` [4, 4] float64.

    Args:
        simulator: the world.
        motion: of the robot, which must be able to take that view.
        config: cells of the coarse grid.

    Raises:
        ValueError: a start outside the world's box, or at a height that the robot cannot reach;
            a world that cannot be explored (see `check_world`).
    """
    # First: the errors of the search for a start and of the grid do not suggest a scale.
    check_world(simulator.bounds, None if config.tiles else config.cell_size)
    pose = np.asarray(simulator.start_pose, dtype=np.float64)
    lower, upper = np.asarray(simulator.bounds, dtype=np.float64)
    # The grid ends just beyond the box: outside there are no cells.
    if not np.all((pose[:3, 3] >= lower) & (pose[:3, 3] <= upper)):
        raise InputError(
            f"the start position {pose[:3, 3].round(3).tolist()} lies outside the scene's box "
            f"{lower.round(3).tolist()} .. {upper.round(3).tolist()}"
        )
    return begin_at(motion, pose)


def check_world(bounds: np.ndarray, cell_size: float | None, setting: str = "--cell-size") -> None:
    """Refuses a world that is too small, too flat or too large to be explored.

    Args:
        bounds: its box, [2, 3] [m].
        cell_size: edge of a cell of the coarse grid [m]; None: of tiles, any number.
        setting: name of the user's setting of it.

    Raises:
        ValueError: says what is wrong, and which scale would be right.
    """
    extent = np.ptp(np.asarray(bounds, np.float64), axis=0)
    size = f"the world is {' x '.join(f'{length:.6g}' for length in extent)} m large"
    units = {0.001: "millimeters", 0.01: "centimeters", 1000.0: "kilometers"}
    hints = [
        f"; if its mesh is in {unit}, give --scale {scale:g}"
        for scale, unit in units.items()
        if _LEAST_HOUSE <= scale * extent.max() <= _LARGEST_HOUSE
    ]
    hint = hints[0] if hints else ""
    # Written as conditions that NaN fails, too.
    if not extent.max() >= _LEAST_EXTENT:
        raise InputError(f"{size}: too small for a camera with {_LEAST_EXTENT / 2:g} m free{hint}")
    if not extent.min() >= _LEAST_HEIGHT:
        raise InputError(f"{size}: flat, with no space to explore")
    if cell_size is None:
        return
    # The grid has a cell more on every side, as walls lie on the faces of the box.
    cells = float(np.prod(extent / cell_size + 2.0))
    if not cells <= MAX_CELLS:
        raise InputError(
            f"{size}: {cells:.2g} cells of {cell_size:g} m, more than {MAX_CELLS:.0e}"
            f"{hint or f'; give a larger {setting}, cut the mesh, or explore with --tiles'}"
        )


class OracleReadError(RuntimeError):
    """An image was requested from another pose than the camera's."""


class GuardedSimulator:
    """A `Simulator` that renders the poses of one run, each once and in order."""

    def __init__(self, simulator: Simulator, views: int = 0):
        """Wraps `simulator`, which from now on is only accessible through the guard.

        Args:
            simulator: the world.
            views: number of images taken before, by an earlier process of the run.
        """
        # In a closure: an attribute would give a policy with the guard access to the world.
        render = simulator.render

        def render_committed(T_world_camera: np.ndarray) -> Frame:
            self._check(T_world_camera)
            # Reset before rendering: an image that fails is not rendered again, either.
            self._pose = None
            self.views += 1
            return render(T_world_camera)

        self._render = render_committed
        # Copies, here and below, so that callers cannot change the box or the start.
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
        """Marks the camera as arrived: the next image is taken from here.

        Args:
            view: its number. Images are counted, to detect others taken outside the loop.
            T_world_camera: its pose, [4, 4].

        Raises:
            OracleReadError: another number of images was taken so far.
        """
        if view != self.views:
            raise OracleReadError(
                f"view {view} comes next, but {self.views} pictures were taken: something beside "
                "the loop has used the simulator"
            )
        self._pose = np.array(T_world_camera, dtype=np.float64)

    def render(self, T_world_camera: np.ndarray) -> Frame:
        """Renders the frame at the pose that was committed, once.

        Raises:
            OracleReadError: another pose, or the same one again.
        """
        return self._render(T_world_camera)

    def _check(self, T_world_camera: np.ndarray) -> None:
        pose = np.asarray(T_world_camera, dtype=np.float64)
        if self._pose is None:
            raise OracleReadError(
                f"a picture from {_place(pose)} was requested while the camera is moving: only "
                "the loop renders, once at each chosen pose"
            )
        # Exact: the loop renders the array that it committed; a tolerance would allow other poses.
        if not np.array_equal(pose, self._pose):
            raise OracleReadError(
                f"a picture from {_place(pose)} was requested, but the camera is at "
                f"{_place(self._pose)}"
            )


def _place(pose: np.ndarray) -> str:
    x, y, z = pose[:3, 3]
    return f"({x:.2f}, {y:.2f}, {z:.2f}) m"
