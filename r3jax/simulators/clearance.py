"""Computes exact distances from points to a triangle mesh, and checks or finds a camera's start.

Distances are exact up to rounding. A given start is checked; otherwise a good one is searched for.

Shape symbols: V vertices; F faces; P pieces; n points; D probing directions.
"""

import math

import numpy as np
from scipy.spatial import KDTree

from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.simulators.raycast.rays import Hits, TriangleScene

MIN_CLEARANCE = 0.3
"""A start nearer to the mesh than this is an error [m]."""

PROMISED_CLEARANCE = 0.5
"""What `Simulator.start_pose` promises; starts that we choose ourselves keep it [m]."""

APART = 0.6
"""Cameras that start together lie this far from each other [m]: two body radii."""

_EYE_HEIGHT = 1.4
_CANDIDATES = 3000
_PROBES = 96
_SMALLEST_ROOM = 10.0
"""A closed shell that is seen from behind and smaller than this is furniture [m^3]."""


_NEIGHBORS = 12
"""Pieces looked at first; the rest only if they could be nearer."""

_CHUNK = 2000
"""Points that are measured at once."""

_FEW = 32
"""Points at once for each of which many pieces are measured."""


class SurfaceDistance:
    """Measures the distance from points to the nearest surface.

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


def level_pose(position: np.ndarray, yaw: float) -> np.ndarray:
    """Makes the pose at `position` [3] [m] that looks level along `yaw` [rad], [4, 4] float64."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    pose = np.eye(4)
    pose[:3, 0] = sin, -cos, 0.0
    pose[:3, 1] = 0.0, 0.0, -1.0
    pose[:3, 2] = cos, sin, 0.0
    pose[:3, 3] = position
    return pose


def places_beside(start: np.ndarray) -> np.ndarray:
    """Finds six places [6, 3] [m] at the height of a start [3], `APART` from it and each other.

    A wall cannot lie between two such places where both have `MIN_CLEARANCE` around them.
    """
    angle = np.arange(6) * np.pi / 3.0
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=1)
    return start + APART * ring


def start_problem(
    position: np.ndarray,
    bounds: np.ndarray,
    scene: TriangleScene,
    distance: SurfaceDistance,
    min_clearance: float = MIN_CLEARANCE,
) -> str | None:
    """Says why a camera must not start at `position` [3] [m], or None."""
    if not np.isfinite(position).all():
        return f"is not finite: {position.tolist()}"
    if (position < bounds[0]).any() or (position > bounds[1]).any():
        low, high = np.round(bounds, 2).tolist()
        return f"is outside the world, which spans {low} to {high} m"
    clearance = float(distance(position[None])[0])
    if clearance < min_clearance:
        return (
            f"is {clearance:.2f} m from the nearest surface (in a wall, or too close to one); "
            f"at least {min_clearance} m must be free"
        )
    if _is_inside_furniture(position, bounds, scene):
        return f"is inside a closed solid, {clearance:.2f} m below its surface"
    return None


