"""Measures the progress of map and grid; not on the mission clock.

Shape symbols: P probe views; X Y Z cells.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage

from r3jax.exploration.taken_views import Coverage
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, frontier_unexplored
from r3jax.mapping.state import MapState
from r3jax.scoring.renderability import renderability

_NUM_DRAWN = 1 << 14
"""Number of probe poses drawn in the scene's box; most of them are in walls or outside."""

_MAX_ELEVATION = np.deg2rad(45.0)
"""Maximum elevation of probe views."""


@jax.jit
def _renderability_of_views(
    map_state: MapState, camera: Camera, poses: Float[Array, "P 4 4"]
) -> Float[Array, " P"]:
    return jax.vmap(lambda T: renderability(map_state, camera, T))(poses)


def view_renderability(
    map_state: MapState, camera: Camera, T_world_camera: Float[Array, "4 4"]
) -> float:
    """Computes the renderability of one view of the map, as a number on the host."""
    return float(_renderability_of_views(map_state, camera, T_world_camera[None])[0])


@functools.lru_cache(maxsize=4)
def _probe_sequence(lower: tuple[float, ...], upper: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """Draws positions [n, 3] and directions [n, 3], evenly spread, the same for every run."""
    from scipy.stats import qmc  # lazy: takes half a second, which pages do not need

    # Not scrambled: equal runs must write equal rows, and runs of one scene share their probes.
    unit = qmc.Sobol(d=5, scramble=False).random(_NUM_DRAWN)
    positions = np.asarray(lower) + unit[:, :3] * (np.asarray(upper) - np.asarray(lower))
    azimuth = 2.0 * np.pi * unit[:, 3]
    # Uniform in the sine of the elevation, which is uniform on the sphere.
    z = (2.0 * unit[:, 4] - 1.0) * np.sin(_MAX_ELEVATION)
    level = np.sqrt(1.0 - z * z)
    return positions, np.stack([level * np.cos(azimuth), level * np.sin(azimuth), z], axis=1)


def probe_poses(grid: OccupancyGrid, num: int) -> np.ndarray:
    """Returns the probe views: the first `num` of a fixed sequence that lie in free space.

    The sequence covers the whole box and does not depend on the run. A probe counts once its cell
    and all neighboring cells are known to be free, so that the set grows with every new room and is
    final when the free space is known.

    Args:
        grid: the grid.

        num: maximum number of probes.

    Returns:
        `T_world_camera`, [P, 4, 4] float32, P <= num.
    """
    # On the host: the number of free probes changes with every view, which would recompile.
    origin, size = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    shape = np.asarray(grid.log_odds.shape)
    positions, directions = _probe_sequence(tuple(origin), tuple(origin + shape * size))
    roomy = ndimage.binary_erosion(np.asarray(grid.free), np.ones((3, 3, 3)))
    # Rounding may put a point on the upper face, one cell past the array.
    cells = np.minimum((positions - origin) / size, shape - 1).astype(int)
    chosen = np.flatnonzero(roomy[tuple(cells.T)])[:num]
    return _poses_along(positions[chosen], directions[chosen])


def _poses_along(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Computes `geometry.cameras.pose_along` for many on the host, without compiling."""
    # Camera axes: x right and level, y down, z forward.
    right = np.stack([directions[:, 1], -directions[:, 0], np.zeros(len(directions))], axis=1)
    right /= np.linalg.norm(right, axis=1, keepdims=True)  # never 0: no probe looks straight up
    poses = np.tile(np.eye(4, dtype=np.float32), (len(positions), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(directions, right), directions], axis=2)
    poses[:, :3, 3] = positions
    return poses


def mean_renderability(map_state: MapState, grid: OccupancyGrid, camera: Camera, num: int) -> float:
    """Computes the mean renderability of the probe views; 0 if there are none yet."""
    poses = probe_poses(grid, num)
    if len(poses) == 0:
        return 0.0
    # Padded to one length, so that one compilation serves the whole run.
    padded = np.concatenate([poses, np.repeat(poses[:1], num - len(poses), axis=0)])
    values = _renderability_of_views(map_state, camera, jnp.asarray(padded))
    # Without the padding, which repeats the first probe.
    return float(np.asarray(values)[: len(poses)].mean())


def measure_coverage(
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    *,
    arrival_renderability: float,
    num_probes: int,
) -> Coverage:
    """Measures the fields of a row that describe the state after its view."""
    unexplored = np.asarray(grid.unexplored)
    known = int(unexplored.size - unexplored.sum())
    return Coverage(
        voxels=int(map_state.num_present),
        map_bytes=map_state.bytes_per_row * map_state.capacity,
        dropped=int(map_state.dropped),
        known_cells=known,
        known_share=known / unexplored.size,
        frontier_cells=int(np.asarray(frontier_unexplored(grid)).sum()),
        mean_renderability=mean_renderability(map_state, grid, camera, num_probes),
        arrival_renderability=arrival_renderability,
    )
