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
from r3jax.mapping.occupancy import (
    FREE_LOG_ODDS,
    OCCUPIED_LOG_ODDS,
    OccupancyGrid,
    frontier_unexplored,
)
from r3jax.mapping.state import MapState
from r3jax.mapping.tiles import Layer, Tile, unpacked_layer
from r3jax.planning.far import Far
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


def probe_poses(grid: OccupancyGrid, num: int, box: np.ndarray | None = None) -> np.ndarray:
    """Returns the probe views: the first `num` of a fixed sequence that lie in free space.

    The sequence covers the whole box and does not depend on the run. A probe counts once its cell
    and all neighboring cells are known to be free, so that the set grows with every new room and is
    final when the free space is known.

    Args:
        grid: the grid.

        num: maximum number of probes.
        box: of the world, [2, 3] [m], if the grid is the part of it that is at hand: probes lie
            where the grid lets a robot stop, so that what they show is at hand, too.

    Returns:
        `T_world_camera`, [P, 4, 4] float32, P <= num.
    """
    # On the host: the number of free probes changes with every view, which would recompile.
    origin, size = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    shape = np.asarray(grid.log_odds.shape)
    ends = np.array([origin, origin + shape * size])
    if box is not None and np.isfinite(box).all():
        ends = box
    positions, directions = _probe_sequence(tuple(ends[0]), tuple(ends[1]))
    roomy = ndimage.binary_erosion(np.asarray(grid.free), np.ones((3, 3, 3)))
    if grid.refused is not None:
        roomy &= ~grid.refused
    cells = np.floor((positions - origin) / size)
    # Rounding may put a point on the upper face, one cell past the array.
    is_in = np.all((cells >= 0) & (cells <= shape), axis=1)
    x, y, z = np.clip(cells, 0, shape - 1).astype(int).T
    chosen = np.flatnonzero(is_in & roomy[x, y, z])[:num]
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


def mean_renderability(
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    num: int,
    box: np.ndarray | None = None,
) -> float:
    """Computes the mean renderability of the probe views; 0 if there are none yet."""
    poses = probe_poses(grid, num, box)
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
    far: Far | None = None,
) -> Coverage:
    """Measures the fields of a row that describe the state after its view.

    With tiles (`far`), counts are of the whole place, the renderability of what is at hand.
    """
    unexplored = np.asarray(grid.unexplored)
    inside = unexplored.size if grid.explorable is None else int(np.sum(grid.explorable))
    known = int(inside - unexplored.sum())
    frontier = int(np.asarray(frontier_unexplored(grid)).sum())
    voxels, map_bytes, cells = 0, 0, float(unexplored.size)
    if far is not None:
        voxels, map_bytes = far.tiles.num_voxels, far.tiles.nbytes
        cells = float(np.prod(far.box_cells[1] - far.box_cells[0]))
        for tile in far.tiles.cells:
            more = _counts_of(far, tile)
            known, frontier = known + more[0], frontier + more[1]
    return Coverage(
        voxels=voxels + int(map_state.num_present),
        map_bytes=map_bytes + map_state.bytes_per_row * map_state.capacity,
        dropped=int(map_state.dropped),
        known_cells=known,
        known_share=known / cells,
        frontier_cells=frontier,
        mean_renderability=mean_renderability(
            map_state, grid, camera, num_probes, None if far is None else far.box
        ),
        arrival_renderability=arrival_renderability,
    )


def _counts_of(far: Far, tile: Tile) -> tuple[int, int]:
    """Counts a tile's known cells in the box, and those unexplored beside a free one of it."""
    lattice, layer = far.tiles.lattice, far.tiles.cells[tile].get("log_odds")
    if layer is None:
        return 0, 0
    box = np.clip(far.box_cells - np.array(tile) * np.array(lattice.cells), 0, lattice.cells)
    return _counts(layer, lattice.cells, *(tuple(int(i) for i in corner) for corner in box))


@functools.lru_cache(maxsize=1 << 13)
def _counts(
    layer: Layer, shape: Tile, first: tuple[int, ...], last: tuple[int, ...]
) -> tuple[int, int]:
    # Remembered: after every view of a run all tiles are counted, and far ones stay as they are.
    values = unpacked_layer(layer, shape)[tuple(map(slice, first, last))]
    free = values < FREE_LOG_ODDS
    unknown = ~free & (values <= OCCUPIED_LOG_ODDS)
    beside = np.asarray(ndimage.binary_dilation(free), bool) & unknown
    return int(values.size - unknown.sum()), int(beside.sum())
