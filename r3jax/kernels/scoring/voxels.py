"""What is known of the voxels near some views, sorted into bricks, with what R needs of each."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.kernels.mapping.bins import center_of
from r3jax.kernels.native.arithmetic import bits_of, count_bits, float_of, log2
from r3jax.kernels.native.compiled import inlined, kernel, parallel_kernel
from r3jax.kernels.visibility.views import CHUNK

X, Y, Z, DELTA, LOG_DELTA, RESOLUTION = 0, 1, 2, 3, 4, 5
"""Rows of the array that `gather_voxels` writes: center [m], color consistency and log2 of it,
best resolution [px/m]."""

SIZE = 6

_ROW, _WORDS = 6, 7
"""Parts of a record beside those: the row of the map, and where the words of bins begin."""

_CLASSES = 8
"""Numbers of directions that are told apart: 0 to 6, and more."""

NEVER = np.float32(-1e30)
"""Stands for log2 of 0: any power of it but the zeroth is 0, and the zeroth is 1."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_TWO_THIRDS_OF_TWO = np.float32(2.0 / 1.5)


@inlined
def log2_or_never(x):
    """log2 x; `NEVER` where x is 0."""
    return log2(x) if x > _ZERO else NEVER


@inlined
def consistency(count, m2, is_pairwise):
    """Delta of a voxel, in [0, 1] (`renderability.consistency`)."""
    variance = m2 / max(count - _ONE, _ONE)
    spread = _TWO * variance if is_pairwise else math.sqrt(_TWO_THIRDS_OF_TWO * variance)
    return min(max(_ONE - spread, _ZERO), _ONE) if count > _ONE else _ONE


@inlined
def bins_of(words, word, row):
    """Two words of 32 bins as one of 64; the second may not be there."""
    bits = np.uint64(words[word, row])
    if word + 1 < words.shape[0]:
        bits |= np.uint64(words[word + 1, row]) << np.uint64(32)
    return bits


@inlined
def _num_directions(record, words):
    """How many bins a voxel was seen from."""
    num = np.int64(0)
    for word in range(words):
        num += count_bits(record[_WORDS + word])
    return num


@kernel
def _unpack_sorted(records, begin, end, words, counts, voxels, visited, rows):
    """Unpacks records, those that were seen from few directions first.

    A counting sort. Loops over the directions of one voxel after the other then end after as many
    turns as the ones before, which the processor foresees.
    """
    counts[:] = 0
    for i in range(begin, end):
        counts[min(_num_directions(records[i], words), _CLASSES - 1)] += 1
    place = begin
    for i in range(_CLASSES):
        counts[i], place = place, place + counts[i]
    for i in range(begin, end):
        record = records[i]
        group = min(_num_directions(record, words), _CLASSES - 1)
        place = counts[group]
        counts[group] += 1
        rows[place] = record[_ROW]
        for part in range(SIZE):
            voxels[part, place] = float_of(record[part])
        for word in range(0, words, 2):
            high = np.uint64(record[_WORDS + word + 1]) if word + 1 < words else np.uint64(0)
            visited[word >> 1, place] = np.uint64(record[_WORDS + word]) | (high << np.uint64(32))


@parallel_kernel
def gather_voxels(slots, starts, key, words, count, m2, resolution, voxel_size, is_pairwise,
                  workers, voxels, visited, rows):  # fmt: skip
    """Gathers what is known of voxels in the order of the bricks.

    Args:
        slots: of every row of the map, -1: none [N].
        starts: of the bricks among the slots [b + 1].
        key: of the map, like the next five.
        words: its visited bins, 32 in a word.
        count: observations.
        m2: spread of the colors.
        resolution: best resolution [px/m].
        voxel_size: edge [m].
        is_pairwise: form of delta.
        workers: threads.
        voxels: written, [SIZE, n].
        visited: written, the visited bins, 64 in a word [ceil(W / 2), n].
        rows: written, the rows of the map [n].
    """
    num, capacity, num_words = rows.shape[0], slots.shape[0], words.shape[0]
    # Records, so that a voxel out of its order costs one miss of the cache and not one for each.
    records = np.empty((num, _WORDS + num_words), np.uint32)
    for share in prange(workers):
        for row in range(capacity * share // workers, capacity * (share + 1) // workers):
            if slots[row] >= 0:
                record = records[slots[row]]
                delta = consistency(count[row], m2[row], is_pairwise)
                x, y, z = center_of(key, row, voxel_size)
                record[X], record[Y], record[Z] = bits_of(x), bits_of(y), bits_of(z)
                record[DELTA], record[LOG_DELTA] = bits_of(delta), bits_of(log2_or_never(delta))
                record[RESOLUTION], record[_ROW] = bits_of(resolution[row]), row
                for word in range(num_words):
                    record[_WORDS + word] = words[word, row]
    for share in prange(workers):
        first, last = num * share // workers, num * (share + 1) // workers
        counts = np.empty(_CLASSES, np.int64)
        for brick in range(starts.shape[0] - 1):
            for begin in range(starts[brick], starts[brick + 1], CHUNK):
                if first <= begin < last:
                    end = min(begin + CHUNK, starts[brick + 1])
                    _unpack_sorted(records, begin, end, num_words, counts, voxels, visited, rows)
