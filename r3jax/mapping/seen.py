"""Marks voxels in view of a frame, even if none of its pixels fell into them.

A frame's points do not touch all visible voxels: only one in five of a floor at a grazing angle,
and none on a depth edge or behind glass. Such voxels would keep a low renderability however often
they are in view, and a planner would look at them endlessly.

Shape symbols: N capacity of the map; M voxels at a time; W words of bins; H W image size.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.frame import Frame
from r3jax.geometry.cameras import invert_pose
from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.selection import for_selected
from r3jax.geometry.sphere import nearest_bin
from r3jax.kernels import calls
from r3jax.kernels.calls import Cells
from r3jax.kernels.native.platform import call_of_many
from r3jax.mapping.state import MapState
from r3jax.visibility.depth_buffer import visible
from r3jax.visibility.views import View, VisibilityConfig, for_kernels, layout_of, pinhole_view

_Marks = tuple[UInt32[Array, "W N"], Float[Array, " N"]]
"""A map's direction bins and best resolutions."""

_FARTHEST = 1e4
"""Replaces an infinite range [m]."""


def bin_words(bins: Int[Array, " M"], num_words: int) -> UInt32[Array, "W M"]:
    """Packs one direction bin per voxel into words of 32 bits."""
    word = jnp.arange(num_words, dtype=jnp.int32)[:, None]
    bit = jnp.uint32(1) << (bins % 32).astype(jnp.uint32)
    return jnp.where(word == (bins // 32)[None, :], bit[None, :], jnp.uint32(0))


def evidence_of_view(
    state: MapState,
    center: Float[Array, "3 M"],
    position: Float[Array, " 3"] | Float[Array, "3 M"],
    focal: Float[Array, ""],
) -> tuple[UInt32[Array, "W M"], Float[Array, " M"]]:
    """Computes the observation of voxels from a camera: direction bin and resolution.

    Args:
        state: the map; only its number of bins is used.
        center: of the voxels [m].
        position: of the camera, one for all or one for each [m].
        focal: its focal length [px].

    Returns:
        The bin towards the camera as one bit, and focal length over distance [px/m].
    """
    offset = (position if position.ndim == 2 else position[:, None]) - center
    # The direction to a voxel is undefined for a camera inside it: avoid dividing by zero.
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    bins = nearest_bin(offset / distance[None, :], state.num_bins)
    # The paper's resolution is one over the distance; the focal length makes cameras comparable.
    return bin_words(bins, state.visited.shape[0]), focal / distance


def mark_rows(
    state: MapState,
    seen: Bool[Array, " N"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
) -> MapState:
    """Sets the direction bin of visible rows and raises their best resolution.

    Count and colors, which come from pixels, stay.

    Args:
        state: the map before.
        seen: rows that a camera sees.
        position: of the camera [m].
        focal: its focal length [px].
    """
    num = state.capacity

    def mark(index: Int[Array, " M"], valid: Bool[Array, " M"], marks: _Marks) -> _Marks:
        visited, resolution = marks
        # Padding has the index of a real row, and must not write to it.
        row = jnp.where(valid, index, num)
        words, sharper = evidence_of_view(state, state.center_of(index), position, focal)
        # Rows are distinct: the order of the writes does not matter.
        visited = visited.at[:, row].set(visited[:, index] | words, mode="drop")
        return visited, resolution.at[row].max(sharper, mode="drop")

    marks = for_selected(seen, mark, (state.visited, state.resolution))
    return eqx.tree_at(lambda m: (m.visited, m.resolution), state, marks)


@jax.custom_jvp
def seen_in_view(
    state: MapState, cells: Cells, view: View, config: VisibilityConfig
) -> tuple[Bool[Array, " N"], Bool[Array, " c"]]:
    """Finds the voxels and the unexplored cells that a view sees; no derivative passes through it.

    By a kernel on CPUs, and by the formula `depth_buffer.visible` elsewhere.
    """
    num, layout = cells.x.shape[0], layout_of(view)

    def kernel(known: tuple[MapState, Cells], views: Any) -> tuple[Array, Array]:
        (state, cells), (view, tolerance) = known, views
        laid_out = jax.vmap(for_kernels)(view, tolerance, jnp.ones_like(tolerance))
        _, _, *bits = calls.sums(
            state.rows, cells, laid_out, layout, calls.Forms(), 1, state.num_bins, keep=True
        )
        unpack = lambda bits, count: jnp.unpackbits(bits, axis=1, count=count).astype(bool)
        return unpack(bits[0], state.capacity), unpack(bits[1], num)

    def formula(known: tuple[MapState, Cells], one: Any) -> tuple[Array, Array]:
        state, cells = known
        points = jnp.stack([cells.x, cells.y, cells.z])
        own = VisibilityConfig(tolerance=one[1])
        shown, empty = visible(state.voxels, points, one[0], own)
        return shown, empty & cells.unexplored

    return call_of_many(kernel, formula, (state, cells), (view, config.tolerance), state.capacity)


@seen_in_view.defjvp
def _seen_in_view_jvp(primals: Any, tangents: Any) -> Any:
    del tangents  # what is seen is piecewise constant
    seen = seen_in_view(*primals)
    return seen, tuple(np.zeros(mask.shape, dtype=jax.dtypes.float0) for mask in seen)


def visible_rows(state: MapState, view: View, config: VisibilityConfig) -> Bool[Array, " N"]:
    """Finds the voxels that a view sees."""
    # A dummy row: batches of empty arrays cannot be reshaped.
    zero = jnp.zeros(1)
    return seen_in_view(state, Cells(zero, zero, zero, zero > 0), view, config)[0]


def mark_seen(state: MapState, frame: Frame, max_range: float | Float[Array, ""]) -> MapState:
    """Marks every voxel in view that nothing hides as seen from the frame's camera.

    Voxels in front of the measured surface count, too: they come from the sensor's noise, and more
    views would not show more of them.

    Args:
        state: the map, after the frame's pixels were added.
        frame: the frame.
        max_range: voxels farther from the camera do not count [m].
    """
    seen = rows_in_view(state, frame, jnp.asarray(max_range, dtype=jnp.float32))
    return mark_rows(state, seen, frame.position, frame.camera.focal)


def rows_in_view(state: MapState, frame: Frame, max_range: Float[Array, ""]) -> Bool[Array, " N"]:
    """Finds the voxels within range that the frame shows.

    Where depth was measured, these are the voxels whose center is not farther. Elsewhere they are
    those that no other voxel hides: the color image shows surfaces behind glass anyway, and an
    occluder missing from the map will also hide them in later views from here.
    """
    is_in, z, row, column = project_rows(state, frame, max_range)
    # On a slope the depth changes within a pixel: the farthest of its neighbors is the limit.
    farthest = jax.lax.reduce_window(frame.depth, 0.0, jax.lax.max, (3, 3), (1, 1), "SAME")
    # A hole stays a hole: its neighbors' depths do not apply to its ray.
    farthest = jnp.where(frame.depth > 0.0, farthest, 0.0).reshape(-1)
    pixel = row * frame.camera.width + column
    measured = farthest[pixel]
    # A tolerance of one voxel: a surface may lie anywhere within its voxel.
    is_shown = (measured > 0.0) & (z <= measured + state.voxel_size)
    is_hole = frame.depth.reshape(-1)[pixel] == 0.0
    return is_in & (is_shown | (is_hole & hidden_by_none(state, frame, max_range)))


def project_rows(
    state: MapState, frame: Frame, max_range: Float[Array, ""]
) -> tuple[Bool[Array, " N"], Float[Array, " N"], Int[Array, " N"], Int[Array, " N"]]:
    """Projects the centers of voxels into a frame.

    Returns:
        Whether each lies in the image and within range, its z-depth [m], and its pixel (row and
        column; arbitrary if it does not).
    """
    camera, T = frame.camera, invert_pose(frame.T_world_camera)
    center = state.center

    def along(i: int) -> Array:
        return T[i, 0] * center[0] + T[i, 1] * center[1] + T[i, 2] * center[2] + T[i, 3]

    x, y, z = along(0), along(1), along(2)
    # At and behind the camera any finite factor: those voxels are masked.
    per_z = 1.0 / jnp.maximum(z, 1e-3)
    u, v = camera.fx * x * per_z + camera.cx, camera.fy * y * per_z + camera.cy
    is_in = state.occupied & (z > 1e-3) & (u >= 0.0) & (u < camera.width)
    is_in &= (v >= 0.0) & (v < camera.height)
    # Distance from the camera, as in the grid and the scores; only depth is along the axis.
    is_in &= x * x + y * y + z * z <= max_range * max_range
    # Clipped before the cast: voxels out of the image may be anywhere, and are masked.
    column = jnp.clip(u, 0.0, camera.width - 1.0).astype(jnp.int32)
    row = jnp.clip(v, 0.0, camera.height - 1.0).astype(jnp.int32)
    return is_in, z, row, column


def hidden_by_none(state: MapState, frame: Frame, max_range: Float[Array, ""]) -> Bool[Array, " N"]:
    """Finds the voxels that no other voxel hides in a frame's view, if depth failed anywhere."""

    def look() -> Bool[Array, " N"]:
        config = VisibilityConfig(max_range=jnp.minimum(max_range, _FARTHEST))
        view = pinhole_view(frame.camera, frame.T_world_camera, config)
        return visible_rows(state, view, config)

    # A branch: a depth buffer of the whole map is only needed if depth failed somewhere.
    nothing: Callable[[], Bool[Array, " N"]] = lambda: jnp.zeros(state.capacity, dtype=bool)
    return jax.lax.cond(jnp.any(frame.depth == 0.0), look, nothing)
