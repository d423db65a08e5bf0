"""What flights show, look by look, in machine code."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from pathlib import Path

import numpy as np

from r3jax.mapping.backends.numba import bins as mapping_bins
from r3jax.mapping.backends.numba.bins import fold, nearest_bin
from r3jax.native.compiled import called_from_python, forget_outdated_code, kernel
from r3jax.scoring.backends.numba import terms as scoring_terms
from r3jax.scoring.backends.numba.terms import look_from, lowest_bit, product_of_terms

forget_outdated_code(
    Path(__file__).parent, Path(mapping_bins.__file__).parent, Path(scoring_terms.__file__).parent
)

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LEAST = np.float32(1e-6)


@called_from_python()
def list_seen(bits, limit, every, room):
    """Lists the numbers of the set bits of each row [C, q]; of all numbers every so-manieth.

    Returns:
        Where each row's list begins [C + 1], and the numbers.
    """
    begin = np.zeros(bits.shape[0] + 1, np.int64)
    found = np.empty(room, np.int32)
    num = 0
    for k in range(bits.shape[0]):
        for byte in range(bits.shape[1]):
            if bits[k, byte] == 0:
                continue
            for j in range(8):
                at = 8 * byte + j
                if (bits[k, byte] >> (7 - j)) & 1 and at < limit and at % every == 0:
                    found[num] = at
                    num += 1
        begin[k + 1] = num
    return begin, found[:num].copy()


@called_from_python()
def rate_seen(places, begin, item, points, known, focal, is_gain, tables):
    """The bin in which each place sees each item, its R now, and what a look from there makes it.

    Args:
        places: [C, 3] [m].
        begin: where each place's items begin [C + 1].
        item: voxels, and cells behind them; a cell is worth 1 until it is seen.
        points: centers [3, voxels + cells] [m].
        known: visited bins [1, voxels], delta and its log2, resolution, and whether kappa is 1.
        focal: of the camera [px].
        is_gain: count what a look makes of R (`scoring.simulated`); else it makes it 1.
        tables: directions of the voxels' bins, of the panorama's, and how to find the nearest.

    Returns:
        Bins, R before and R after, one for each item of each place.
    """
    visited, delta, log_delta, resolution, is_one = known
    lattice, table, sphere, own_table = tables
    num = item.shape[0]
    bins, low, high = np.empty(num, np.int16), np.zeros(num, np.float32), np.ones(num, np.float32)
    size = np.float32(math.sqrt(table.shape[0]))
    own_size = np.float32(math.sqrt(own_table.shape[0]))
    more = np.zeros((1, 1), np.uint64)
    for k in range(places.shape[0]):
        for i in range(begin[k], begin[k + 1]):
            at = item[i]
            x, y, z = points[0, at], points[1, at], points[2, at]
            x, y, z = x - places[k, 0], y - places[k, 1], z - places[k, 2]
            distance = max(np.float32(math.sqrt(x * x + y * y + z * z)), _LEAST)
            x, y, z = x / distance, y / distance, z / distance
            bins[i] = nearest_bin(x, y, z, fold(x, y, z, size), table, sphere)
            if at >= visited.shape[1]:
                continue
            back = -x, -y, -z
            cosine, inside = look_from(visited, at, lattice, back)
            low[i] = product_of_terms(
                cosine, inside | is_one, distance, delta[at], log_delta[at], resolution[at], focal
            )
            if is_gain:
                own = nearest_bin(-x, -y, -z, fold(-x, -y, -z, own_size), own_table, lattice)
                more[0, 0] = visited[0, at] | (np.uint64(1) << np.uint64(own))
                cosine, inside = look_from(more, 0, lattice, back)
                sharp = max(resolution[at], focal / distance)
                high[i] = product_of_terms(
                    cosine, inside | is_one, distance, delta[at], log_delta[at], sharp, focal
                )
    return bins, low, high


@kernel
def _sum_bins(k, sights, mask, squares, worths, num_voxels, sums):
    """Sums what is left to see from a place, bin by bin, after the looks in `mask`."""
    begin, item, bins, low, high = sights
    each, cell = worths
    sums[:] = _ZERO
    for i in range(begin[k], begin[k + 1]):
        word, now = mask[item[i]], low[i]
        if item[i] >= num_voxels:
            sums[bins[i]] += cell if word == 0 else _ZERO
            continue
        while word != 0:
            now = max(now, squares[bins[i], np.uint32(lowest_bit(word))])
            word &= word - np.uint64(1)
        sums[bins[i]] += each * max(high[i] - now, _ZERO)


@kernel
def _best_axis(sums, members, starts):
    """The axis whose field of view holds the greatest sum, and that sum."""
    best, most = 0, -_ONE
    for a in range(starts.shape[0] - 1):
        total = _ZERO
        for j in range(starts[a], starts[a + 1]):
            total += sums[members[j]]
        if total > most:
            best, most = a, total
    return best, most


@kernel
def _mark(k, sights, mask, in_view, own, log, num_log):
    """Notes in `mask` from where a look shows what; the log holds what was there before."""
    begin, item, bins = sights[:3]
    for i in range(begin[k], begin[k + 1]):
        if in_view[bins[i]]:
            log[0][num_log], log[1][num_log] = item[i], mask[item[i]]
            num_log += 1
            mask[item[i]] |= own[bins[i]]
    return num_log


@called_from_python()
def fly_tree(order, depth, looks, sights, mask, squares, worths, num_voxels, view, own):
    """Adds up what flights over a tree of places show, each look in its best direction.

    Args:
        order: places, depth first [m].
        depth: how many places lie before each on its way [m].
        looks: frames at each on the way to it [m]; a flight that ends there looks once at least.
        sights: what places see, see `rate_seen`.
        mask: by item, the bins it was looked at from on the way; as it was in the end.
        squares: squared cosine between bins of a panorama and of voxels, seen from the voxel.
        worths: of a voxel and of a cell.
        num_voxels: items before the cells.
        view: bins in the field of view of each axis, as a list, where it begins, and as a table.
        own: bit of the voxel's bin for each bin of the panorama.

    Returns:
        For each place what the flight to it shows, the axis of its last look and what that adds.
    """
    members, starts, in_view = view
    num, begin = order.shape[0], sights[0]
    room, deepest, most_looks = 0, 0, 1
    for i in range(num):
        room = max(room, begin[order[i] + 1] - begin[order[i]])
        deepest, most_looks = max(deepest, depth[i]), max(most_looks, looks[i])
    room *= most_looks * (deepest + 1)
    log = np.empty(room, np.int32), np.empty(room, np.uint64)
    ends, gains = np.zeros(deepest + 2, np.int64), np.zeros(deepest + 2, np.float64)
    sums = np.empty(in_view.shape[1], np.float32)
    result, last = np.zeros(num, np.float64), np.zeros(num, np.float64)
    axes, num_log = np.zeros(num, np.int64), 0
    for i in range(num):
        d, k = depth[i], order[i]
        while num_log > ends[d]:  # back to where the ways part
            num_log -= 1
            mask[log[0][num_log]] = log[1][num_log]
        gain = gains[d]
        for _ in range(max(looks[i], 1)):
            _sum_bins(k, sights, mask, squares, worths, num_voxels, sums)
            axes[i], last[i] = _best_axis(sums, members, starts)
            if looks[i] > 0:  # what is passed without a frame shows nothing to those behind it
                gain += last[i]
                num_log = _mark(k, sights, mask, in_view[axes[i]], own, log, num_log)
        ends[d + 1], gains[d + 1] = num_log, gain
        result[i] = gain if looks[i] > 0 else gain + last[i]
    while num_log > 0:
        num_log -= 1
        mask[log[0][num_log]] = log[1][num_log]
    return result, axes, last
