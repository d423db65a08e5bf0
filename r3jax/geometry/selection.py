"""Selects the items that a mask marks: running counts, indices, and loops in chunks.

XLA's `cumsum` on a CPU takes 1.5 ms for the pixels of a 512x512 image; a product with a
triangular matrix of ones takes a quarter of that and is exact below 2^24.

Shape symbols: n flags; M places; K items of a chunk.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from r3jax.errors import InputError

# Larger blocks cost more additions per element, smaller ones more levels of recursion.
_BLOCK = 64

SPARE = 64
"""Number of spare places behind an array, which take the dropped items of a scatter."""


def spare_places(size: int, num: int) -> Int[Array, " n"]:
    """Returns `num` indices of spare places after `size` others, for items that a scatter drops.

    On CPUs XLA bounds-checks every element; where the outcome is random, half of the branches are
    mispredicted, which costs more than the write. A write that is always in bounds costs nothing,
    and spreading the writes avoids waiting for the previous one.
    """
    return size + jnp.arange(num, dtype=jnp.int32) % SPARE


def running_count(flags: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Counts the set flags up to and including each place. n < 2^24."""
    # float32 has every integer up to 2^24; beyond, counts would be rounded.
    if flags.shape[0] >= 1 << 24:
        raise InputError(
            f"running_count is exact below 2^24 flags, got {flags.shape[0]}: a map of that size "
            "is held in tiles (MappingConfig(tiles=True))"
        )
    return _inclusive_sum(flags.astype(jnp.float32)).astype(jnp.int32)


def _inclusive_sum(x: Array) -> Array:
    n = x.shape[0]
    if n <= _BLOCK:
        return jnp.cumsum(x)
    rows = -(-n // _BLOCK)
    blocks = jnp.pad(x, (0, rows * _BLOCK - n)).reshape(rows, _BLOCK)
    triangle = jnp.asarray(np.triu(np.ones((_BLOCK, _BLOCK), dtype=np.float32)))
    # "highest": a GPU's reduced-precision products would count wrongly.
    within = jnp.matmul(blocks, triangle, precision="highest")
    # Inclusive minus own is the exclusive sum, without a shift that would have to be padded.
    before = _inclusive_sum(within[:, -1]) - within[:, -1]
    return (within + before[:, None]).reshape(-1)[:n]


def positions_of_set(flags: Bool[Array, " n"], size: int) -> Int[Array, " M"]:
    """Finds the indices of the first `size` set flags, in order; n pads.

    Like `jnp.nonzero(flags, size=size, fill_value=n)`, but faster.
    """
    n = flags.shape[0]
    # Set flags beyond `size` also go into the spare places, or are dropped.
    target = jnp.where(flags, running_count(flags) - 1, spare_places(size, n))
    empty = jnp.full(size + SPARE, n, dtype=jnp.int32)
    return empty.at[target].min(jnp.arange(n, dtype=jnp.int32), mode="drop")[:size]


CHUNK = 1 << 12
"""Chunk size of `for_selected`: a chunk fits in the cache of one core."""

Carry = TypeVar("Carry")


def for_selected(
    selected: Bool[Array, " n"],
    body: Callable[[Int[Array, " K"], Bool[Array, " K"], Carry], Carry],
    start: Carry,
) -> Carry:
    """Calls `body(index, valid, carry) -> carry` for the selected items, a chunk at a time.

    The cost depends on the number of selected items only. `index` holds places of selected items in
    increasing order; where `valid` is False it is padding (and within bounds). The length of the
    loop is unknown: only forward-mode derivatives.
    """
    num = selected.shape[0]
    size = min(CHUNK, num)
    # Rounded up to whole chunks, so that the last slice is not shifted.
    order = positions_of_set(selected, -(-num // size) * size)

    # Chunks are counted one by one: if the limit is a constant and no multiple of the step, XLA
    # computes a wrong trip count (0 for one chunk).
    def next_chunk(chunk: Int[Array, ""], carry: Carry) -> Carry:
        index = jax.lax.dynamic_slice_in_dim(order, chunk * size, size)
        return body(jnp.minimum(index, num - 1), index < num, carry)

    num_chunks = (jnp.sum(selected, dtype=jnp.int32) + (size - 1)) // size
    return jax.lax.fori_loop(0, num_chunks, next_chunk, start)
