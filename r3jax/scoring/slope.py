"""How far behind a depth buffer a voxel still belongs to the surface in it.

Shape symbols: h w size of the buffer.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_STRIDES = (1, 2, 4)
"""Steps over which the slope is taken [px]. A voxel near by covers several pixels at one
distance, so that the slope from pixel to pixel is 0 on most of a tilted wall."""

_MAX_STRETCH = 6.0
"""The allowance grows at most by this factor: surfaces seen at 80 degrees from their normal."""

_FAR = 1e4
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
    capped = jnp.minimum(distance, _FAR)
    squared = jnp.zeros_like(distance)
    for axis in (0, 1):
        slopes = [_slope(capped, step, axis) for step in _STRIDES if step < distance.shape[axis]]
        for slope in slopes[1:]:
            slopes[0] = jnp.maximum(slopes[0], slope)
        if slopes:
            squared = squared + slopes[0] * slopes[0]
    tangent = jnp.sqrt(squared) / (pixel_angle * jnp.maximum(capped, 1e-6))
    stretch = jnp.minimum(jnp.sqrt(1.0 + tangent * tangent), _MAX_STRETCH)
    return distance + allowance * stretch


def _slope(distance: Float[Array, "h w"], step: int, axis: int) -> Float[Array, "h w"]:
    """Change per pixel on the flatter side of each pixel [m/px]; 0 where the sides disagree.

    So neither a silhouette nor a ragged edge counts as a slope. Beyond the border the buffer is
    continued in a straight line.
    """
    widths = [(step, step) if i == axis else (0, 0) for i in range(2)]
    padded = jnp.pad(distance, widths, mode="reflect", reflect_type="odd")
    n = distance.shape[axis]
    part = lambda first: jax.lax.slice_in_dim(padded, first, first + n, axis=axis)
    before, after = distance - part(0), part(2 * step) - distance
    flatter = jnp.minimum(jnp.abs(before), jnp.abs(after)) / step
    return jnp.where(before * after > 0.0, flatter, 0.0)
