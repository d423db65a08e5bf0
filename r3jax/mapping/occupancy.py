"""The coarse grid: free, occupied and unexplored space, for safe travel and for exploration.

The model, per cell and frame (log-odds as in Active-GS, Jin et al. 2025):

    step  = 2.8 clip(1 - 0.1 d, 0, 1), d the distance from the camera to the cell [m]
    hit   + step: a measured point lies in the cell
    pass  - step: at least half of the cell was seen through, and no point of the frame lies in it
    else    0, and the sum is clipped to +-4.5

One observation decides (a cell at 5 m gets 1.4 > ln 4). **Seen through* is tested at the centers of
the cell's eight octants. Such a center was seen through if it lies in the image, within range, and
at least a quarter of a cell before the nearest measurement in its block of pixels (about one degree
wide). Testing cells instead of tracing rays leaves no gaps far away, does not clear cells that a
ray only grazes, and costs one gather per point.

Consequences: the nearest measurement decides for its block, so that rays beside a thin object do
not carve it away; a free cell may still contain a surface in the half that was not in the image;
and a wall measured with 1 % noise at 4 m is one cell too thick.

Shape symbols: X Y Z cells along the axes; H W image size; h w blocks; n points.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.errors import InputError
from r3jax.frame import Frame, a_frame
from r3jax.geometry.arguments import checked, one
from r3jax.geometry.cameras import Camera, invert_pose, nan_unless_valid, pixel_rays
from r3jax.geometry.voxels import check_near_origin
from r3jax.kernels import calls
from r3jax.kernels.calls import Cells
from r3jax.kernels.constants import (
    BLOCKS_ACROSS,
    LOG_ODDS_LIMIT,
    PASSED_OCTANTS,
    STEP,
    STEP_DECAY,
)
from r3jax.kernels.native.platform import by_platform
from r3jax.mapping.update import for_kernels

FREE_LOG_ODDS = -1.3862944
"""A cell is free below this: p = 0.2."""

OCCUPIED_LOG_ODDS = 1.3862944
"""A cell is occupied above this: p = 0.8."""

VOUCHED_LOG_ODDS = -1.5
"""Log-odds set by `mark_free_ball`: free, but a single hit within range makes the cell occupied."""

KEEP_OUT, COSTMAP, REFUSED, TRUSTED = 1, 2, 4, 8
"""Marks of cells: a keep-out zone, an obstacle of a costmap, a goal that was not reached, and free
space of a costmap that the robot may enter unseen."""

_OCTANTS = tuple((x, y, z) for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (-0.25, 0.25))
"""Centers of a cell's octants, from its center, in cells."""

MAX_CELLS = 50_000_000
"""Maximum number of cells; more indicate wrong bounds (a scene in millimeters)."""


