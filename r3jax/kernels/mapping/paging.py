"""Rows between a table and its successor in machine code: `mapping.tiles.page`.

Shape symbols: N rows of a table; n voxels.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels.constants import MAX_PROBES
from r3jax.kernels.native.platform import compiled_or_plain

GONE, LEAVES, MOVES, STAYS = 0, 1, 2, 3
"""Rows without a voxel; of voxels out of the block; of others, which the first probe does not find;
and of those that it finds: they may stay, whatever lies before others."""

_MASK21 = np.uint32((1 << 21) - 1)


@compiled_or_plain
def hash_of(low, high):
    """Computes `table.hash_key` of one key."""
    h = np.uint32(low ^ np.uint32(0x9E3779B9))
    for word in (np.uint32(0), np.uint32(high * np.uint32(0x85EBCA6B))):
        h = np.uint32(h ^ word)
        h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
        h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
        h = np.uint32(h ^ (h >> np.uint32(16)))
    return h


@compiled_or_plain
def sort_rows(key, is_present, first, last):
    """Finds what becomes of each row of a table when the block moves, [N] uint8.

    Args:
        key: packed voxel indices [2, N].
        is_present: rows that describe a voxel [N] bool.
        first: lowest index of a voxel of the block along each axis, in the bits of a key [3].
        last: the highest [3].
    """
    kinds, mask = np.empty(key.shape[1], np.uint8), np.uint32(key.shape[1] - 1)
    for row in range(key.shape[1]):
        low, high = key[0, row], key[1, row]
        x = low & _MASK21
        y = (low >> np.uint32(21)) | ((high << np.uint32(11)) & _MASK21)
        z = high >> np.uint32(10)
        is_in = (x >= first[0]) & (x <= last[0]) & (y >= first[1]) & (y <= last[1])
        is_in &= (z >= first[2]) & (z <= last[2])
        kind = STAYS if (hash_of(low, high) & mask) == np.uint32(row) else MOVES
        kinds[row] = (kind if is_in else LEAVES) if is_present[row] else GONE
    return kinds


@compiled_or_plain
def place_keys(key, is_taken):
    """Finds a row for each of distinct keys [2, n] along the probes of `mapping.table`.

    Args:
        key: packed voxel indices.
        is_taken: rows that are not free [N] bool; those that are given away join them.

    Returns:
        Rows [n] int64; -1 for keys without a free one.
    """
    rows, mask = np.empty(key.shape[1], np.int64), np.uint32(is_taken.shape[0] - 1)
    for i in range(key.shape[1]):
        slot, rows[i] = hash_of(key[0, i], key[1, i]) & mask, -1
        for probe in range(1, MAX_PROBES + 1):
            if not is_taken[np.int64(slot)]:
                rows[i], is_taken[np.int64(slot)] = np.int64(slot), True
                break
            slot = np.uint32(slot + np.uint32(probe)) & mask
    return rows


@compiled_or_plain
def fill_rows(old, kinds, moved, values, rows, empty, new):
    """Fills one word of all rows of a table.

    Args:
        old: of the table before [N].
        kinds: of `sort_rows`: rows that stay keep their word.
        moved: rows of the table before that move [m].
        values: of voxels that come [n].
        rows: rows in the new table of the ones and the others [m + n].
        empty: for rows without a voxel.
        new: written [N].
    """
    for row in range(new.shape[0]):
        new[row] = old[row] if kinds[row] == STAYS else empty
    num = moved.shape[0]
    for i in range(num):
        new[rows[i]] = old[moved[i]]
    for i in range(values.shape[0]):
        new[rows[num + i]] = values[i]
