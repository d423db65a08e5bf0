"""Points, integer voxels and packed keys.

A voxel index is three signed integers of 21 bits each, packed into two 32-bit words; at 5 cm
that is a world of 100 km. float32 ends sooner: coordinates of UTM would be rounded to half a meter.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from r3jax.errors import InputError

INDEX_LIMIT = 1 << 20
"""Voxel indices lie in [-INDEX_LIMIT, INDEX_LIMIT)."""

MAX_COORDINATE = float(1 << 15)
"""Largest coordinate [m]; beyond it float32 steps exceed 2 mm."""

EMPTY_WORD = 0xFFFFFFFF
"""Both words of an empty row. No voxel packs to it: the top bit of a packed key is 0."""


def check_near_origin(name: str, points: np.ndarray, limit: float = MAX_COORDINATE) -> None:
    """Refuses points [..., 3] too far from the origin for float32, or for a voxel's index.

    Raises:
        ValueError: names the largest coordinate, and what to do.
    """
    largest = float(np.abs(points).max(initial=0.0))
    if largest > limit:
        rows = np.asarray(points, np.float64).reshape(-1, 3)
        farthest = rows[np.argmax(np.abs(rows).max(axis=1))]
        origin = np.where(np.abs(farthest) > limit, np.round(farthest, -3), 0.0)
        raise InputError(
            f"{name} has the coordinate {largest:,.0f} m, the limit is {limit:,.0f} m: subtract an "
            f"origin near the cameras, such as {origin.tolist()}, from all coordinates, in "
            "float64; leave out a frame whose pose alone is so far away"
        )


def voxel_index(
    coordinates: Float[Array, "..."], voxel_size: Float[Array, ""]
) -> Int[Array, "..."]:
    """Computes the index of the voxel along each coordinate, floor(p / size).

    Voxel 0 spans [0, size).
    """
    # Truncation would make the voxel at 0 twice as wide, reaching to both sides.
    index = jnp.floor(coordinates / voxel_size)
    limit = float(INDEX_LIMIT)
    # Clipped before the cast: an index of more than 21 bits would spill into its neighbor's bits.
    return jnp.clip(index, -limit, limit - 1.0).astype(jnp.int32)


def voxel_center(index: Int[Array, "..."], voxel_size: Float[Array, ""]) -> Float[Array, "..."]:
    """Computes the center of the voxel along each coordinate [m]."""
    return (index.astype(jnp.float32) + 0.5) * voxel_size


def pack(
    x: Int[Array, "*n"], y: Int[Array, "*n"], z: Int[Array, "*n"]
) -> tuple[UInt32[Array, "*n"], UInt32[Array, "*n"]]:
    """Packs a voxel index into two words (low, high): 21 bits each of x, y and z."""
    # Shifted to be non-negative: no sign bits to spread over the other fields.
    ux = (x + INDEX_LIMIT).astype(jnp.uint32)
    uy = (y + INDEX_LIMIT).astype(jnp.uint32)
    uz = (z + INDEX_LIMIT).astype(jnp.uint32)
    # y straddles the words, 11 bits in the low one and 10 in the high one; the top bit stays 0.
    low = ux | (uy << 21)
    high = (uy >> 11) | (uz << 10)
    return low, high


def unpack(
    low: UInt32[Array, "*n"], high: UInt32[Array, "*n"]
) -> tuple[Int[Array, "*n"], Int[Array, "*n"], Int[Array, "*n"]]:
    """Unpacks the indices from a key: the inverse of `pack`.

    The indices of empty rows are undefined.
    """
    mask21 = jnp.uint32((1 << 21) - 1)
    ux = low & mask21
    uy = (low >> 21) | ((high & jnp.uint32((1 << 10) - 1)) << 11)
    uz = (high >> 10) & mask21
    signed: Callable[[Array], Array] = lambda u: u.astype(jnp.int32) - INDEX_LIMIT
    return signed(ux), signed(uy), signed(uz)
