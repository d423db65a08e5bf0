"""Finds the rows of points in the map."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r3jax.geometry.arguments import checked, points_of_3
from r3jax.geometry.voxels import pack, voxel_index
from r3jax.mapping.state import MapState, a_map
from r3jax.mapping.table import find


@checked(state=a_map, points_world=points_of_3)
@jax.jit
def lookup(state: MapState, points_world: Float[Array, "*n 3"]) -> Int[Array, "*n"]:
    """Finds the row of the voxel that contains each point; `state.capacity` if there is none.

    Args:
        state: the map.
        points_world: points [m]; points that are not finite are in no voxel.

    Raises:
        TypeError: not a map, or not an array.
        ValueError: points without three coordinates.
    """
    points = points_world.reshape(-1, 3)
    # A voxel size of NaN marks a map spoiled by an invalid pose: nothing is found in it.
    is_finite = jnp.all(jnp.isfinite(points), axis=1) & jnp.isfinite(state.voxel_size)
    # NaN has no integer: such points look up voxel 0, and the result is masked.
    index = voxel_index(jnp.where(is_finite[:, None], points, 0.0), state.voxel_size)
    low, high = pack(index[:, 0], index[:, 1], index[:, 2])
    row = find(state.key, jnp.stack([low, high]), is_finite)
    return row.reshape(points_world.shape[:-1])
