"""Loops over the selected few of many, in chunks: cost follows the selection, not the capacity.

A chunk also stays in the cache of one core, where XLA would otherwise write every intermediate
array of the whole table to memory.

Shape symbols: n items of which some are selected; K items of a chunk.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from r3jax.geometry.compaction import SPARE, positions_of_set, running_count, spare_places

CHUNK = 1 << 12
"""Items at once."""

Carry = TypeVar("Carry")

_Kept = tuple[Int[Array, " n_padded"], Int[Array, ""]]
"""`order` and `count` of a selection."""


class Selection(eqx.Module):
    """Places of the selected items."""

    order: Int[Array, " n_padded"]
    """Places in increasing order, then n; whole chunks."""

    count: Int[Array, ""]
    """Number of selected items."""

    num: int = eqx.field(static=True)
    """Number of items to select from, n."""

    @property
    def mask(self) -> Bool[Array, " n"]:
        """True for the selected items."""
        # The padding, n, is out of range and dropped.
        return jnp.zeros(self.num, dtype=bool).at[self.order].set(True, mode="drop")


def select(selected: Bool[Array, " n"]) -> Selection:
    """The places where a mask is set."""
    num = selected.shape[0]
    size = min(CHUNK, num)
    # Rounded up to whole chunks, so that the last slice is never shifted back.
    order = positions_of_set(selected, -(-num // size) * size)
    return Selection(order, jnp.sum(selected, dtype=jnp.int32), num)


def for_selected(
    selection: Selection,
    body: Callable[[Int[Array, " K"], Bool[Array, " K"], Carry], Carry],
    start: Carry,
) -> Carry:
    """Calls `body(index, valid, carry) -> carry` for the selected items, a chunk at a time.

    `index` holds places of selected items in increasing order; where `valid` is False it is
    padding (and within bounds). A loop of unknown length: forward derivatives only.
    """
    num = selection.num
    size = min(CHUNK, num)

    # Chunks are counted one by one: for a limit that XLA knows and that is no multiple of the
    # step, it gets the number of turns wrong (one chunk: none).
    def next_chunk(chunk: Int[Array, ""], carry: Carry) -> Carry:
        index = jax.lax.dynamic_slice_in_dim(selection.order, chunk * size, size)
        return body(jnp.minimum(index, num - 1), index < num, carry)

    num_chunks = (selection.count + (size - 1)) // size
    return jax.lax.fori_loop(0, num_chunks, next_chunk, start)


def narrow(
    selection: Selection, test: Callable[[Int[Array, " K"]], Bool[Array, " K"]]
) -> Selection:
    """The selected items that pass `test(index)`, in the same order."""
    size = min(CHUNK, selection.num)
    room = selection.order.shape[0]

    def keep(index: Int[Array, " K"], valid: Bool[Array, " K"], kept: _Kept) -> _Kept:
        order, count = kept
        passes = valid & test(index)
        place = running_count(passes)
        # Those that fail are written to spare room past the end: one scatter, no branch.
        target = jnp.where(passes, count + place - 1, spare_places(room, size))
        # The last running count is the number that passed: no second sum.
        return order.at[target].set(index, mode="drop"), count + place[size - 1]

    nothing = jnp.full(room + SPARE, selection.num, dtype=jnp.int32)
    order, count = for_selected(selection, keep, (nothing, jnp.zeros((), jnp.int32)))
    return Selection(order[:room], count, selection.num)
