"""Where a camera may start in a world: checks of a given place, and a search for a good one.

Shape symbols: n candidate positions; D probing directions.
"""

import math

import numpy as np

from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.simulators.clearance import SurfaceDistance
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
    """Moves points to eye height above what is below them; drops those with nothing below."""
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

    Many meshes have their faces the wrong way round, and a room may be a box seen from within:
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
