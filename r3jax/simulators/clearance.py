"""Distances from points to a triangle mesh, exact up to float rounding.

Shape symbols: V vertices; F faces; P pieces; n points.
"""

import numpy as np
from scipy.spatial import KDTree

_NEIGHBORS = 12
"""Pieces looked at first; the rest only if they could be nearer."""

_CHUNK = 2000
"""Points that are measured at once."""

_FEW = 32
"""Points at once for each of which many pieces are measured."""


class SurfaceDistance:
    """Answers how far points are from the nearest surface.

    Large triangles are cut into pieces, so that a search tree over the pieces' centers finds the
    few that can be nearest; the distance to these is exact.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Cuts the mesh `vertices` [V, 3] [m], `faces` [F, 3] and builds the tree."""
        corners = vertices[faces].astype(np.float64)
        extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
        self._pieces = cut_triangles(corners, max(0.25, extent / 80.0))
        centers = self._pieces.mean(axis=1)
        self._radius = float(np.linalg.norm(self._pieces - centers[:, None], axis=2).max())
        self._tree = KDTree(centers)

    def __call__(self, points: np.ndarray, limit: float = np.inf) -> np.ndarray:
        """Measures the distances [n] of `points` [n, 3] to the mesh [m].

        They are `inf` beyond the limit.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        found = np.full(len(points), np.inf)
        near = np.arange(len(points))
        if np.isfinite(limit):
            # No piece reaches farther from its center than the radius.
            near = np.flatnonzero(self._tree.query(points)[0] - self._radius <= limit)
        for begin in range(0, len(near), _CHUNK):
            chunk = near[begin : begin + _CHUNK]
            found[chunk] = self._measure(points[chunk])
        found[found > limit] = np.inf
        return found

    def _measure(self, points: np.ndarray) -> np.ndarray:
        """Measures the distances [n] of `points` [n, 3] [m]."""
        k = min(_NEIGHBORS, len(self._pieces))
        reach, nearest = self._tree.query(points, k=k)
        reach, nearest = reach.reshape(len(points), k), nearest.reshape(len(points), k)
        found = np.full(len(points), np.inf)
        for column in nearest.T:
            found = np.minimum(found, point_triangle(points, self._pieces[column]))
        # A piece that was not looked at is at least this far away.
        is_open = reach[:, -1] - self._radius < found
        if k < len(self._pieces):
            rest = np.flatnonzero(is_open)
            for few in (rest[begin : begin + _FEW] for begin in range(0, len(rest), _FEW)):
                near = self._tree.query_ball_point(points[few], found[few] + self._radius)
                which = np.repeat(few, [len(pieces) for pieces in near])
                pieces = self._pieces[np.concatenate([[], *near]).astype(int)]
                np.minimum.at(found, which, point_triangle(points[which], pieces))
        return found


def cut_triangles(corners: np.ndarray, longest: float) -> np.ndarray:
    """Halves triangles [n, 3, 3] at their longest edge until no edge is over `longest` [m]."""
    done: list[np.ndarray] = []
    while len(corners):
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)  # edge k: k, k+1
        is_small = edges.max(axis=1) <= longest
        done.append(corners[is_small])
        corners, edges = corners[~is_small], edges[~is_small]
        first = edges.argmax(axis=1)
        rows = np.arange(len(corners))
        a, b, c = (corners[rows, (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        corners = np.concatenate(
            [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        )
    return np.concatenate(done)


def point_triangle(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Computes the distance of each point [n, 3] to its triangle [n, 3, 3]."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    edges = [_point_segment(points, p, q) for p, q in ((a, b), (b, c), (c, a))]
    nearest = np.minimum(np.minimum(edges[0], edges[1]), edges[2])
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    is_flat = length < 1e-14
    normal = normal / np.where(is_flat, 1.0, length)[:, None]
    inside = ~is_flat
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ij,ij->i", np.cross(normal, q - p), points - p) >= 0.0
    height = np.abs(np.einsum("ij,ij->i", normal, points - a))
    return np.where(inside, height, nearest)


def _point_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Computes the distance of each point [n, 3] to its segment."""
    along = b - a
    squared = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", points - a, along) / np.where(squared == 0.0, 1.0, squared)
    return np.linalg.norm(points - a - np.clip(share, 0.0, 1.0)[:, None] * along, axis=1)
