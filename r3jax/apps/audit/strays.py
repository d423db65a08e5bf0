"""Finds poses that have diverged: far from all others, and their pictures show nothing in common.

Tracking that is lost, a glitch of GPS, or a bundle adjustment that diverges puts a camera
kilometers away, and a map of the whole would be all void. Cameras are linked where they stand
within a few extents of the capture of each other; the largest group is the capture. One or two
cameras beside it have diverged, unless what they show is what others show: an overview of an
object from far away. A second room has more cameras, and stays.

Shape symbols: n poses; k points.
"""

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

_APART = 5.0
"""Cameras farther apart than this, in extents of the capture, are not linked."""

_GROUP = 2
"""Larger groups of cameras are a place of their own."""

_COMPARED = 24
"""Pictures of the others that are read."""

_SAME = 0.1
"""Surfaces that lie so close are one, as a share of their distance from the camera."""

_COMMON = 0.3
"""Share of what a camera shows that others must show."""

_SMALLEST = 0.02
"""All of it lies within this share of the camera's distance: a dot, in which nothing is seen."""


def strays(cameras: np.ndarray, depth: float, points_of: Callable[[int], np.ndarray]) -> np.ndarray:
    """Finds the cameras whose poses have diverged.

    Args:
        cameras: positions, [n, 3].
        depth: a typical depth, in the same units.
        points_of: reads what the picture of a camera shows, [k, 3] in the same coordinates.

    Returns:
        Their numbers, ascending; none if there is no group that most cameras belong to.
    """
    from_middle = np.linalg.norm(cameras - np.median(cameras, axis=0), axis=1)
    group = _groups(cameras, _APART * (float(np.median(from_middle)) + 2.0 * depth))
    sizes = np.bincount(group)
    main = int(np.argmax(sizes))
    alone = np.flatnonzero((sizes <= _GROUP)[group])
    if 2 * sizes[main] <= len(cameras) or not len(alone):
        return alone[:0]
    others = np.flatnonzero(group == main)
    others = others[np.unique(np.linspace(0, len(others) - 1, _COMPARED).astype(np.int64))]
    shown = np.concatenate([points_of(i) for i in others.tolist()])
    tree = KDTree(shown)
    shares = [_shares(cameras[i], points_of(i), tree) for i in alone.tolist()]
    return alone[~np.array(shares)]


def _groups(cameras: np.ndarray, reach: float) -> np.ndarray:
    """Group of each camera, [n]: those that a chain of steps within reach connects."""
    steps = KDTree(cameras).query_pairs(reach, output_type="ndarray")
    links = (np.ones(len(steps), dtype=bool), (steps[:, 0], steps[:, 1]))
    count = len(cameras)
    return connected_components(sparse.coo_matrix(links, (count, count)), directed=False)[1]


def _shares(camera: np.ndarray, shown: np.ndarray, tree: KDTree) -> bool:
    """True if what a camera shows is what others show, and large enough to be seen."""
    if not len(shown) or not tree.n:
        return False
    distance = np.linalg.norm(shown - camera, axis=1)
    apart, _ = tree.query(shown)
    size = float(np.linalg.norm(shown.std(axis=0)))
    is_common = float((apart < _SAME * distance).mean()) >= _COMMON
    return is_common and size > _SMALLEST * float(np.median(distance))
