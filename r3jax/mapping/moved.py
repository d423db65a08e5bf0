"""Removes voxels that later frames see through: people who have moved on, and outliers.

A frame sees through a voxel if every pixel of the voxel's footprint measures something behind it,
by more than the noise of the depth. All of the footprint must agree, because a cable fills only a
part of it, and a pane of glass is measured in only some of its pixels. Holes are no evidence. Nor
are frames more than three times as far away as the closest one, or frames in which a voxel is
smaller than 1.5 pixels. Frames that see through a voxel are counted; a frame that measures a point
in it resets the count. After two such frames (three, if more than two frames had measured the
voxel) it is removed: its row stays in the table without observations, and is used again when the
voxel is measured. Costs one byte per row.

Shape symbols: N capacity of the map; H W image size; L levels of the minima.
"""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.frame import Frame
from r3jax.kernels import constants
from r3jax.mapping.seen import project_rows
from r3jax.mapping.state import MapState


def count_misses(state: MapState, frame: Frame, max_range: Float[Array, ""]) -> MapState:
    """Counts the frames that see through each voxel, and removes voxels with enough of them.

    Args:
        state: the map, after the frame's pixels were added; returned unchanged if it has no counts.
        frame: the frame.
        max_range: voxels farther from the camera are ignored [m].
    """
    if state.misses is None:
        return state
    is_confirmed, is_missed = judge_rows(state, frame, max_range)
    misses = jnp.where(is_confirmed, 0, state.misses + is_missed.astype(jnp.uint8))
    limit = jnp.where(
        state.count <= constants.FEW_OBSERVATIONS, constants.MISSES_OF_FEW, constants.MISSES
    )
    is_removed = is_missed & (misses >= limit)
    return replace(
        state,
        count=jnp.where(is_removed, 0.0, state.count),
        mean=jnp.where(is_removed[None, :], 0.0, state.mean),
        m2=jnp.where(is_removed, 0.0, state.m2),
        misses=jnp.where(is_removed, 0, misses).astype(jnp.uint8),
    )


def judge_rows(
    state: MapState, frame: Frame, max_range: Float[Array, ""]
) -> tuple[Bool[Array, " N"], Bool[Array, " N"]]:
    """Finds the voxels in which a frame measures a point, and those that it sees through."""
    camera, size = frame.camera, state.voxel_size
    is_in, z, row, column = project_rows(state, frame, max_range)
    is_in &= state.present
    # Masked rows may be anywhere; their depth is not used.
    z = jnp.maximum(z, 1e-3)
    slack = constants.SLACK_EDGES * size + constants.SLACK_NOISE * z
    measured = frame.depth[row, column]
    is_confirmed = is_in & (measured > 0.0) & (jnp.abs(measured - z) <= slack)
    sharpness = camera.focal / z
    is_close = sharpness >= constants.NEAR_ENOUGH * state.resolution
    is_close &= sharpness * size >= constants.LEAST_FOOTPRINT
    reach = jnp.maximum(camera.fx, camera.fy) * constants.HALF_DIAGONAL * size / z
    half = jnp.ceil(jnp.clip(reach, 0.0, constants.MOST_HALF)).astype(jnp.int32) + 1
    nearest = _nearest_around(frame.depth, row, column, half)
    return is_confirmed, is_in & (measured > z + slack) & is_close & (nearest > z + slack)


def _nearest_around(
    depth: Float[Array, "H W"],
    row: Int[Array, " N"],
    column: Int[Array, " N"],
    half: Int[Array, " N"],
) -> Float[Array, " N"]:
    """Computes the minimum depth in a square of 2 half + 1 pixels; 0 if it leaves the image."""
    height, width = depth.shape
    is_in = (half <= constants.MOST_HALF) & (row >= half) & (column >= half)
    is_in &= (row + half < height) & (column + half < width)
    # Minima of squares of 1, 2, 4, ... pixels; four of them cover any square exactly.
    minima = [depth]
    while 2 << len(minima) <= 2 * constants.MOST_HALF + 2:
        step = 1 << (len(minima) - 1)
        wide = jnp.pad(minima[-1], ((0, step), (0, step)), constant_values=jnp.inf)
        rows = jnp.minimum(wide[:height], wide[step : height + step])
        minima.append(jnp.minimum(rows[:, :width], rows[:, step : width + step]))
    levels = jnp.stack(minima)
    side = 2 * jnp.where(is_in, half, 0) + 1
    level = jnp.sum(side[:, None] >= 2 ** jnp.arange(1, len(minima))[None, :], axis=1)
    top, left = row - side // 2, column - side // 2
    bottom, right = top + side - 2**level, left + side - 2**level
    corners = [levels[level, r, c] for r in (top, bottom) for c in (left, right)]
    nearest = jnp.minimum(jnp.minimum(*corners[:2]), jnp.minimum(*corners[2:]))
    return jnp.where(is_in, nearest, 0.0)
