"""A fixed-capacity spatial hash in arrays: find, find or insert.

Open addressing with triangular probing: probe i of a key looks at slot h + i (i + 1) / 2, which
visits every slot of a power-of-two table once. Nothing is ever deleted, so a search may stop at
the first empty slot. All keys of a call probe together; ties for an empty slot are broken by
`max`, which commutes, so the result does not depend on the order of a scatter.

Shape symbols: N capacity; n keys of a call.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.kernels.constants import MAX_PROBES

_Search = tuple[Int[Array, ""], Int[Array, " n"], Bool[Array, " n"]]
"""Number of the probe, row of each key so far, keys still searched."""

_Bidding = tuple[Int[Array, ""], Int[Array, " N"], Int[Array, " n"], Bool[Array, " n"]]
"""Number of the probe, owner of each slot, slot that each item has won, items without a slot."""


def hash_key(low: UInt32[Array, " n"], high: UInt32[Array, " n"]) -> UInt32[Array, " n"]:
    """Mixes a packed key to 32 well-spread bits (the finalizer of MurmurHash3, twice)."""
    # One word after the other: with a plain xor of both, distant voxels would share a hash.
    h = _mix(low ^ jnp.uint32(0x9E3779B9))
    return _mix(h ^ (high * jnp.uint32(0x85EBCA6B)))


def _mix(h: UInt32[Array, " n"]) -> UInt32[Array, " n"]:
    h = (h ^ (h >> 16)) * jnp.uint32(0x85EBCA6B)
    h = (h ^ (h >> 13)) * jnp.uint32(0xC2B2AE35)
    return h ^ (h >> 16)


def _slot(hashed: UInt32[Array, " n"], probe: Int[Array, ""], capacity: int) -> Int[Array, " n"]:
    step = (probe * (probe + 1) // 2).astype(jnp.uint32)
    return ((hashed + step) & jnp.uint32(capacity - 1)).astype(jnp.int32)


def find(
    table: UInt32[Array, "2 N"], keys: UInt32[Array, "2 n"], valid: Bool[Array, " n"]
) -> Int[Array, " n"]:
    """Finds the row of each key; N where it is absent or not valid."""
    capacity = table.shape[1]
    hashed = hash_key(keys[0], keys[1])

    def is_unfinished(carry: _Search) -> Bool[Array, ""]:
        probe, _, searching = carry
        # Bounded: in a full table the probes of a missing key meet no empty slot.
        return jnp.any(searching) & (probe < MAX_PROBES)

    def look(carry: _Search) -> _Search:
        probe, row, searching = carry
        slot = _slot(hashed, probe, capacity)
        low, high = table[0, slot], table[1, slot]
        is_found = searching & (low == keys[0]) & (high == keys[1])
        # Nothing is ever deleted, so that an empty slot ends the probe sequence.
        is_empty = high == jnp.uint32(EMPTY_WORD)
        return probe + 1, jnp.where(is_found, slot, row), searching & ~is_found & ~is_empty

    absent = jnp.full(keys.shape[1], capacity, dtype=jnp.int32)
    start = (jnp.zeros((), jnp.int32), absent, valid)
    return jax.lax.while_loop(is_unfinished, look, start)[1]


def find_or_insert(
    table: UInt32[Array, "2 N"], keys: UInt32[Array, "2 n"], valid: Bool[Array, " n"]
) -> tuple[UInt32[Array, "2 N"], Int[Array, " n"]]:
    """Finds the row of each key, and inserts keys that have none.

    Args:
        table: packed keys of the rows.
        keys: packed keys; those that are valid must be distinct.
        valid: False for padding.

    Returns:
        The table with the new keys, and the row of each key: N for padding and for keys without a
        free slot.
    """
    capacity = table.shape[1]
    found = find(table, keys, valid)
    is_new = valid & (found == capacity)
    # Searched before anything is claimed: a key must not get a second row.
    claimed = _claim(table[1] == jnp.uint32(EMPTY_WORD), hash_key(keys[0], keys[1]), is_new)
    table = table.at[:, claimed].set(keys, mode="drop")  # distinct: one winner a slot
    return table, jnp.where(is_new, claimed, found)


def _claim(
    is_empty: Bool[Array, " N"], hashed: UInt32[Array, " n"], wants: Bool[Array, " n"]
) -> Int[Array, " n"]:
    """Claims an empty slot for each item, along its probe sequence.

    The slot is N if there is none.
    """
    capacity, num_items = is_empty.shape[0], hashed.shape[0]
    item = jnp.arange(num_items, dtype=jnp.int32)

    def is_unfinished(carry: _Bidding) -> Bool[Array, ""]:
        probe, _, _, wanting = carry
        return jnp.any(wanting) & (probe < MAX_PROBES)

    def bid(carry: _Bidding) -> _Bidding:
        probe, owner, won, wanting = carry
        slot = _slot(hashed, probe, capacity)
        bids = wanting & (owner[slot] == -1)
        # A slot is free in one round only: afterwards it has an owner.
        owner = owner.at[jnp.where(bids, slot, capacity)].max(item, mode="drop")
        is_won = bids & (owner[slot] == item)
        return probe + 1, owner, jnp.where(is_won, slot, won), wanting & ~is_won

    nothing = jnp.full(num_items, capacity, dtype=jnp.int32)
    # Owners beyond every item: a taken slot never becomes free again.
    owner = jnp.where(is_empty, -1, num_items)
    start = (jnp.zeros((), jnp.int32), owner, nothing, wants)
    return jax.lax.while_loop(is_unfinished, bid, start)[2]
