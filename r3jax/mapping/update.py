"""Integrates frames and points: makes one observation per touched voxel and joins it into the map.

Shape symbols: P points of a frame; M observations that join at once; H W image size.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.errors import InputError
from r3jax.frame import Frame, a_frame
from r3jax.geometry.arguments import checked
from r3jax.geometry.cameras import invert_pose, is_traced, nan_unless_valid
from r3jax.geometry.selection import positions_of_set
from r3jax.geometry.voxels import INDEX_LIMIT, check_near_origin, unpack, voxel_center
from r3jax.kernels import calls
from r3jax.kernels.constants import JOINED
from r3jax.kernels.native.platform import by_platform
from r3jax.mapping.associate import (
    Groups,
    edge_pixels,
    group_by_voxel,
    group_means,
    points_of_pixels,
)
from r3jax.mapping.join import Statistics, grow, join
from r3jax.mapping.moved import count_misses
from r3jax.mapping.seen import evidence_of_view, hidden_by_none, mark_rows, rows_in_view
from r3jax.mapping.state import MapState, a_map

_NEAR = 1000.0
"""Up to this distance voxels of a millimeter have an index [m]."""

MAX_LOAD = 0.7
"""The table grows before more than this share of its rows is in use."""


def observe_voxels(
    state: MapState,
    key: UInt32[Array, "2 M"],
    valid: Bool[Array, " M"],
    rgb: Float[Array, "3 M"],
    camera_position: Float[Array, " 3"] | Float[Array, "3 M"],
    focal: Float[Array, ""],
) -> Statistics:
    """Makes one observation per voxel: direction bin, resolution, mean color."""
    # From the voxel's center, not the points': bins must not depend on the pixel grid.
    center = voxel_center(jnp.stack(unpack(key[0], key[1])), state.voxel_size)
    words, resolution = evidence_of_view(state, center, camera_position, focal)
    return Statistics(
        key=key,
        valid=valid,
        count=valid.astype(jnp.float32),
        mean=jnp.where(valid[None, :], rgb, 0.0),
        # A single observation has no variance: `join` adds that between observations.
        m2=jnp.zeros(valid.shape, dtype=jnp.float32),
        visited=words,
        resolution=resolution,
    )


def integrate_groups(
    state: MapState,
    groups: Groups,
    camera_position: Float[Array, " 3"] | Float[Array, "P 3"],
    focal: Float[Array, ""],
) -> MapState:
    """Adds one observation per touched voxel to the map, `JOINED` voxels at a time.

    Args:
        state: the map before.
        groups: the points by voxel.
        camera_position: camera center; one for all, or one for each leader [m].
        focal: focal length [px].
    """
    num = groups.is_leader.shape[0]
    size = min(num, JOINED)
    # Rounded up to whole chunks, so that the last slice is not shifted.
    leaders = positions_of_set(groups.is_leader, -(-num // size) * size)
    num_voxels = jnp.sum(groups.is_leader, dtype=jnp.int32)

    # Chunks are counted one by one, as in `geometry.selection`: XLA miscounts other steps.
    def join_chunk(chunk: Int[Array, ""], state: MapState) -> MapState:
        index = jax.lax.dynamic_slice_in_dim(leaders, chunk * size, size)
        valid = index < num
        index = jnp.minimum(index, num - 1)
        sums = groups.rgb_sum[index].T
        # Padding may gather a point that is not a leader, whose count is 0.
        rgb = sums[:3] / jnp.maximum(sums[3:], 1.0)
        position = camera_position[index].T if camera_position.ndim == 2 else camera_position
        seen = observe_voxels(state, groups.key[:, index], valid, rgb, position, focal)
        return join(state, seen)

    return jax.lax.fori_loop(0, (num_voxels + (size - 1)) // size, join_chunk, state)


def integrate_pixels(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    """Adds the frame's measured pixels to the map: counts and colors of `integrate`."""
    depth = frame.depth
    factor = nan_unless_valid(frame.camera, frame.T_world_camera)
    # An invalid pose makes the factor NaN, and NaN > 0 is False: the frame adds nothing.
    is_measured = (depth > 0.0) & jnp.isfinite(depth) & (depth <= max_range) & (factor > 0.0)
    # A branch, not a select: XLA would compute the medians again in each of their consumers.
    valid = jax.lax.cond(
        drop_edges,
        lambda: is_measured & ~edge_pixels(depth, state.voxel_size),
        lambda: is_measured,
    )
    # 1 m replaces missing depth: inf would make the points NaN.
    points = points_of_pixels(frame, jnp.where(is_measured, depth, 1.0))
    rgb = frame.rgb.reshape(-1, 3)
    groups = group_by_voxel(points, rgb, valid.reshape(-1), state.voxel_size)
    after = integrate_groups(state, groups, frame.position, frame.camera.focal)
    # A voxel size of NaN spreads to every later score, and no later frame can undo it.
    return eqx.tree_at(lambda m: m.voxel_size, after, factor * after.voxel_size)


