"""What each pixel of a view would show of the map: the form in which other planners score views.

Active-GS, ActiveGAMER and COVER render their map from every candidate and average over pixels.
Here the rendering is the voxel depth buffer of `visibility`, at most `config.zbuffer_size` wide.

Shape symbols: C candidates; h w pixels of the buffer; n voxels at hand; N rows of the map.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import Camera
from r3jax.geometry.numerics import safe_norm
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.cells import Cells, over_visible
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from r3jax.visibility.depth_buffer import DepthBuffer, candidates_of, depth_buffer
from r3jax.visibility.views import PinholeView, Placement, pinhole_view


class PixelView(eqx.Module):
    """One view of the map, pixel by pixel."""

    hit: Bool[Array, "h w"]
    """True where the map shows a voxel: within the sensor's range, if `reach` says no more."""

    depth: Float[Array, "h w"]
    """z-depth of the voxel's center [m]; inf where there is none."""

    offset: Float[Array, "3 h w"]
    """From the voxel's center to the camera [m]; meaningless where there is none."""

    rows: Any
    """What was asked for about the voxels, `[..., h, w]` each; meaningless where there is none."""

    cells: Float[Array, ""]
    """Visible unexplored cells of the coarse grid; pixels without a voxel hide nothing."""

    cell_distance: Float[Array, ""]
    """Sum of their distances from the camera [m]."""

    max_range: Float[Array, ""]
    """The sensor's range [m]."""


Value = Callable[[PixelView], Any]
"""Scores one view; a module-level function, so that it compiles once."""


def score_pixels(
    value: Value,
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    poses: Float[Array | np.ndarray, "C 4 4"],
    config: ScoringConfig,
    rows: Any = (),
    reach: float | None = None,
) -> Any:
    """`value` of every pose; fields of shape [C, ...]. Not to be called under jit.

    Args:
        value: what to make of a view.
        state: the map.
        grid: whose unexplored cells count.
        camera: of the views.
        poses: the candidates.
        config: range, tolerance and size of the depth buffer.
        rows: arrays `[..., N]` with something about each row of the map, which `value` finds in
            `PixelView.rows`.
        reach: voxels are shown up to this distance [m], by default the sensor's range. It does
            not let a view see farther cells.
    """
    poses = jnp.asarray(poses, dtype=jnp.float32)
    far = jnp.asarray(config.max_range if reach is None else reach, dtype=jnp.float32)
    reaching = eqx.tree_at(lambda c: c.max_range, config, far)
    voxels, cells, index = gather_in_range(state, grid, poses[:, :3, 3], reaching)
    last = state.capacity - 1
    rows = jax.tree.map(lambda x: jnp.asarray(x)[..., jnp.minimum(index, last)], rows)
    return map_over_devices(
        functools.partial(_score, value, voxels, cells, camera, config, rows, far), poses
    )


@functools.partial(jax.jit, static_argnames="value")
def _score(
    value: Value,
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    rows: Any,
    reach: Float[Array, ""],
    poses: Float[Array, "C 4 4"],
) -> Any:
    def look(pose: Array) -> Any:
        return value(pixel_view(voxels, cells, camera, pose, config, rows, reach))

    return jax.lax.map(look, poses)


def pixel_view(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
    rows: Any = (),
    reach: Float[Array, ""] | None = None,
) -> PixelView:
    """One view of voxels and cells that are at hand; `rows` holds arrays `[..., n]`."""
    view = pinhole_view(camera, T_world_camera, config)
    far = view if reach is None else eqx.tree_at(lambda v: v.max_range, view, reach)
    buffer = depth_buffer(voxels, candidates_of(voxels, far), far, config)
    num = voxels.count.shape[0]
    hit = buffer.item < num
    item = jnp.minimum(buffer.item, num - 1)
    center = voxels.center_of(item.reshape(-1)).reshape(3, *item.shape)
    offset = T_world_camera[:3, 3][:, None, None] - center
    axis = T_world_camera[:3, 2][:, None, None]
    # Of the voxel itself: in the buffer it is rounded down, and would hide a cell just before it.
    nearest = jnp.where(hit, safe_norm(offset, axis=0), jnp.inf)
    buffer = eqx.tree_at(lambda b: b.distance, buffer, nearest)
    # In the view of the sensor's range: what it cannot measure stays unexplored.
    count, distance = _unexplored(cells, view, buffer)
    return PixelView(
        hit=hit,
        # The offset points towards the camera, the axis away from it: hence the sign.
        depth=jnp.where(hit, -jnp.sum(offset * axis, axis=0), jnp.inf),
        offset=offset,
        rows=jax.tree.map(lambda x: x[..., item], rows),
        cells=count,
        cell_distance=distance,
        max_range=config.max_range,
    )


def _unexplored(
    cells: Cells, view: PinholeView, buffer: DepthBuffer
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Number of unexplored cells whose center the view sees, and the sum of their distances."""

    def add(
        points: Float[Array, "3 n"],
        place: Placement,
        is_seen: Bool[Array, " n"],
        totals: tuple[Float[Array, ""], Float[Array, ""]],
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        del points
        count = jnp.sum(is_seen, dtype=jnp.float32)
        return totals[0] + count, totals[1] + jnp.sum(jnp.where(is_seen, place.distance, 0.0))

    return over_visible(cells, view, buffer, add, (jnp.zeros(()), jnp.zeros(())))
