"""Joins statistics per voxel into the map: unites bins, adds moments, keeps the best resolution.

A frame, another map and a smaller table are all statistics per voxel, merged by one rule.

Shape symbols: N capacity; M rows of new statistics; W words of bins.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt32

from r3jax.errors import InputError
from r3jax.geometry.arguments import checked
from r3jax.geometry.cameras import is_traced
from r3jax.kernels.constants import JOINED
from r3jax.mapping.state import MapState, a_map, empty_map
from r3jax.mapping.table import find_or_insert


class Statistics(eqx.Module):
    """Statistics of some distinct voxels, to be joined into a map."""

    key: UInt32[Array, "2 M"]
    """Packed voxel index."""

    valid: Bool[Array, " M"]
    """False for padding."""

    count: Float[Array, " M"]
    """Observations."""

    mean: Float[Array, "3 M"]
    """Mean RGB of the observations."""

    m2: Float[Array, " M"]
    """Sum of squared deviations over observations and channels."""

    visited: UInt32[Array, "W M"]
    """Direction bins."""

    resolution: Float[Array, " M"]
    """Best resolution [px/m]."""

    misses: UInt8[Array, " M"] | None = None
    """Number of frames that saw through each voxel; None for observations."""


Moments = tuple[Float[Array, " M"], Float[Array, "3 M"], Float[Array, " M"]]
"""Observations, mean RGB, and sum of squared deviations, per voxel."""


def combine_moments(a: Moments, b: Moments) -> Moments:
    """Merges the moments of two sets of observations (Chan, Golub & LeVeque 1983).

        d    = mean_b - mean_a
        n    = n_a + n_b
        mean = mean_a + d n_b / n
        M2   = M2_a + M2_b + |d|^2 n_a n_b / n

    For a single observation (n_b = 1, M2_b = 0) this is Welford's update, Algorithm 2 of
    arXiv 2601.07484. The result does not depend on the order beyond rounding.
    """
    (n_a, mean_a, m2_a), (n_b, mean_b, m2_b) = a, b
    n = n_a + n_b
    # Padding has n = 0 on both sides, which must not give NaN.
    weight = n_b / jnp.maximum(n, 1.0)
    # About the means: sums of squares minus squared sums would cancel in float32.
    d = mean_b - mean_a
    return n, mean_a + d * weight[None, :], m2_a + m2_b + jnp.sum(d * d, axis=0) * n_a * weight


def join(state: MapState, new: Statistics) -> MapState:
    """Merges statistics into the map (arXiv 2601.07484, Algorithms 1 and 2).

    Bins unite, the best resolution wins, and moments are combined.
    """
    key, row = find_or_insert(state.key, new.key, new.valid)
    # Padding and dropped voxels have row N: they read zeros here, and `put` ignores them.
    at: Callable[[Array], Array] = lambda x: x.at[..., row].get(mode="fill", fill_value=0)

    def put(x: Array, value: Array) -> Array:
        return x.at[..., row].set(value, mode="drop")  # rows are distinct

    # New rows read zeros here: an empty row has zero moments, so joining is inserting.
    before = at(state.count), at(state.mean), at(state.m2)
    # The row of a removed voxel stays in the table; its statistics are reset.
    is_known = before[0] > 0.0
    bins = jnp.where(is_known[None, :], at(state.visited), jnp.uint32(0))
    sharpness = jnp.where(is_known, at(state.resolution), 0.0)
    count, mean, m2 = combine_moments(before, (new.count, new.mean, new.m2))
    # Counted, not raised: nothing can be raised under jit.
    is_lost = new.valid & (row >= state.capacity)
    return MapState(
        key=key,
        visited=put(state.visited, bins | new.visited),
        count=put(state.count, count),
        mean=put(state.mean, mean),
        m2=put(state.m2, m2),
        resolution=put(state.resolution, jnp.maximum(sharpness, new.resolution)),
        voxel_size=state.voxel_size,
        dropped=state.dropped + jnp.sum(is_lost, dtype=jnp.int32),
        num_bins=state.num_bins,
        misses=_joined_misses(state, new, row, is_known),
    )


def _joined_misses(
    state: MapState, new: Statistics, row: Int[Array, " M"], is_known: Bool[Array, " M"]
) -> UInt8[Array, " N"] | None:
    """Computes the frames that saw through each row: the minimum if both maps have the voxel."""
    if state.misses is None or new.misses is None:
        return state.misses
    before = state.misses.at[row].get(mode="fill", fill_value=0)
    fewer = jnp.where(is_known, jnp.minimum(before, new.misses), new.misses)
    return state.misses.at[row].set(fewer, mode="drop")


@jax.jit
def _join_map(state: MapState, other: MapState) -> MapState:
    """Joins every row of `other`, in chunks: scratch memory does not grow with the map."""
    # Both are powers of two: whole chunks cover the table, and no slice is shifted back.
    size = min(JOINED, other.capacity)

    def join_chunk(i: Int[Array, ""], state: MapState) -> MapState:
        def rows(x: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(x, i * size, size, axis=-1)

        return join(
            state,
            Statistics(
                key=rows(other.key),
                # Rows of removed voxels are not copied.
                valid=rows(other.present),
                count=rows(other.count),
                mean=rows(other.mean),
                m2=rows(other.m2),
                visited=rows(other.visited),
                resolution=rows(other.resolution),
                misses=None if other.misses is None else rows(other.misses),
            ),
        )

    state = jax.lax.fori_loop(0, other.capacity // size, join_chunk, state)
    # Voxels that `other` dropped are missing from the union, too.
    return eqx.tree_at(lambda m: m.dropped, state, state.dropped + other.dropped)


@checked(a=a_map, b=a_map)
def merge(a: MapState, b: MapState) -> MapState:
    """Merges the observations of `a` and `b` into one map, in a table of `a`'s capacity.

    Exact: equal to integrating both sequences into one map, up to rounding and row order. Voxels
    beyond the capacity are dropped and counted in `dropped`; grow `a` first if both are large.

    Raises:
        ValueError: voxel sizes or numbers of bins that differ.
    """
    if a.num_bins != b.num_bins:
        raise InputError(f"the maps have {a.num_bins} and {b.num_bins} direction bins")
    # Different lattices cannot be joined exactly.
    sizes = (a.voxel_size, b.voxel_size)
    if not is_traced(*sizes) and float(sizes[0]) != float(sizes[1]):
        raise InputError(f"the maps have voxels of {float(sizes[0])} m and {float(sizes[1])} m")
    return _join_map(a, b)


@checked(state=a_map)
def grow(state: MapState, capacity: int) -> MapState:
    """Copies the map into a larger table. Not to be called under jit: shapes change.

    Raises:
        ValueError: a capacity that is not a power of two or smaller than the present one.
    """
    if capacity < state.capacity:
        raise InputError(f"cannot shrink a map of {state.capacity} rows to {capacity}")
    remove_moved = state.misses is not None
    larger = empty_map(capacity, float(state.voxel_size), state.num_bins, remove_moved=remove_moved)
    # Bit-identical: a rounded voxel size would move voxel borders.
    larger = eqx.tree_at(lambda m: m.voxel_size, larger, state.voxel_size)
    return _join_map(larger, state)