def _by_formulas(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    # Pixels first: new voxels hide what lies behind them in this very frame; so do those that it
    # removes.
    after = integrate_pixels(state, frame, max_range, drop_edges)
    seen = rows_in_view(after, frame, max_range)
    after = count_misses(after, frame, max_range)
    return mark_rows(after, seen, frame.position, frame.camera.focal)


def _by_kernels(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    """Integrates a frame by machine code."""
    # `hidden_by_none` waits for the slowest kernel, which another process compiles meanwhile.
    calls.compile_first("map_add", "map_look")
    after = _pixels_by_kernel(state, frame, max_range, drop_edges)
    factor = nan_unless_valid(frame.camera, frame.T_world_camera)
    image = for_kernels(frame, factor * max_range, drop_edges)
    is_visible = hidden_by_none(after, frame, max_range).astype(jnp.uint8)
    rows, mean, misses = calls.map_look(
        after.rows, after.mean, after.misses, image, is_visible, state.num_bins
    )
    return with_rows(after, rows, mean=mean, misses=misses)


def add_pixels(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    """Adds the frame's measured pixels, by a kernel on CPUs and by `integrate_pixels` elsewhere."""
    add = by_platform(cpu=_pixels_by_kernel, default=integrate_pixels)
    return add(state, frame, max_range, drop_edges)


def _pixels_by_kernel(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    factor = nan_unless_valid(frame.camera, frame.T_world_camera)
    # An invalid pose makes the range NaN, and no depth is below it: the frame adds nothing.
    image = for_kernels(frame, factor * max_range, drop_edges)
    rows, mean, lost = calls.map_add(state.rows, state.mean, image, state.num_bins)
    rows = rows._replace(voxel_size=factor * rows.voxel_size)
    return with_rows(state, rows, mean=mean, dropped=state.dropped + lost)


def with_rows(state: MapState, rows: calls.MapRows, **changed: Array | None) -> MapState:
    """Returns the map with the rows of a kernel's result, and other changed fields."""
    return replace(
        state,
        key=rows.key,
        visited=rows.visited,
        count=rows.counts,
        m2=rows.m2,
        resolution=rows.resolution,
        voxel_size=rows.voxel_size,
        **changed,
    )


def for_kernels(
    frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> calls.FrameArrays:
    """Lays a frame out as kernels take it."""
    camera, T = frame.camera, frame.T_world_camera
    return calls.FrameArrays(
        frame.depth, frame.rgb, T, invert_pose(T), camera.fx, camera.fy, camera.cx, camera.cy,
        camera.focal, max_range, drop_edges.astype(jnp.float32),
    )  # fmt: skip


@jax.custom_jvp
def _integrate(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    """Adds one frame to the map, by kernels on CPUs and by the formulas elsewhere."""
    add = by_platform(cpu=_by_kernels, default=_by_formulas)
    return add(state, frame, max_range, drop_edges)


@_integrate.defjvp
def _integrate_jvp(primals: Any, tangents: Any) -> Any:
    return jax.jvp(_by_formulas, primals, tangents)


# Two programs: whether an argument is donated is fixed when a function is jitted.
_integrate_jitted = jax.jit(_integrate)
_integrate_in_place = jax.jit(_integrate, donate_argnums=0)


@checked(state=a_map, frame=a_frame)
def integrate(
    state: MapState,
    frame: Frame,
    max_range: float | int | Float[Array, ""] = np.inf,
    drop_edges: bool | Bool[Array, ""] = True,
    *,
    donate: bool = False,
) -> MapState:
    """Integrates a posed RGB-D frame into the map: measured pixels and visible voxels.

    Each voxel that a pixel falls into gets one observation. Every other voxel in view that no
    measurement hides is marked as seen from here (`mapping.seen`); without that, a planner takes
    the same view of a ceiling twenty times. Pixels on depth edges are ignored: their color mixes
    two surfaces. Compiled on first use for each image size and capacity. `MapState.dropped` counts
    voxels beyond the capacity; `integrate_growing` enlarges the table instead.

    Poses that are not rigid are refused outside jit. Under jit such a frame adds nothing, and the
    voxel size becomes NaN, and so does every later score.

    Args:
        state: the map before the frame.
        frame: the frame. Depth 0 (no measurement) and inf (out of range) are ignored.
        max_range: measurements beyond this z-depth are ignored, and so are voxels farther away [m].
        drop_edges: False keeps pixels on depth edges.
        donate: True updates the table in place:
            `state` must not be used again. The cost then does not grow with the capacity, where a
            copy of a million rows takes 15 ms.

    Raises:
        TypeError: not a map, or not a frame.
        ValueError: a range that is not positive, a camera too far from the origin for voxel indices
            (both checked outside jit); several maps or frames at once, without `jax.vmap`.
    """
    # Values can only be refused where they are known.
    if not is_traced(max_range) and not float(max_range) > 0.0:
        raise InputError(f"max_range must be positive [m], got {float(max_range)}")
    if not is_traced(frame.T_world_camera, state.voxel_size):
        _check_in_reach(state, frame)
    max_range = jnp.asarray(max_range, dtype=jnp.float32)
    arguments = frame, max_range, jnp.asarray(drop_edges)
    # Within another program nothing can be given away.
    if is_traced(*jax.tree.leaves((state, arguments))):
        return _integrate_jitted(state, *arguments)
    if not donate:  # copied here, so that one program serves both
        state = jax.tree.map(jnp.copy, state)
    return _integrate_in_place(state, *arguments)


def _check_in_reach(state: MapState, frame: Frame) -> None:
    """Refuses a camera too far from the origin for voxel indices."""
    position = np.asarray(frame.T_world_camera)[:3, 3]
    # Near the origin even small voxels have indices: no need to wait for the map's voxel size.
    if np.abs(position).max(initial=0.0) > _NEAR:
        limit = 0.99 * INDEX_LIMIT * float(state.voxel_size)
        check_near_origin("T_world_camera", position, limit)


def integrate_growing(
    state: MapState,
    frame: Frame,
    max_range: float = np.inf,
    *,
    allow_growth: bool = True,
    drop_edges: bool = True,
    donate: bool = False,
) -> MapState:
    """Adds a frame as `integrate` does, and doubles the table before it is 70 % full.

    Not to be called under jit: shapes change.

    Args:
        state: the map before the frame.
        frame: the frame.
        max_range: as in `integrate` [m].
        allow_growth: False keeps the capacity; voxels beyond it are counted in `dropped`.
        drop_edges: False keeps pixels on depth edges.
        donate: `state` will not be used again: the table is updated in place where it has room for
            a voxel in each pixel, so that it cannot have to grow.
    """
    has_room = donate and (
        not allow_growth or int(state.num_occupied) + frame.depth.size <= MAX_LOAD * state.capacity
    )
    if has_room or not allow_growth:
        return integrate(state, frame, max_range, drop_edges, donate=has_room)
    return update_growing(lambda now: integrate(now, frame, max_range, drop_edges), state)


def update_growing(
    update: Callable[[MapState], MapState], state: MapState, most_rows: int | None = None
) -> MapState:
    """Updates a map, and doubles its table until the update fits.

    Args:
        update: a pure function that adds to a map.
        state: the map before.
        most_rows: maximum number of rows; None: no limit.

    Raises:
        ValueError: more rows would be needed.
    """
    # Add first, grow afterwards: almost every frame fits, and checking costs as much as adding.
    after = update(state)
    # Also if something was dropped: a long probe sequence may fail below the limit.
    while int(after.num_occupied) > MAX_LOAD * after.capacity or int(after.dropped) > int(
        state.dropped
    ):
        if most_rows is not None and state.capacity >= most_rows:
            raise InputError(f"the map would need more than {most_rows} rows")
        # From the state before the update, so that dropped voxels are not lost.
        state = grow(state, 2 * state.capacity)
        after = update(state)
    return after


@jax.jit
def _integrate_points(
    state: MapState,
    points_world: Float[Array, "P 3"],
    rgb: Float[Array, "P 3"],
    camera_position: Float[Array, " 3"] | Float[Array, "P 3"],
    focal: Float[Array, ""],
    valid: Bool[Array, " P"],
) -> MapState:
    valid = valid & jnp.all(jnp.isfinite(points_world), axis=1)
    if camera_position.ndim == 2:
        valid = valid & jnp.all(jnp.isfinite(camera_position), axis=1)
    # NaN in padding would spread to gradients and indices even if masked.
    points = jnp.where(valid[:, None], points_world, 0.0)
    groups = group_by_voxel(points.T, rgb, valid, state.voxel_size)
    if camera_position.ndim == 2:
        camera_position = group_means(groups, camera_position)
    return integrate_groups(state, groups, camera_position, focal)


@checked(state=a_map)
def integrate_points(
    state: MapState,
    points_world: ArrayLike,
    rgb: ArrayLike,
    camera_position: ArrayLike,
    focal: ArrayLike = 1.0,
    *,
    valid: ArrayLike | None = None,
) -> MapState:
    """Integrates the points seen by one camera, or by a scanner, into the map.

    This is `integrate` for points. One call is one observation of each touched voxel, however many
    points fall into it. A LiDAR has rays instead of pixels: its `focal` is one over the angle
    between neighboring rays [1/rad], which gives points per meter where a camera gives pixels per
    meter. A scanner may move while it turns: each point may have its own sensor position, and a
    voxel counts as seen from the mean position of its points. So split a long recording into scans.
    If the scanner has no color, repeat its intensity three times. Takes arrays of NumPy and JAX,
    and checks their shapes and values. Compiled on first use for each number of points and
    capacity: pad scans to one length, and mask the padding out.

    Args:
        state: the map before.
        points_world: points [m], world, [P, 3].
        rgb: their colors in [0, 1], [P, 3].
        camera_position: position of the camera or scanner [m]: [3], or [P, 3] for each point.
        focal: focal length [px]; with 1.0 the resolution is the paper's 1 / distance.
        valid: False for padding, which may hold anything, [P] bool. None: every point counts.

    Raises:
        ValueError: shapes that do not fit; values that are not finite or colors outside [0, 1]
            (checked outside jit).
    """
    points_world, rgb = jnp.asarray(points_world, dtype=jnp.float32), jnp.asarray(rgb)
    camera_position = jnp.asarray(camera_position, dtype=jnp.float32)
    focal = jnp.asarray(focal, dtype=jnp.float32)
    _check_shapes(points_world, rgb, camera_position, focal)
    num = points_world.shape[0]
    mask = jnp.ones(num, dtype=bool) if valid is None else jnp.asarray(valid)
    # Integers are refused: they could be indices of points instead of a mask.
    if mask.shape != (num,) or mask.dtype != jnp.bool_:
        raise InputError(f"valid must be [{num}] bool, got {mask.dtype} of shape {mask.shape}")
    if not is_traced(points_world, rgb, camera_position, focal, mask):
        _check_values(points_world, rgb, camera_position, focal, np.asarray(mask))
    # Chunks of no points would divide by zero.
    if num == 0:
        return state
    rgb = rgb.astype(jnp.float32)
    return _integrate_points(state, points_world, rgb, camera_position, focal, mask)


def _check_shapes(points: Array, rgb: Array, camera_position: Array, focal: Array) -> None:
    if focal.ndim != 0:
        raise InputError(f"focal must be one number [px], got shape {focal.shape}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points_world must have shape [M, 3], got {points.shape}")
    if rgb.shape != points.shape:
        raise InputError(f"rgb must have the points' shape {points.shape}, got {rgb.shape}")
    if not jnp.issubdtype(rgb.dtype, jnp.floating):
        raise InputError(f"rgb must be float32 in [0, 1], got {rgb.dtype}: divide by 255 first")
    if camera_position.shape not in ((3,), points.shape):
        raise InputError(
            f"camera_position must have shape [3] or the points' {points.shape}, got "
            f"{camera_position.shape}"
        )


def _check_values(
    points: Array, rgb: Array, camera_position: Array, focal: Array, valid: np.ndarray
) -> None:
    is_bad = valid & ~np.isfinite(np.asarray(points)).all(axis=1)
    if is_bad.any():
        raise InputError(
            f"{is_bad.sum()} of {len(is_bad)} points are not finite, the first is number "
            f"{int(is_bad.argmax())}: leave out points without a measurement"
        )
    # Padding may hold anything: only what counts is checked.
    colors = np.asarray(rgb)[valid]
    if colors.size and not (colors.min() >= 0.0 and colors.max() <= 1.0):
        raise InputError(
            f"rgb must lie in [0, 1], got values from {colors.min():.4g} to {colors.max():.4g}"
        )
    positions = np.asarray(camera_position)
    used = positions[valid] if positions.ndim == 2 else positions[None]
    is_bad = ~np.isfinite(used).all(axis=1)
    if is_bad.any():
        raise InputError(f"camera_position is not finite: {used[is_bad.argmax()]}")
    if not (np.isfinite(float(focal)) and float(focal) > 0.0):
        raise InputError(f"focal must be positive [px], got {float(focal)}")
