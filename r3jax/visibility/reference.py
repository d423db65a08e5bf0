"""What a view sees of a map, of all voxels at once: the plain form of `depth_buffer`.

Shape symbols: n voxels; m points; h w pixels of the buffer.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.compaction import SPARE
from r3jax.mapping.state import MapState
from r3jax.visibility.config import VisibilityConfig
from r3jax.visibility.depth_buffer import corner_margin, is_in_view, is_visible
from r3jax.visibility.footprint import footprint, pyramid
from r3jax.visibility.slope import surface_limit
from r3jax.visibility.views import View


def nearest_voxels(voxels: MapState, view: View) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """Splats all voxels into an image pyramid: the nearest in every pixel, the first of equals.

    Returns:
        Its distance from the camera [m] and its row; inf and n where there is none.
    """
    voxels = jax.lax.stop_gradient(voxels)
    shapes = pyramid(view.shape)
    offsets = [0]
    for height, width in shapes:
        offsets.append(offsets[-1] + height * width)
    place = view.place(voxels.center)
    num = voxels.capacity
    valid = voxels.present & place.ahead & (place.distance <= view.max_range)
    targets = footprint(place, valid, voxels.voxel_size, shapes, offsets, wraps=view.wraps)
    distances = jnp.full(offsets[-1] + SPARE, jnp.inf)
    for target in targets:
        distances = distances.at[target].min(place.distance)
    rows = jnp.full(offsets[-1] + SPARE, num, dtype=jnp.int32)
    for target in targets:
        is_nearest = valid & (place.distance == distances[target])
        rows = rows.at[target].min(jnp.where(is_nearest, jnp.arange(num, dtype=jnp.int32), num))
    distance, row = jnp.full((1, 1), jnp.inf), jnp.full((1, 1), num, dtype=jnp.int32)
    for (height, width), begin in zip(shapes[::-1], offsets[-2::-1], strict=True):
        # A voxel on a coarse level covers four pixels of the next.
        distance, row = (_doubled(x)[:height, :width] for x in (distance, row))
        own = slice(begin, begin + height * width)
        near, first = distances[own].reshape(height, width), rows[own].reshape(height, width)
        is_own = (near < distance) | ((near == distance) & (first < row))
        distance, row = jnp.where(is_own, near, distance), jnp.where(is_own, first, row)
    return distance, row


def _doubled(image: Array) -> Array:
    return jnp.repeat(jnp.repeat(image, 2, axis=0), 2, axis=1)


def visible(
    voxels: MapState, points: Float[Array, "3 m"], view: View, config: VisibilityConfig
) -> tuple[Bool[Array, " n"], Bool[Array, " m"]]:
    """Finds the voxels that a view sees, and the points in empty space that nothing hides."""
    voxels, points = jax.lax.stop_gradient((voxels, points))
    distance, _ = nearest_voxels(voxels, view)
    limit = surface_limit(distance, view.pixel_angle, config.tolerance * voxels.voxel_size)
    place = view.place(voxels.center)
    margin = corner_margin(view, place, voxels.voxel_size, limit)
    seen = voxels.present & is_in_view(view, place) & (margin >= 0.0)
    return seen, is_visible(view, view.place(points), distance)
