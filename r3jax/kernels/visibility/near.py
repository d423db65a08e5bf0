"""What a few views may show, in the order in which it lies: culled one by one, without an index."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels.native.compiled import in_wide_vectors, inlined, kernel
from r3jax.kernels.visibility.bricks import Bricks, bounds_of, may_see
from r3jax.kernels.visibility.views import view_at

MAX_VIEWS = 6
"""Up to this many views, building the index costs more than it saves."""

_MARGIN = np.float32(4.0)
"""A voxel so far outside of a view covers none of its pixels; nearer ones appear larger than they
are (`constants.NEAR`) [voxels]."""


@kernel
def _mark_in_view(bounds, voxel_size, x, y, z, is_near):
    """Marks points that may appear in one view."""
    in_wide_vectors()
    margin = _MARGIN * voxel_size
    for i in range(x.shape[0]):
        is_near[i] = np.int32(may_see(bounds, x[i], y[i], z[i], margin, voxel_size)) | is_near[i]


@kernel
def mark_near(views, is_valid, layout, voxel_size, x, y, z, is_near):
    """Marks points [m] that may appear in some view: 1, else 0."""
    for i in range(x.shape[0]):
        is_near[i] = 0
    for view in range(is_valid.shape[0]):
        if is_valid[view]:
            bounds = bounds_of(view_at(views, view), layout)
            _mark_in_view(bounds, voxel_size, x, y, z, is_near)


@inlined
def compact(marks, count, chosen):
    """Writes the numbers of what is marked by 1; returns how many they are."""
    num = 0
    for i in range(count):
        chosen[num] = i
        num += marks[i]
    return num


@kernel
def bricks_of_shares(begins, ends, num):
    """Makes a brick of each range, `begins` to `ends`, that a share has filled.

    Any view may see these bricks. After each of them there is one of the rows that its share did
    not fill, which no view sees.
    """
    num_bricks = 2 * begins.shape[0]
    starts, spheres = np.empty(num_bricks + 1, np.int64), np.zeros((num_bricks, 4), np.float32)
    for share in range(begins.shape[0]):
        starts[2 * share], starts[2 * share + 1] = begins[share], ends[share]
        spheres[2 * share, 3], spheres[2 * share + 1, 3] = np.inf, np.nan
    starts[num_bricks] = num
    return Bricks(starts, spheres)
