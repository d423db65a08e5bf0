"""What each pixel of a view would show of the map: the form in which other planners score views.

Active-GS, ActiveGAMER and COVER render their map from every candidate and average over pixels.
Here the rendering is the nearest voxel of each pixel (`scoring.backend`), at most
`VisibilityConfig.zbuffer_size` wide.

Shape symbols: C candidates; h w pixels of the buffer; n voxels and c cells at hand; N rows of the
map.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.seen import seen_in_view
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates
from r3jax.planning.policy import Situation
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from r3jax.visibility.views import pinhole_view


class PixelView(eqx.Module):
    """One view of the map, pixel by pixel."""

    hit: Bool[Array, "h w"]
    """True where the map shows a voxel: within the sensor's range, if `reach` says no more."""

    depth: Float[Array, "h w"]
    """z-depth of the voxel's center [m]; inf where there is none."""

    offset: Float[Array, "3 h w"]
    """From the voxel's center to the camera [m]; undefined where no voxel is."""

    rows: Any
    """The requested quantities of the visible voxel, `[..., h, w]`; undefined where none is."""

    cells: Float[Array, ""]
    """Visible unexplored cells of the coarse grid; pixels without a voxel hide nothing."""

    max_range: Float[Array, ""]
    """The sensor's range [m]."""


Value = Callable[[PixelView], Any]
"""Scores one view; a module-level function, so that it compiles once."""


def score_by_pixels(
    situation: Situation,
    value: Value,
    candidates: Candidates,
    scoring: ScoringConfig,
    rows: Any = (),
    reach: float | None = None,
) -> list[np.ndarray]:
    """Scores the candidates of a situation by `score_pixels`.

    Returns an array [C] float64 for each number that `value` computes of a view.
    """
    numbers = score_pixels(
        value,
        situation.map_state,
        situation.scoring_grid,
        situation.camera,
        candidates.poses_on_device(),
        scoring,
        rows,
        reach,
    )
    return [np.asarray(number, dtype=np.float64) for number in numbers]


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
    """Computes `value` of every pose; fields of shape [C, ...]. Not to be called under jit.

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
    def shown(pose: Array) -> tuple[Int[Array, "h w"], Bool[Array, " c"]]:
        view = pinhole_view(camera, pose, config)
        far = eqx.tree_at(lambda v: v.max_range, view, reach)
        # In the view of the sensor's range: what it cannot measure stays unexplored.
        return rows_in_pixels(voxels, far, config), seen_in_view(voxels, cells, view, config)[1]

    def look(one: tuple[Array, tuple[Array, Array]]) -> Any:
        pose, (item, unexplored) = one
        return value(pixel_view(voxels, pose, config, item, unexplored, rows))

    # All views in one call of the backend; their pixels are processed one view after the other.
    return jax.lax.map(look, (poses, jax.vmap(shown)(poses)))


def pixel_view(
    voxels: MapState,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
    item: Int[Array, "h w"],
    unexplored: Bool[Array, " c"],
    rows: Any = (),
) -> PixelView:
    """Gathers what a view shows of voxels that are at hand.

    Args:
        voxels: n voxels.
        T_world_camera: pose of the view.
        config: the sensor's range.
        item: the voxel that each pixel shows; n where there is none.
        unexplored: which of the c unexplored cells the view shows.
        rows: arrays `[..., n]` with something about each voxel.
    """
    num, position = voxels.count.shape[0], T_world_camera[:3, 3]
    hit = item < num
    item = jnp.minimum(item, num - 1)
    center = voxels.center_of(item.reshape(-1)).reshape(3, *item.shape)
    offset = position[:, None, None] - center
    axis = T_world_camera[:3, 2][:, None, None]
    return PixelView(
        hit=hit,
        # The offset points towards the camera, the axis away from it: hence the sign.
        depth=jnp.where(hit, -jnp.sum(offset * axis, axis=0), jnp.inf),
        offset=offset,
        rows=jax.tree.map(lambda x: x[..., item], rows),
        cells=jnp.sum(unexplored, dtype=jnp.float32),
        max_range=config.max_range,
    )
