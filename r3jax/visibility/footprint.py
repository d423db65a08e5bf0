"""Which pixels a voxel covers: on a level of an image pyramid, at most 2x2 of them.

A near voxel so covers many pixels and a far one less than one, at the same cost. Walls have no
gaps: every voxel covers the pixel centers inside its own projection, and the projections of
neighbors meet.

Shape symbols: n voxels.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.compaction import spare_places
from r3jax.visibility.views import Placement, wrap

HALF_WIDTH = 0.51
"""Half an edge, and a little for rounding."""

NEAR = 0.25
"""The projection is linear in the position only nearly: added edges per edge / distance."""

SEAM = 0.6
"""Where a wall passes from one level to the next, pixel centers of the two do not interlock. Voxels
on the first fifth of a level therefore reach a quarter of a pixel farther: to the centers of the
finer pixels that theirs consist of."""


def pyramid(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Heights and widths of all levels, the finest first, each half of the one before."""
    shapes = [shape]
    while max(shapes[-1]) > 1:
        height, width = shapes[-1]
        # Rounded up: every pixel of the finer level needs a parent.
        shapes.append((-(-height // 2), -(-width // 2)))
    return shapes


def footprint(
    place: Placement,
    valid: Bool[Array, " n"],
    voxel_size: Float[Array, ""],
    shapes: list[tuple[int, int]],
    offsets: list[int],
    *,
    wraps: bool,
) -> list[Int[Array, " n"]]:
    """Indices into the pyramid of the pixels that each voxel covers; behind its end: none.

    The level is the first on which the footprint spans at most two pixel centers an axis. A
    footprint is the octagon round the projected cube.

    Args:
        place: where the voxels fall in the view.
        valid: False for voxels to leave out.
        voxel_size: edge of a voxel [m].
        shapes: of the pyramid's levels.
        offsets: where each level begins; one more for the end, behind which lie spare places.
        wraps: True for an octahedral map.
    """
    half = voxel_size * (HALF_WIDTH + NEAR * voxel_size / place.distance)
    widths = [2.0 * half * x for x in (place.column_scale, place.row_scale)]
    widest = jnp.maximum(jnp.maximum(widths[0], widths[1]), 1e-6)
    # Half the width before the logarithm: on its level a footprint is at most two pixels wide.
    level = jnp.clip(jnp.ceil(jnp.log2(0.5 * widest)), 0.0, len(shapes) - 1.0)
    scale = jnp.exp2(-level)
    level = level.astype(jnp.int32)
    table: Callable[[list[int]], Array] = lambda values: jnp.asarray(values, dtype=jnp.int32)[level]
    # Voxels side by side may lie on different levels, so sizes and offsets are gathered for each.
    height, width = table([s[0] for s in shapes]), table([s[1] for s in shapes])
    offset = table(offsets[:-1])
    begins_level = (level > 0) & (0.5 * widest * scale < SEAM)
    spread = jnp.where(begins_level, 0.25, 0.0)
    columns = _covered(place.column * scale, 0.5 * widths[0] * scale + spread)
    rows = _covered(place.row * scale, 0.5 * widths[1] * scale + spread)
    # The octagon's slanted sides: a cube seen at an edge does not fill its bounding rectangle.
    slanted = [half * w * scale + 2.0 * spread for w in (place.sum_scale, place.difference_scale)]
    nowhere = spare_places(offsets[-1], level.shape[0])
    indices: list[Int[Array, " n"]] = []
    for r, covers_row, down in rows:
        for c, covers_column, right in columns:
            # A far voxel may reach no pixel center at all, and must show in its own pixel still.
            is_own = (jnp.abs(right) <= 0.5) & (jnp.abs(down) <= 0.5)
            covers = (jnp.abs(right + down) <= slanted[0]) & (jnp.abs(right - down) <= slanted[1])
            is_in = valid & covers_row & covers_column & (covers | is_own)
            if wraps:
                r_in, c_in = wrap(r, c, height)
            else:
                is_in = is_in & (r >= 0) & (r < height) & (c >= 0) & (c < width)
                r_in, c_in = r, c
            indices.append(jnp.where(is_in, offset + r_in * width + c_in, nowhere))
    return indices


def _covered(
    middle: Float[Array, " n"], reach: Float[Array, " n"]
) -> list[tuple[Int[Array, " n"], Bool[Array, " n"], Float[Array, " n"]]]:
    """The two pixels round a coordinate, and whether `reach` covers each center, and its offset.

    The pixel that holds the coordinate is always covered.
    """
    # Clipped before it becomes an integer: far outside, int32 would wrap round.
    first = jnp.floor(jnp.clip(middle, -2.0, 1e6) - 0.5)
    reach = jnp.maximum(reach, 0.5)
    return [
        (pixel.astype(jnp.int32), jnp.abs(pixel + 0.5 - middle) <= reach, pixel + 0.5 - middle)
        for pixel in (first, first + 1.0)
    ]