class OccupancyGrid(eqx.Module):
    """Log-odds of occupancy over an axis-aligned box."""

    log_odds: Float[Array, "X Y Z"]
    """Log-odds of occupancy, clipped to +-4.5; 0: never observed."""

    origin: Float[Array, " 3"]
    """Lower corner of cell (0, 0, 0) in the world [m]."""

    cell_size: Float[Array, ""]
    """Cell size [m]."""

    explorable: Bool[Array, "X Y Z"] | None = None
    """Mask of the cells that may count as unexplored; None: all."""

    marks: UInt8[Array, "X Y Z"] | None = None
    """Marks of the cells, independent of their log-odds: sums of `KEEP_OUT`, `COSTMAP`,
    `REFUSED` and `TRUSTED`; None: no marks."""

    @property
    def closed(self) -> Bool[np.ndarray, "X Y Z"] | None:
        """Cells that the robot must not enter (keep-out zones, a costmap's obstacles), or None."""
        return None if self.marks is None else (np.asarray(self.marks) & (KEEP_OUT | COSTMAP)) > 0

    @property
    def refused(self) -> Bool[np.ndarray, "X Y Z"] | None:
        """Cells around goals that were not reached, in which the robot must not stop, or None."""
        return None if self.marks is None else (np.asarray(self.marks) & REFUSED) > 0

    @property
    def trusted(self) -> Bool[np.ndarray, "X Y Z"] | None:
        """Cells that a costmap holds for free, which a robot may enter unseen, or None."""
        return None if self.marks is None else (np.asarray(self.marks) & TRUSTED) > 0

    def marked(self, cells: Bool[Array | np.ndarray, "X Y Z"], mark: int) -> "OccupancyGrid":
        """Sets one mark in the given cells, and removes it from all others."""
        before = np.zeros(self.log_odds.shape, np.uint8) if self.marks is None else self.marks
        others = np.asarray(before) & np.uint8(255 - mark)
        return replace(self, marks=jnp.asarray(others | np.where(cells, mark, 0).astype(np.uint8)))

    @property
    def free(self) -> Bool[Array, "X Y Z"]:
        """Cells known to be free."""
        return self.log_odds < FREE_LOG_ODDS

    @property
    def occupied(self) -> Bool[Array, "X Y Z"]:
        """Cells known to be occupied."""
        return self.log_odds > OCCUPIED_LOG_ODDS

    @property
    @jax.jit  # jitted: planning calls it outside jit, where every operation would be a program
    def unexplored(self) -> Bool[Array, "X Y Z"]:
        """Cells that are neither free nor occupied, and may be explored."""
        # The mask only removes unknown cells; it never makes a known cell unexplored.
        unknown = ~(self.free | self.occupied)
        return unknown if self.explorable is None else unknown & self.explorable

    def ignoring(self, cells: Bool[Array | np.ndarray, "X Y Z"]) -> "OccupancyGrid":
        """Excludes cells from the unexplored ones for one decision.

        Their log-odds stay: if they were marked as occupied, the robot's body would collide with
        space that was never seen.
        """
        left = jnp.asarray(~cells, dtype=bool)
        if self.explorable is not None:
            left = left & self.explorable
        return replace(self, explorable=left)


def cells_of(grid: OccupancyGrid) -> Cells:
    """Lists all cells of a grid, z fastest."""
    shape = grid.log_odds.shape
    x, y, z = (
        grid.origin[i] + (jnp.arange(n, dtype=jnp.float32) + 0.5) * grid.cell_size
        for i, n in enumerate(shape)
    )
    fill: Callable[[Array], Array] = lambda axis: jnp.broadcast_to(axis, shape).reshape(-1)
    return Cells(
        fill(x[:, None, None]),
        fill(y[None, :, None]),
        fill(z[None, None, :]),
        grid.unexplored.reshape(-1),
    )


a_grid = one(OccupancyGrid, "r3jax.empty_grid makes one", leaf="log_odds", ndim=3)


