"""Voxels that a frame looked at, whether or not one of its pixels fell into them.

A frame's points do not touch all that it sees: of a floor seen at a grazing angle one voxel in
five, of what lies on a depth edge or behind glass none. Such a voxel would keep a low
renderability however often one looks at it, and a planner would look for ever.

Shape symbols: N capacity of the map; M voxels at a time; W words of bins; H W image size.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.frame import Frame
from r3jax.geometry.cameras import invert_pose
from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.sphere import nearest_bin
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.compact import positions_of_set
from r3jax.mapping.join import CHUNK, bin_words, grow
from r3jax.mapping.state import MapState
from r3jax.mapping.update import integrate
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.views import pinhole_view
from r3jax.scoring.visibility import seen_in
from r3jax.scoring.voxels import voxels_of

_MAX_LOAD = 0.7
"""The table grows before more than this share of its rows is in use."""


_Tables = tuple[UInt32[Array, "W N"], Float[Array, " N"]]
"""A map's direction bins and best resolutions."""


def mark_seen(state: MapState, frame: Frame, max_range: float | Float[Array, ""]) -> MapState:
    """Every voxel in view that nothing hides has been seen from here.

    Its direction bin is set and its best resolution raised; count and colors belong to
    `integrate`, as only pixels know them. Voxels in front of the measured surface count too:
    the sensor's noise has put them there, and there is no more to be seen of them.

    Args:
        state: the map, the frame integrated.
        frame: the frame.
        max_range: voxels farther from the camera than this are not seen [m].
    """
    num = state.capacity
    seen = looked_at(state, frame, jnp.asarray(max_range, dtype=jnp.float32))
    size = min(num, CHUNK)
    rows = positions_of_set(seen, -(-num // size) * size)
    count = jnp.sum(seen, dtype=jnp.int32)

    def mark(chunk: Int[Array, ""], tables: _Tables) -> _Tables:
        visited, resolution = tables
        row = jax.lax.dynamic_slice_in_dim(rows, chunk * size, size)
        key = state.key.at[:, row].get(mode="fill", fill_value=0)
        center = voxel_center(jnp.stack(unpack(key[0], key[1])), state.voxel_size)
        offset = frame.position[:, None] - center
        distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
        words = bin_words(nearest_bin(offset / distance[None, :], state.num_bins), visited.shape[0])
        before = visited.at[:, row].get(mode="fill", fill_value=0)
        # Rows are distinct: the order of the writes does not matter.
        visited = visited.at[:, row].set(before | words, mode="drop")
        return visited, resolution.at[row].max(frame.camera.focal / distance, mode="drop")

    tables = state.visited, state.resolution
    visited, resolution = jax.lax.fori_loop(0, (count + size - 1) // size, mark, tables)
    return MapState(
        key=state.key,
        visited=visited,
        count=state.count,
        mean=state.mean,
        m2=state.m2,
        resolution=resolution,
        voxel_size=state.voxel_size,
        dropped=state.dropped,
        num_bins=state.num_bins,
    )


def looked_at(state: MapState, frame: Frame, max_range: Float[Array, ""]) -> Bool[Array, " N"]:
    """Voxels within range that the frame shows.

    Where it has a measurement, those whose center is no farther. Where it has none, those that no
    other voxel hides: the color image shows what lies behind glass all the same, and whatever
    the map does not know of is in front of it in every later view from here, too.
    """
    camera, T = frame.camera, invert_pose(frame.T_world_camera)
    center = voxel_center(jnp.stack(unpack(state.key[0], state.key[1])), state.voxel_size)

    def along(i: int) -> Array:
        return T[i, 0] * center[0] + T[i, 1] * center[1] + T[i, 2] * center[2] + T[i, 3]

    x, y, z = along(0), along(1), along(2)
    per_z = 1.0 / jnp.maximum(z, 1e-3)
    u, v = camera.fx * x * per_z + camera.cx, camera.fy * y * per_z + camera.cy
    is_in = state.occupied & (z > 1e-3) & (u >= 0.0) & (u < camera.width)
    is_in &= (v >= 0.0) & (v < camera.height)
    is_in &= x * x + y * y + z * z <= max_range * max_range
    # On a slope the depth changes within a pixel: the farthest of its neighbors limits.
    farthest = jax.lax.reduce_window(frame.depth, 0.0, jax.lax.max, (3, 3), (1, 1), "SAME")
    farthest = jnp.where(frame.depth > 0.0, farthest, 0.0).reshape(-1)
    column = jnp.clip(u, 0.0, camera.width - 1.0).astype(jnp.int32)
    row = jnp.clip(v, 0.0, camera.height - 1.0).astype(jnp.int32)
    pixel = row * camera.width + column
    measured = farthest[pixel]
    is_shown = (measured > 0.0) & (z <= measured + state.voxel_size)
    is_hole = is_in & (frame.depth.reshape(-1)[pixel] == 0.0)
    hidden_by_none = jax.lax.cond(
        jnp.any(is_hole),
        lambda: _hidden_by_none(state, frame, jnp.where(is_in, x * x + y * y + z * z, 0.0)),
        lambda: jnp.zeros(state.capacity, dtype=bool),
    )
    return (is_in & is_shown) | (is_hole & hidden_by_none)


def _hidden_by_none(
    state: MapState, frame: Frame, squared_distance: Float[Array, " N"]
) -> Bool[Array, " N"]:
    """Voxels that the map itself shows in a frame's view, up to the farthest in it."""
    farthest = jnp.sqrt(jnp.max(squared_distance)) + state.voxel_size
    config = ScoringConfig(max_range=farthest)
    voxels, view = voxels_of(state), pinhole_view(frame.camera, frame.T_world_camera, config)
    _, visible = seen_in(voxels, view, config)
    return visible.mask


_mark_seen = jax.jit(mark_seen)


def look(
    state: MapState,
    frame: Frame,
    max_range: float = np.inf,
    *,
    allow_growth: bool = True,
    drop_edges: bool = True,
) -> MapState:
    """A frame joins the map (`integrate`), and what it looked at counts as seen (`mark_seen`).

    Not to be called under jit: the table is doubled before it is 70 % full.

    Args:
        state: the map before the frame.
        frame: the frame.
        max_range: measurements beyond this z-depth are ignored, as are voxels farther away [m].
        allow_growth: False keeps the capacity; what finds no row is counted in `dropped`.
        drop_edges: False lets pixels on depth edges in.
    """
    after = integrate(state, frame, max_range, drop_edges)
    while allow_growth and (
        int(after.num_occupied) > _MAX_LOAD * after.capacity
        or int(after.dropped) > int(state.dropped)
    ):
        state = grow(state, 2 * state.capacity)
        after = integrate(state, frame, max_range, drop_edges)
    return _mark_seen(after, frame, max_range)
