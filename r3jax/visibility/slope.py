"""How far behind a depth buffer a voxel still belongs to the surface in it.

Shape symbols: h w size of the buffer.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

STRIDES = (1, 2, 4)
"""Steps over which the slope is taken [px]. A voxel near by covers several pixels at one
distance, so that the slope from pixel to pixel is 0 on most of a tilted wall."""

MAX_STRETCH = 6.0
"""The allowance grows at most by this factor: surfaces seen at 80 degrees from their normal."""

FAR = 1e4
"""Stands for "nothing there", so that differences stay finite [m]."""


def surface_limit(
    distance: Float[Array, "h w"],
    pixel_angle: float | Float[Array, ""],
    allowance: Float[Array, ""],
) -> Float[Array, "h w"]:
    """Distance up to which voxels count as the surface in the buffer, not as behind it [m].

    On a surface at angle a to the line of sight, voxels that lie one behind the other across it
    are 1 / cos(a) as far apart along the line: the allowance is stretched by that. It stays the
    same measured across the surface, so what stands behind a wall is not let through, however
    obliquely the wall is seen.

    Args:
        distance: the buffer [m]; inf where there is nothing.
        pixel_angle: angle that a pixel covers [rad].
        allowance: depth of the surface across itself [m].
    """
    capped = jnp.minimum(distance, FAR)
    # Beyond the border the buffer is continued in a straight line.
    padded = jnp.pad(capped, max(STRIDES), mode="reflect", reflect_type="odd")
    squared = jnp.zeros_like(distance)
    for axis in (0, 1):
        steepest = jnp.zeros_like(distance)
        for step in STRIDES:
            steepest = jnp.maximum(steepest, _slope(capped, padded, step, axis))
        squared = squared + steepest * steepest
    # Meters of depth per pixel, over the meters that a pixel spans there.
    tangent = jnp.sqrt(squared) / (pixel_angle * jnp.maximum(capped, 1e-6))
    # 1 / cos a = sqrt(1 + tan^2 a); uncapped, a wall seen edge on would hide nothing.
    stretch = jnp.minimum(jnp.sqrt(1.0 + tangent * tangent), MAX_STRETCH)
    # On the uncapped distance: where there is nothing, the limit stays infinite.
    return distance + allowance * stretch


def _slope(
    distance: Float[Array, "h w"], padded: Float[Array, "hp wp"], step: int, axis: int
) -> Float[Array, "h w"]:
    """Change per pixel on the flatter side of each pixel [m/px]; 0 where the sides disagree.

    So neither a silhouette nor a ragged edge counts as a slope.
    """
    margin = max(STRIDES)
    height, width = distance.shape

    def moved(shift: int) -> Float[Array, "h w"]:
        row, column = margin + shift * (axis == 0), margin + shift * (axis == 1)
        return padded[row : row + height, column : column + width]

    before, after = distance - moved(-step), moved(step) - distance
    flatter = jnp.minimum(jnp.abs(before), jnp.abs(after)) / step
    return jnp.where(before * after > 0.0, flatter, 0.0)
