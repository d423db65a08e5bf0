"""The direction-aware voxel map: what has been seen, from where, and how consistently.

The map is a fixed-capacity hash table; row `i` describes one occupied voxel. The long axis of
arrays is last, because XLA vectorizes over it on CPUs.

Shape symbols used throughout the package:
    N  capacity of the table       M  observations of one frame
    B  direction bins              W  32-bit words that hold B bits
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt32

from r3jax.errors import InputError
from r3jax.geometry.arguments import one
from r3jax.geometry.voxels import EMPTY_WORD, unpack, voxel_center
from r3jax.kernels.calls import MapRows
from r3jax.visibility.depth_buffer import Voxels


class MapState(eqx.Module):
    """The state of the map: 40 bytes per row, 41 if voxels may be removed.

    Invariants: `m2 >= 0`; a bin once visited stays visited; `dropped` never decreases; a key
    occurs once.
    """

    key: UInt32[Array, "2 N"]
    """Packed voxel index (`geometry.voxels.pack`); all ones where the row is empty."""

    visited: UInt32[Array, "W N"]
    """Bit `k % 32` of word `k // 32` is set once the voxel was seen from direction bin k."""

    count: Float[Array, " N"]
    """Observations merged into the voxel: frames that saw it."""

    mean: Float[Array, "3 N"]
    """Mean RGB over the observations, in [0, 1]."""

    m2: Float[Array, " N"]
    """Sum over the observations and the channels of squared deviations from `mean`: tr(M)."""

    resolution: Float[Array, " N"]
    """Best resolution so far, focal length over distance [px/m]."""

    voxel_size: Float[Array, ""]
    """Edge of a voxel [m]."""

    dropped: Int[Array, ""]
    """Number of observations dropped because the table was full. Never decreases."""

    num_bins: int = eqx.field(static=True)
    """Direction bins B."""

    misses: UInt8[Array, " N"] | None = None
    """Frames that saw through the voxel since it was last measured (`mapping.moved`); None: no
    voxel is ever removed."""

    @property
    def capacity(self) -> int:
        """Number of rows N."""
        return self.count.shape[-1]

    # Jitted: loops call these outside jit, where every operation would be a program.
    @property
    @jax.jit
    def occupied(self) -> Bool[Array, " N"]:
        """True for rows in use, including those of removed voxels."""
        # One word suffices: the top bit of a packed key's high word is 0.
        return self.key[1] != jnp.uint32(EMPTY_WORD)

    @property
    def present(self) -> Bool[Array, " N"]:
        """True for rows that describe a voxel, neither removed nor padding."""
        return self.count > 0.0

    @property
    @jax.jit
    def center(self) -> Float[Array, "3 N"]:
        """Centers of the voxels [m]; undefined in unused rows."""
        return voxel_center(jnp.stack(unpack(self.key[0], self.key[1])), self.voxel_size)

    def center_of(self, row: Int[Array, " n"]) -> Float[Array, "3 n"]:
        """Computes the centers of the voxels in some rows [m]."""
        low, high = self.key[0, row], self.key[1, row]
        return voxel_center(jnp.stack(unpack(low, high)), self.voxel_size)

    def take(self, row: Int[Array, " n"], valid: Bool[Array, " n"]) -> "MapState":
        """Gathers rows into a smaller map for scoring. It has no hash table for lookups.

        Args:
            row: which rows.
            valid: False for rows that are to be empty.
        """
        return replace(
            self,
            key=self.key[:, row],
            visited=self.visited[:, row],
            count=jnp.where(valid, self.count[row], 0.0),
            mean=self.mean[:, row],
            m2=self.m2[row],
            resolution=self.resolution[row],
            misses=None if self.misses is None else self.misses[row],
        )

    @property
    def rows(self) -> MapRows:
        """The arrays that R depends on, as kernels take them."""
        return MapRows(
            self.key, self.visited, self.count, self.m2, self.resolution, self.voxel_size
        )

    @property
    def voxels(self) -> Voxels:
        """The voxels of rows that were seen, as kernels take them."""
        return Voxels(self.center, self.present, self.voxel_size)

    @property
    @jax.jit
    def num_occupied(self) -> Int[Array, ""]:
        """Number of rows in use."""
        return jnp.sum(self.occupied, dtype=jnp.int32)

    @property
    @jax.jit
    def num_present(self) -> Int[Array, ""]:
        """Number of voxels."""
        return jnp.sum(self.present, dtype=jnp.int32)

    @property
    def bytes_per_row(self) -> int:
        """Memory of one row [bytes]."""
        rows = (self.key, self.visited, self.count, self.mean, self.m2, self.resolution)
        misses = 0 if self.misses is None else self.misses.nbytes
        return (sum(x.nbytes for x in rows) + misses) // self.capacity


a_map = one(MapState, "r3jax.empty_map makes one", leaf="count", ndim=1)


def empty_map(
    capacity: int = 1 << 17,
    voxel_size: float | int = 0.05,
    num_bins: int = 64,
    *,
    remove_moved: bool = False,
) -> MapState:
    """Makes a map without any observation.

    Args:
        capacity: rows of the table; a power of two.
        voxel_size: edge of a voxel [m].
        num_bins: direction bins per voxel.
        remove_moved: remove voxels that frames see through, such as a person who has walked on;
            one byte a row.

    Raises:
        ValueError: a capacity that is not a power of two, a size that is not positive and
            finite, no bins.
    """
    if capacity < 2 or capacity & (capacity - 1):
        raise InputError(f"capacity must be a power of two >= 2, got {capacity}")
    if not 0.0 < voxel_size < float("inf"):
        raise InputError(f"voxel_size must be positive and finite [m], got {voxel_size}")
    if num_bins < 1:
        raise InputError(f"num_bins must be at least 1, got {num_bins}")
    return _empty_map(capacity, float(voxel_size), num_bins, remove_moved)


@partial(jax.jit, static_argnums=(0, 2, 3))
def _empty_map(
    capacity: int, voxel_size: Float[Array, ""], num_bins: int, remove_moved: bool
) -> MapState:
    num_words = -(-num_bins // 32)
    return MapState(
        key=jnp.full((2, capacity), EMPTY_WORD, dtype=jnp.uint32),
        visited=jnp.zeros((num_words, capacity), dtype=jnp.uint32),
        count=jnp.zeros(capacity, dtype=jnp.float32),
        mean=jnp.zeros((3, capacity), dtype=jnp.float32),
        m2=jnp.zeros(capacity, dtype=jnp.float32),
        resolution=jnp.zeros(capacity, dtype=jnp.float32),
        voxel_size=jnp.asarray(voxel_size, dtype=jnp.float32),
        dropped=jnp.zeros((), dtype=jnp.int32),
        num_bins=num_bins,
        misses=jnp.zeros(capacity, dtype=jnp.uint8) if remove_moved else None,
    )
