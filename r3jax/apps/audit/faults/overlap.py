"""Which frames show the same surface, and which of their blocks.

A frame is compared with a few neighbors only, however long the capture is: those before and after
it, and those whose cameras were nearest and looked the same way. A point of one frame is looked up
in the other; where the depth there agrees, both show it.

Shape symbols: n frames; b blocks of a frame; m matches.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from r3jax.apps.audit.faults.blocks import BlockImage

_IN_ORDER = (1, 2)
"""Neighbors in the order of the capture."""

_NEAR_BY = 6
"""Further neighbors, by their poses."""

_TURNED = 60.0
"""Cameras that look in directions farther apart have little in common [deg]."""

_AGREES = 0.05
"""Surfaces that lie so close are one, as a share of their distance."""

FEWEST = 40
"""Pairs of frames with fewer blocks in common say nothing."""


_REWEIGHTED = 8
"""Times that pairs are weighted anew."""

_SMALLEST_ERROR = 1e-3
"""Smaller differences are not told apart: the sum of absolute values has no second derivative."""


@dataclass(frozen=True)
class Overlap:
    """What one frame finds of its blocks in another one."""

    first: int
    """Number of the frame whose blocks are looked up."""

    second: int
    """Number of the frame in which they are."""

    own: np.ndarray
    """Blocks of the first that lie within the second, where both have depth, [m]."""

    other: np.ndarray
    """The blocks of the second where they lie, [m]."""

    ratio: np.ndarray
    """Depth of the first's surface over that of the second's, seen by the second, [m]."""

    @property
    def agrees(self) -> np.ndarray:
        """True where both show one surface, [m]."""
        return np.abs(self.ratio - 1.0) < _AGREES


def neighbor_pairs(images: Sequence[BlockImage]) -> np.ndarray:
    """Pairs of frames (first < second) that may show the same surface, [k, 2].

    Distances count in median depths, angles in radians: a step to the side as long as the
    surface is away changes as much as a turn by 57 degrees.
    """
    count = len(images)
    place = np.stack([image.pose[:3, 3] for image in images])
    axis = np.stack([image.pose[:3, 2] for image in images])
    depths = np.array([image.median_depth for image in images])
    typical = float(np.nanmedian(depths)) if np.isfinite(depths).any() else 1.0
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        angle = np.arccos(np.clip(axis @ axis[i], -1.0, 1.0))
        apart = np.linalg.norm(place - place[i], axis=1) / typical + angle
        apart[angle > np.radians(_TURNED)] = np.inf
        apart[i] = np.inf
        near = np.argsort(apart, kind="stable")[:_NEAR_BY]
        found = [*near[np.isfinite(apart[near])].tolist(), *(i + k for k in _IN_ORDER)]
        pairs |= {(min(i, j), max(i, j)) for j in found if j < count}
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def overlap(images: Sequence[BlockImage], first: int, second: int) -> Overlap:
    """Looks the blocks of one frame up in another one."""
    seen = images[second]
    local = (images[first].points - seen.pose[:3, 3]) @ seen.pose[:3, :3]
    z = local[:, 2]
    is_ahead = z > 0.0  # NaN is not
    safe = np.where(is_ahead, z, 1.0)
    column = np.floor(float(seen.camera.fx) * local[:, 0] / safe + float(seen.camera.cx))
    row = np.floor(float(seen.camera.fy) * local[:, 1] / safe + float(seen.camera.cy))
    height, width = seen.shape
    is_in = is_ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    own = np.flatnonzero(is_in)
    other = (row[own] * width + column[own]).astype(np.int64)
    ratio = z[own] / seen.depth[other]
    known = np.isfinite(ratio)
    return Overlap(first, second, own[known], other[known], ratio[known])


def overlaps(images: Sequence[BlockImage]) -> list[Overlap]:
    """All pairs of neighbors that have enough in common to be compared, each in one order."""
    found = [overlap(images, *pair) for pair in neighbor_pairs(images).tolist()]
    return [pair for pair in found if len(pair.own) >= FEWEST]


def levels(count: int, pairs: np.ndarray, difference: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """One number for each frame from differences between pairs, by robust least squares.

    Minimizes the sum of w |x_first - x_second - d| (reweighted least squares). Only differences
    between frames that are linked mean anything.

    Args:
        count: frames, n.
        pairs: first and second of each pair, [k, 2].
        difference: of the first from the second, [k].
        weight: [k].

    Returns:
        [n]; a frame without pairs has 0.
    """
    x, every, (i, j) = np.zeros(count), np.arange(count), pairs.T
    for _ in range(_REWEIGHTED):
        error = np.abs(x[i] - x[j] - difference)
        w = weight / np.maximum(error, _SMALLEST_ERROR)
        # Next to nothing on the diagonal: frames without a link stay at 0.
        least = 1e-6 * max(float(w.max(initial=0.0)), 1.0)
        value = np.concatenate([w, w, -w, -w, np.full(count, least)])
        row, column = np.r_[i, j, i, j, every], np.r_[i, j, j, i, every]
        laplacian = sparse.coo_matrix((value, (row, column)), (count, count)).tocsc()
        change = np.bincount(np.r_[i, j], np.r_[w * difference, -w * difference], count)
        x = np.asarray(spsolve(laplacian, change))
    return x


def neighbors_of(count: int, pairs: np.ndarray) -> list[np.ndarray]:
    """The frames that each frame was compared with, n arrays."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return [both[both[:, 0] == i, 1] for i in range(count)]