def find_start(
    bounds: np.ndarray, scene: TriangleScene, distance: SurfaceDistance, seed: int = 0
) -> np.ndarray | None:
    """Finds the roomiest place at eye height, as a pose [4, 4].

    It is None if nothing is free enough.

    Candidates stand 1.4 m above whatever is below a random point (lower under a low ceiling).
    Best are places with walls and a ceiling all round whose faces are seen from the front; then
    enclosed ones; then, for a scan without a ceiling, any. Among equals the clearance decides.

    Args:
        bounds: the world's box [2, 3] [m].
        scene: the mesh, for rays.
        distance: the mesh, for clearances.
        seed: of the random points; the same seed gives the same pose.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(bounds[0], bounds[1], size=(_CANDIDATES, 3))
    candidates = _at_eye_height(points, scene)
    # Above a scan that is lower than the eye, the eye is outside.
    candidates = candidates[(candidates <= bounds[1]).all(axis=1)]
    if len(candidates) == 0:
        return None
    tier, roomy = _enclosure(candidates, scene)
    for wanted in range(tier.max(), -1, -1):
        chosen = np.flatnonzero(tier >= wanted)
        # The nearest probe bounds the clearance from above: look closely at the best only.
        chosen = chosen[np.argsort(-roomy[chosen], kind="stable")[:200]]
        clearance = distance(candidates[chosen])
        best = int(clearance.argmax())
        if clearance[best] >= PROMISED_CLEARANCE:
            position = candidates[chosen[best]]
            return level_pose(position, _longest_view(position, scene))
    return None


def _cast(scene: TriangleScene, origins: np.ndarray, directions: np.ndarray) -> Hits:
    """Casts D directions from each of n origins; hits come as [n * D]."""
    n, d = len(origins), len(directions)
    return scene.cast(
        np.repeat(origins, d, axis=0).astype(np.float32),
        np.tile(directions, (n, 1)).astype(np.float32),
    )


def _at_eye_height(points: np.ndarray, scene: TriangleScene) -> np.ndarray:
    """Moves points to eye height above the surface below; drops those without one."""
    down = _cast(scene, points, np.array([[0.0, 0.0, -1.0]])).distance
    points, down = points[np.isfinite(down)], down[np.isfinite(down)]
    floor = points - np.stack([np.zeros_like(down)] * 2 + [down], axis=1)
    above = floor + np.array([0.0, 0.0, 0.05])
    headroom = _cast(scene, above, np.array([[0.0, 0.0, 1.0]])).distance + 0.05
    height = np.minimum(_EYE_HEIGHT, 0.5 * headroom)
    floor[:, 2] += height
    return floor[height > MIN_CLEARANCE]


def _enclosure(points: np.ndarray, scene: TriangleScene) -> tuple[np.ndarray, np.ndarray]:
    """Rates how enclosed each point is, and measures its nearest hit.

    The rate is 2 inside, seen from the front; 1 inside; 0 in the open.
    """
    directions = fibonacci_lattice(_PROBES)
    hits = _cast(scene, points, directions)
    shape = (len(points), _PROBES)
    is_hit = np.isfinite(hits.distance).reshape(shape)
    is_front = is_hit & ~hits.is_back.reshape(shape)
    has_ceiling = is_hit[:, directions[:, 2] > 0.8].mean(axis=1) > 0.8
    is_inside = (is_hit.mean(axis=1) > 0.85) & has_ceiling
    from_front = is_front.sum(axis=1) > 0.6 * is_hit.sum(axis=1)
    tier = is_inside.astype(int) + (is_inside & from_front).astype(int)
    return tier, hits.distance.reshape(shape).min(axis=1)


def _longest_view(position: np.ndarray, scene: TriangleScene) -> float:
    """Finds the yaw [rad] along which a wide view reaches farthest."""
    yaw = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    level = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    reach = np.minimum(_cast(scene, position[None], level).distance, 10.0)
    mean = sum(np.roll(reach, k) for k in range(-5, 6))
    return float(yaw[int(np.argmax(mean))])


def _is_inside_furniture(position: np.ndarray, bounds: np.ndarray, scene: TriangleScene) -> bool:
    """Checks whether a place lies inside a closed solid that is too small for a room.

    Many meshes have inverted faces, and a room may be a box seen from within:
    so only a small shell that shows nothing but back faces, with a world outside it, counts.
    """
    directions = fibonacci_lattice(_PROBES)
    hits = _cast(scene, position[None], directions)
    # Only the sides: a solid's bottom may coincide with the floor that it stands on.
    is_sideways = np.abs(directions[:, 2]) < 0.6
    if not hits.is_back[is_sideways].mean() > 0.95:
        return False
    shell = position + hits.distance[:, None] * directions
    shell = shell[np.isfinite(hits.distance)]
    extent = np.ptp(shell, axis=0)
    is_whole_world = (extent > 0.9 * (bounds[1] - bounds[0])).all()
    return bool(extent.prod() < _SMALLEST_ROOM and not is_whole_world)
