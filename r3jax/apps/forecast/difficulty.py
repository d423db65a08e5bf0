"""How hard a surface is to render: the contrast of its colors, in closed form from the map's rows.

A plain wall renders well from anywhere, a bookshelf needs every direction. The map knows which is
which: its voxels are about as large as the pixels that saw them, and hold mean colors.

Shape symbols: N rows of the map; n of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.geometry.arguments import checked
from r3jax.geometry.numerics import safe_power
from r3jax.geometry.voxels import pack, unpack
from r3jax.mapping.state import MapState, a_map
from r3jax.mapping.table import find

AROUND = np.array(
    [
        (x, y, z)
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
        for z in (-1, 0, 1)
        if (x, y, z) != (0, 0, 0)
    ]
)
"""Offsets of the 26 voxels that touch a voxel, [26, 3]."""


@checked(state=a_map)
@jax.jit
def voxel_difficulty(state: MapState) -> Float[Array, " N"]:
    """Averages the color contrast between every voxel and those that touch it.

    The root of the mean, over the seen ones among its 26 neighbors and the three channels, of the
    squared difference of the mean colors: 0 for a plain wall, 0.1 to 0.2 for a bookshelf, at most
    1. It needs no bytes of its own: maps that merge give that of the merged map. Rows that
    describe no voxel, and voxels without a neighbor, have 0.
    """
    return difficulty_of_rows(state, jnp.arange(state.capacity, dtype=jnp.int32))


def difficulty_of_rows(state: MapState, row: Int[Array, " n"]) -> Float[Array, " n"]:
    """Returns `voxel_difficulty` of some rows; 0 for row N, which is none."""
    is_there = row < state.capacity
    at = jnp.where(is_there, row, 0)
    is_there &= state.present[at]
    own = state.mean[:, at]
    x, y, z = unpack(state.key[0, at], state.key[1, at])

    def add(
        sums: tuple[Float[Array, " n"], Float[Array, " n"]], step: Int[Array, " 3"]
    ) -> tuple[tuple[Float[Array, " n"], Float[Array, " n"]], None]:
        squares, number = sums
        low, high = pack(x + step[0], y + step[1], z + step[2])
        beside = find(state.key, jnp.stack([low, high]), is_there)
        # Absent neighbors have row N: they read a count of 0, and add nothing.
        is_seen = state.count.at[beside].get(mode="fill", fill_value=0.0) > 0.0
        color = state.mean.at[:, beside].get(mode="fill", fill_value=0.0)
        difference = jnp.mean((color - own) ** 2, axis=0)
        squares = squares + jnp.where(is_seen, difference, 0.0)
        return (squares, number + is_seen.astype(jnp.float32)), None

    nothing = jnp.zeros(row.shape), jnp.zeros(row.shape)
    # One after the other: 26 searches at once would take 26 times the memory.
    (squares, number), _ = jax.lax.scan(add, nothing, jnp.asarray(AROUND, jnp.int32))
    # Exactly 0 on a plain wall, where the gradient of a plain root is infinite.
    return safe_power(squares / jnp.maximum(number, 1.0), jnp.asarray(0.5))