def empty_grid(bounds: np.ndarray | Array, cell_size: float = 0.2) -> OccupancyGrid:
    """Makes a grid in which nothing has been explored.

    Args:
        bounds: lower and upper corner of the box to cover, [2, 3] [m].
        cell_size: edge of a cell [m].

    Returns:
        A grid that covers the box and one cell more on every side, so that walls on the box's
        faces lie inside.

    Raises:
        ValueError: bounds that are not finite, not ordered or far from the origin, a cell size that
            is not positive, or too many cells.
    """
    box = np.asarray(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.all(np.isfinite(box)) or not np.all(box[1] > box[0]):
        raise InputError(
            "bounds are a lower and an upper corner, [2, 3] in meters, finite, each upper value "
            f"above the lower one; got {box.tolist()}"
        )
    check_near_origin("bounds", box)
    if not (math.isfinite(cell_size) and cell_size > 0.0):
        raise InputError(f"cell_size must be positive [m], got {cell_size}")
    # The small tolerance keeps a side of exactly 12 cells from becoming 13 by rounding.
    cells = np.ceil((box[1] - box[0]) / cell_size - 1e-6) + 2.0
    # Counted in floats: the product of absurd bounds would overflow integers.
    if float(np.prod(cells)) > MAX_CELLS:
        raise InputError(
            f"bounds {box.tolist()} at {cell_size} m make {np.prod(cells):.3g} cells, more than "
            f"{MAX_CELLS:.0e}: are the bounds in meters? A larger place is held in tiles: start "
            "without bounds, or with MappingConfig(tiles=True)"
        )
    return OccupancyGrid(
        log_odds=jnp.zeros(tuple(int(c) for c in cells), dtype=jnp.float32),
        origin=jnp.asarray(box[0] - cell_size, dtype=jnp.float32),
        cell_size=jnp.asarray(cell_size, dtype=jnp.float32),
    )


def world_to_cell(grid: OccupancyGrid, points_world: Float[Array, "*n 3"]) -> Int[Array, "*n 3"]:
    """Finds the cell that contains each point; outside the grid the index is out of its shape."""
    # Reshaped, not broadcast: the tests let JAX raise on implicit rank promotion.
    origin = grid.origin.reshape((1,) * (points_world.ndim - 1) + (3,))
    index = jnp.floor((points_world - origin) / grid.cell_size)
    # Far outside, an int32 would wrap round and could land inside.
    return jnp.clip(index, -1e6, 1e6).astype(jnp.int32)


def cell_centers(grid: OccupancyGrid, cells: Int[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Computes the center of each cell in the world [m]."""
    origin = grid.origin.reshape((1,) * (cells.ndim - 1) + (3,))
    return origin + (cells.astype(jnp.float32) + 0.5) * grid.cell_size


def centers_on_host(grid: OccupancyGrid, cells: np.ndarray) -> np.ndarray:
    """Computes `cell_centers` of cells [n, 3] by NumPy in float64, without compiling."""
    return np.asarray(grid.origin, np.float64) + (cells + 0.5) * float(grid.cell_size)


def log_odds_at(
    grid: OccupancyGrid, points_world: Float[Array, "*n 3"], outside: float = 0.0
) -> Float[Array, "*n"]:
    """Reads the log-odds of the cell that contains each point; `outside` beyond the grid."""
    index = world_to_cell(grid, points_world)
    inside = _inside(grid, index)
    # Replaced by cell 0: a negative index would read from the far side of the grid.
    x, y, z = (jnp.where(inside, index[..., i], 0) for i in range(3))
    return jnp.where(inside, grid.log_odds[x, y, z], outside)


@jax.jit
def frontier(grid: OccupancyGrid) -> Bool[Array, "X Y Z"]:
    """Finds the free cells with an unexplored face neighbor, where known space ends."""
    return grid.free & _has_face_neighbor(grid.unexplored)


@jax.jit
def frontier_unexplored(grid: OccupancyGrid) -> Bool[Array, "X Y Z"]:
    """Finds unexplored cells with a free face neighbor: the first layer of the unknown."""
    return grid.unexplored & _has_face_neighbor(grid.free)


def mark_free_ball(
    grid: OccupancyGrid, center: Float[Array, " 3"], radius: float | Float[Array, ""]
) -> OccupancyGrid:
    """Marks the cells whose center lies in a ball as free, without a measurement.

    For space that no image shows: the ball around the start, which the simulator guarantees to be
    free, and the robot's own body. Cells measured as occupied stay occupied, and a single later hit
    overrides the mark.

    Args:
        grid: the grid.
        center: center of the ball in the world [m].
        radius: its radius [m].
    """
    is_in_ball = _distance(grid, center) <= jnp.asarray(radius, dtype=jnp.float32)
    # The minimum: cells that measurements have made freer stay so.
    vouched = jnp.where(
        is_in_ball & ~grid.occupied, jnp.minimum(grid.log_odds, VOUCHED_LOG_ODDS), grid.log_odds
    )
    return eqx.tree_at(lambda g: g.log_odds, grid, vouched)


@checked(grid=a_grid, frame=a_frame)
def integrate_depth(
    grid: OccupancyGrid, frame: Frame, max_range: float | Float[Array, ""] = 5.0
) -> OccupancyGrid:
    """Updates the grid with one depth image; the model is at the head of this module.

    Args:
        grid: the grid before the frame.
        frame: the frame. A depth of 0 is no measurement; if it is `inf` or beyond `max_range`, the
            ray is free up to `max_range`.
        max_range: range of the sensor, straight from the camera's center [m].

    Returns:
        The grid after the frame. Measurements outside the grid are ignored. If the frame's pose is
        not rigid (possible only under jit), the cell size becomes NaN, and so does every later
        score.

    Raises:
        TypeError: not a grid, or not a frame.
        ValueError: several at once, without `jax.vmap`.
    """
    log_odds = _updated(grid, frame, jnp.asarray(max_range, dtype=jnp.float32))
    # Nothing can be raised under jit: NaN spreads to every later score.
    cell_size = grid.cell_size * nan_unless_valid(frame.camera, frame.T_world_camera)
    return eqx.tree_at(lambda g: (g.log_odds, g.cell_size), grid, (log_odds, cell_size))


@jax.custom_jvp
def _updated(grid: OccupancyGrid, frame: Frame, reach: Float[Array, ""]) -> Float[Array, "X Y Z"]:
    """Computes the log-odds after a frame, by a kernel on CPUs and by the formulas elsewhere."""
    return by_platform(cpu=_by_kernel, default=_by_formulas)(grid, frame, reach)


@_updated.defjvp
def _updated_jvp(primals: Any, tangents: Any) -> Any:
    return jax.jvp(_by_formulas, primals, tangents)


def _by_kernel(grid: OccupancyGrid, frame: Frame, reach: Float[Array, ""]) -> Float[Array, "X Y Z"]:
    # An invalid pose makes the range NaN: nothing is in range.
    reach = reach * nan_unless_valid(frame.camera, frame.T_world_camera)
    image = for_kernels(frame, reach, jnp.asarray(False))
    return calls.grid_depth(grid.log_odds, grid.origin, grid.cell_size, image)


def _by_formulas(
    grid: OccupancyGrid, frame: Frame, reach: Float[Array, ""]
) -> Float[Array, "X Y Z"]:
    hit = _hit_cells(grid, frame, reach)
    # A point in a cell outweighs any number of rays through it: matter may be thin.
    passed = _passed_cells(grid, frame, reach) & ~hit
    # A point within range may lie in a cell whose center is not: its step is that of the range.
    distance = jnp.minimum(_distance(grid, frame.position), reach)
    # Distant observations count less; beyond 10 m they would count nothing.
    step = STEP * jnp.clip(1.0 - STEP_DECAY * distance, 0.0, 1.0)
    change = jnp.where(hit, step, jnp.where(passed, -step, 0.0))
    return jnp.clip(grid.log_odds + change, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)


def integrate_rays(
    grid: OccupancyGrid,
    points: Float[np.ndarray, "n 3"],
    sensors: Float[np.ndarray, "n 3"],
    max_range: float,
) -> OccupancyGrid:
    """Updates the grid with one scan of a LiDAR; steps are those of `integrate_depth`.

    A cell is hit by a point in it, and passed by a ray that runs through at least half a cell of
    it and ends a quarter of a cell behind it. Hits outweigh passes. On the host.

    Args:
        grid: the grid before the scan.
        points: end points of the rays [m]; beyond `max_range` the ray is free up to there.
        sensors: their origins [m].
        max_range: range of the sensor [m].
    """
    from r3jax.kernels.robot.cells import walk_rays

    size, origin = float(grid.cell_size), np.asarray(grid.origin, np.float64)
    distance = np.linalg.norm(points - sensors, axis=1)
    is_hit = distance <= max_range
    share = np.where(is_hit, 1.0, max_range / np.maximum(distance, 1e-9))
    ends = sensors + share[:, None] * (points - sensors)
    nearest = np.full(grid.log_odds.shape, np.inf)
    kind = np.zeros(grid.log_odds.shape, np.int8)
    walk_rays((sensors - origin) / size, (ends - origin) / size, is_hit, kind, nearest)
    # If several rays pass a cell, the nearest sensor position counts, as for images.
    far = np.where(np.isfinite(nearest), nearest * size, max_range)
    step = STEP * np.clip(1.0 - STEP_DECAY * far, 0.0, 1.0)
    change = np.where(kind == 2, step, np.where(kind == 1, -step, 0.0)).astype(np.float32)
    log_odds = np.clip(np.asarray(grid.log_odds) + change, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)
    return replace(grid, log_odds=jnp.asarray(log_odds))


def _hit_cells(
    grid: OccupancyGrid, frame: Frame, max_range: Float[Array, ""]
) -> Bool[Array, "X Y Z"]:
    """Finds cells that contain at least one measured point within range."""
    x, y = _ray_slopes(frame.camera)
    is_measured = (frame.depth > 0.0) & jnp.isfinite(frame.depth)
    # Replaced before the arithmetic: inf times a slope of 0 is NaN.
    z = jnp.where(is_measured, frame.depth, 1.0)
    # Range is straight from the camera's center, depth along its axis.
    is_hit = is_measured & (z * z * (x * x + y * y + 1.0) <= max_range * max_range)
    # One axis at a time: as [H, W, 3] arrays the same arithmetic takes four times as long.
    T = frame.T_world_camera
    flat = jnp.zeros(z.shape, dtype=jnp.int32)
    for axis, n in enumerate(grid.log_odds.shape):
        point = (T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]) * z + T[axis, 3]
        cell = jnp.floor((point - grid.origin[axis]) / grid.cell_size)
        is_hit = is_hit & (cell >= 0.0) & (cell < n)
        # Meaningless for points outside, where it may overflow; replaced below.
        flat = flat * n + cell.astype(jnp.int32)
    # Out of range if there is no hit: scatters drop it, while -1 would wrap around.
    flat = jnp.where(is_hit, flat, grid.log_odds.size).reshape(-1)
    hits = jnp.zeros(grid.log_odds.size, dtype=bool).at[flat].max(True, mode="drop")
    return hits.reshape(grid.log_odds.shape)


def _ray_slopes(camera: Camera) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """Computes the slopes x / z and y / z of the rays through the pixel centers."""
    rays = pixel_rays(camera)
    return rays[..., 0], rays[..., 1]


def _passed_cells(
    grid: OccupancyGrid, frame: Frame, max_range: Float[Array, ""]
) -> Bool[Array, "X Y Z"]:
    """Finds cells of which at least four octants' centers were seen through."""
    camera = frame.camera
    # The whole grid is transformed into the camera's frame, since cells are tested, not rays.
    T_camera_world = invert_pose(frame.T_world_camera)
    R = T_camera_world[:3, :3]
    shift = R @ grid.origin + T_camera_world[:3, 3]
    nearest, block = _nearest_by_block(camera, frame.depth)
    # A camera whose pixels are the blocks.
    fx, fy, cx, cy = (p / block for p in (camera.fx, camera.fy, camera.cx, camera.cy))
    num_rows, num_columns = nearest.shape
    width, height = camera.width / block, camera.height / block
    indices = [jnp.arange(n, dtype=jnp.float32) for n in grid.log_odds.shape]
    count = jnp.zeros(grid.log_odds.shape, dtype=jnp.int32)
    # One octant at a time: all at once would take eight times the scratch memory.
    for octant in _OCTANTS:
        along = [
            (index + 0.5 + o) * grid.cell_size for index, o in zip(indices, octant, strict=True)
        ]
        # A rotated sum is the sum of one term per axis: no matrix product per cell.
        x, y, z = (
            (R[i, 0] * along[0] + shift[i])[:, None, None]
            + (R[i, 1] * along[1])[None, :, None]
            + (R[i, 2] * along[2])[None, None, :]
            for i in range(3)
        )
        per_z = 1.0 / jnp.maximum(z, 1e-3)
        u = fx * x * per_z + cx
        v = fy * y * per_z + cy
        in_view = (z > 0.0) & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        in_range = x * x + y * y + z * z <= max_range * max_range
        column = jnp.clip(u, 0.0, num_columns - 1.0).astype(jnp.int32)
        row = jnp.clip(v, 0.0, num_rows - 1.0).astype(jnp.int32)
        # The nearest of its block: a ray beside a thin object must not carve it away.
        wall = nearest.reshape(-1)[row * num_columns + column]
        is_before = z + 0.25 * grid.cell_size <= wall
        count = count + (in_view & in_range & is_before).astype(jnp.int32)
    return count >= PASSED_OCTANTS


def _nearest_by_block(
    camera: Camera, depth: Float[Array, "H W"]
) -> tuple[Float[Array, "h w"], int]:
    """Finds the least z-depth in each block of pixels, and the block's side [px].

    A block without any measurement gets 0, so that nothing was seen through it.
    """
    block = max(1, camera.width // BLOCKS_ACROSS)
    window = (block, block)
    # Blocks start at pixel (0, 0); the last row and column may exceed the image.
    padding = [(0, -size % block) for size in depth.shape]
    # Holes must not be the minimum, or one of them would block its whole block.
    measured = jnp.where(depth > 0.0, depth, jnp.inf)
    nearest = jax.lax.reduce_window(measured, jnp.inf, jax.lax.min, window, window, padding)
    # Distinguishes a block of holes from one without surfaces in range: both have the minimum inf.
    any_measured = jax.lax.reduce_window(depth, 0.0, jax.lax.max, window, window, padding)
    return jnp.where(any_measured > 0.0, nearest, 0.0), block


def _inside(grid: OccupancyGrid, index: Int[Array, "*n 3"]) -> Bool[Array, "*n"]:
    inside = jnp.ones(index.shape[:-1], dtype=bool)
    for axis, n in enumerate(grid.log_odds.shape):
        inside = inside & (index[..., axis] >= 0) & (index[..., axis] < n)
    return inside


def _distance(grid: OccupancyGrid, point: Float[Array, " 3"]) -> Float[Array, "X Y Z"]:
    """Computes the distance from a point to every cell's center [m]."""
    return jnp.sqrt(squared_distance(grid, point))


def squared_distance(grid: OccupancyGrid, point: Float[Array, " 3"]) -> Float[Array, "X Y Z"]:
    """Computes the squared distance from a point to every cell's center [m^2]."""
    x, y, z = (
        jnp.square(
            grid.origin[axis]
            + (jnp.arange(n, dtype=jnp.float32) + 0.5) * grid.cell_size
            - point[axis]
        )
        for axis, n in enumerate(grid.log_odds.shape)
    )
    # Three short vectors and one sum over the grid, not an array of centers.
    return x[:, None, None] + y[None, :, None] + z[None, None, :]


def _has_face_neighbor(mask: Bool[Array, "X Y Z"]) -> Bool[Array, "X Y Z"]:
    """Finds cells with a face neighbor in the mask; beyond the grid there is none."""
    # Padded, not rolled: opposite faces of the grid are no neighbors.
    padded = jnp.pad(mask, 1)
    return (
        padded[:-2, 1:-1, 1:-1]
        | padded[2:, 1:-1, 1:-1]
        | padded[1:-1, :-2, 1:-1]
        | padded[1:-1, 2:, 1:-1]
        | padded[1:-1, 1:-1, :-2]
        | padded[1:-1, 1:-1, 2:]
    )
