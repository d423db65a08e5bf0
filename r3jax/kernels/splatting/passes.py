"""The forward and the backward pass of a view: from the scene's arrays to images and gradients.

Large fresh arrays come in large pages: else the first write to 38 MB costs 10 000 page faults.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import sys

import numpy as np
from numba import types

from r3jax.kernels.native.compiled import inlined, kernel
from r3jax.kernels.splatting import records as at
from r3jax.kernels.splatting.bins import (
    emit_all,
    list_by_tile,
    order_of,
    project_all,
    sums_before,
)
from r3jax.kernels.splatting.compositing import composite_all, gradient_of_all
from r3jax.kernels.splatting.gradient import gradient_of_cloud

_ON_LINUX = sys.platform == "linux"
_MADV_HUGEPAGE = 14
_PAGE = 4096
_WORTH_IT = 1 << 22  # bytes

_madvise = types.ExternalFunction("madvise", types.int32(types.intp, types.uintp, types.int32))


@inlined
def expect_writes(array):
    """Asks Linux for huge pages below a large array that is about to be written as a whole.

    XLA and Numba allocate it for every call. This is only advice: a failure is ignored.
    """
    size = array.size * array.itemsize
    if _ON_LINUX and size >= _WORTH_IT:
        first = -(-array.ctypes.data // _PAGE) * _PAGE
        _madvise(first, (array.ctypes.data + size) // _PAGE * _PAGE - first, _MADV_HUGEPAGE)


@kernel
def forward_pass(cloud, view, workers, images, totals, records, lists):
    """Renders a view.

    Args:
        cloud: means [n, 3], quats [n, 4], log_scales [n, 3], opacity logits [n],
            harmonics [n, k * 3], center offsets [n, 2].
        view: see `VIEW_SIZE`.
        workers: threads to share the work.
        images: written; rgb [H, W, 3], depth [H, W], alpha [H, W].
        totals: written; intersections needed, and how many of them exceed the budget. If any
            does, the images are black.
        records: written; [n, 16].
        lists: written; ids, slots, rows [budget], starts [tiles + 1], ends [tiles].
    """
    rgb, depth, alpha = images
    list_ids, list_slots, list_rows, tile_starts, tile_ends = lists
    size = alpha.shape[1], alpha.shape[0]
    budget, n = list_ids.shape[0], records.shape[0]
    counts = np.empty((-(-n // at.BLOCK), 2), np.int64)
    expect_writes(records)
    project_all(cloud, view, size, workers, records, counts)
    drawn, needed = sums_before(counts)
    most = np.int64(2**31 - 1)
    totals[0], totals[1] = min(needed, most), min(max(needed - budget, 0), most)
    if needed > budget:
        tile_starts[:] = 0
        records.view(np.int32)[:, at.COUNT] = 0
    else:
        order_keys, ids = np.empty(drawn, np.int32), np.empty(drawn, np.int32)
        who = order_keys, ids, np.empty(drawn + 1, np.int32)
        tiles, rows = np.empty(needed, np.int32), np.empty(needed, np.uint8)
        emit_all(size, workers, records, counts, who, tiles, rows)
        order = order_of(order_keys)
        list_by_tile(order, who, tiles, rows, workers, tile_starts, list_ids, list_slots, list_rows)
    composite_all(records, list_ids, list_rows, tile_starts, workers, rgb, depth, alpha, tile_ends)


@kernel
def backward_pass(cloud, view, workers, images, records, lists, gradients, g_cloud, g_view):
    """Computes the gradients by cloud and view from those by the images and the forward pass."""
    tile_starts, alpha = lists[3], images[2]
    size = alpha.shape[1], alpha.shape[0]
    slots = np.empty(tile_starts[-1] * at.GRADIENT_SIZE, np.float32)
    expect_writes(slots)
    expect_writes(g_cloud[4])  # harmonics, by far the largest
    gradient_of_all(lists, records, images, gradients, workers, slots)
    gradient_of_cloud(cloud, records, slots, view, size, workers, g_cloud, g_view)
