"""Removes voxels that later frames see through: people who have moved on, and outliers.

A frame sees through a voxel if more than half of the voxel's footprint, its center included,
measures something behind it, by more than the noise of the depth, and the rest tells nothing
against it: it lies beyond the image's border, or behind something nearer. A single pixel that
measures the voxel's own depth speaks against it, because a cable fills only a part of it, and a
pane of glass is measured in only some of its pixels. So does a hole: around thin things depth
cameras often measure nothing. Nor do frames count that are more than three times as far away as the
closest one, or in which a voxel is smaller than 1.5 pixels. Frames that see through a voxel are
counted; a frame that measures a point in it resets the count. After two such frames (three, if more
than two frames had measured the voxel) it is removed: its row stays in the table without
observations, and is used again when the voxel is measured. Costs one byte per row.

What stays, then, is what no frame shows to be gone: voxels out of view or hidden, those before
holes, and those within two voxels, and the noise of the depth, of a surface.

Shape symbols: N capacity of the map; M rows at a time; S samples along a footprint; H W image size.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.frame import Frame
from r3jax.geometry.selection import for_selected
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
    half = jnp.ceil(jnp.maximum(camera.fx, camera.fy) * constants.HALF_DIAGONAL * size / z)
    half = half.astype(jnp.int32) + 1

    def judge(index: Int[Array, " M"], valid: Bool[Array, " M"], is_missed: Array) -> Array:
        found = _shows_behind(
            frame.depth, row[index], column[index], half[index], z[index], slack[index]
        )
        return is_missed.at[jnp.where(valid, index, state.capacity)].set(found, mode="drop")

    is_behind = is_in & (measured > z + slack) & is_close
    return is_confirmed, for_selected(is_behind, judge, jnp.zeros_like(is_behind))


def _shows_behind(
    depth: Float[Array, "H W"],
    row: Int[Array, " M"],
    column: Int[Array, " M"],
    half: Int[Array, " M"],
    z: Float[Array, " M"],
    slack: Float[Array, " M"],
) -> Bool[Array, " M"]:
    """Checks squares of 2 half + 1 pixels: most are beyond z, none is a hole or at z."""
    height, width = depth.shape
    step = 1 + 2 * half // constants.MOST_SAMPLES
    offset = step[:, None] * jnp.arange(constants.MOST_SAMPLES)[None, :] - half[:, None]
    j = column[:, None] + offset
    near, limit = (z - slack)[:, None], (z + slack)[:, None]

    def add(k: Int[Array, ""], counts: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        total, beyond, against = counts
        is_sample = (offset <= half[:, None]) & (offset[:, k] <= half)[:, None]
        i = (row + offset[:, k])[:, None]
        is_in = is_sample & (i >= 0) & (i < height) & (j >= 0) & (j < width)
        measured = depth[jnp.clip(i, 0, height - 1), jnp.clip(j, 0, width - 1)]
        is_beyond = is_in & (measured > limit)
        is_against = is_in & ~is_beyond & ~((measured > 0.0) & (measured < near))
        return (
            total + is_sample.sum(axis=1),
            beyond + is_beyond.sum(axis=1),
            against | is_against.any(axis=1),
        )

    zero = jnp.zeros(row.shape, jnp.int32)
    total, beyond, against = jax.lax.fori_loop(
        0, constants.MOST_SAMPLES, add, (zero, zero, zero > 0)
    )
    return ~against & (2 * beyond > total)
