"""Sightings of voxels that a frame looked at, but into which none of its pixels fell.

The map counts them as seen for every policy (`scoring.sighting`); without the same rule here the
noise in front of a surface would keep Active-GS looking for ever.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.frame import Frame
from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.seen import rows_in_view
from r3jax.mapping.state import MapState
from r3jax.planning.policies.active_gs.confidence import Sightings


@jax.jit
def glance(
    before: Sightings,
    touched: Sightings,
    state: MapState,
    frame: Frame,
    max_range: Float[Array, ""],
) -> Sightings:
    """Adds one sighting of every known voxel in view that the frame has not touched.

    Its normal is the one known so far: only pixels tell of normals.

    Args:
        before: the sightings before the frame, row by row those of the map (`aligned`).
        touched: the same after `see`.
        state: the map, the frame integrated.
        frame: the frame.
        max_range: d_max, the sensor's range [m].
    """
    # Whole numbers are exact in float32: an equal count means that no pixel fell in.
    is_new = rows_in_view(state, frame, max_range) & (touched.views == before.views)
    center = voxel_center(jnp.stack(unpack(state.key[0], state.key[1])), state.voxel_size)
    offset = frame.position[:, None] - center
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    direction = offset / distance[None, :]
    cosine = jnp.maximum(0.0, jnp.sum(touched.normal * direction, axis=0))
    weight = jnp.maximum(0.0, 1.0 - distance / max_range)
    add: Callable[[Array, Array | float], Array] = lambda x, more: x + jnp.where(is_new, more, 0.0)
    return Sightings(
        key=touched.key,
        views=add(touched.views, 1.0),
        direction_sum=touched.direction_sum + jnp.where(is_new[None, :], direction, 0.0),
        cosine_sum=add(touched.cosine_sum, weight * cosine),
        normal_sum=touched.normal_sum,
    )
