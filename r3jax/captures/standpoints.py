"""Finds where a person could hold a camera in a captured place, to take an image or to look around.

With depth images the places lie in known free space, at a margin from everything that is not known
to be free, connected to the camera's positions, and at heights at which the camera was held.
Without depth images, they lie within the hull of the camera's positions and a margin around it, at
a margin from every voxel, and where a camera was or a ray to a point passed, so not inside walls.
Where a camera was, one can be held, too: an audit has these places among the others, so that what
it says depends less on how much of the space is known to be free.
If the floor is known, a person must also be able to stand there, or to reach there at arm's length.

Cameras that look inward, around an object on a table or a statue, do not show where people stand.
The places then form the dome of the cameras around it.

Shape symbols: n cameras; m voxels; c places; p chosen places.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import Delaunay, KDTree

from r3jax.captures.ground import ground_of, is_free_at
from r3jax.captures.neighborhoods import divided
from r3jax.captures.survey import MARGIN, RANGE
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid, centers_on_host
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import spread
from r3jax.planning.robot.travel import safe_cells

_HEIGHTS = (5.0, 95.0)
"""Percentiles of the cameras' heights between which people hold them."""

_MOST_LATTICE = 40_000
"""Number of candidate places in the hull."""

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


_FEWEST = 24
"""With fewer places in free space, the cameras' own positions are added."""

_OVER = 4
"""At most one in this number of places is reached only at arm's length."""

_NEAR_PICTURES = 1.5
"""Standpoints in free space are at most this far from a camera's position [m]. A doorway that opens
in one grid and not in the next would otherwise add a room in which no picture was taken: in a
recording of 48 pictures it moved the share of surfaces seen well from 75 to 33 %."""

NUM_STANDPOINTS = 24
"""Maximum number of positions from which surfaces are evaluated."""


@dataclass(frozen=True)
class Places:
    """Places that are searched for views, each far from those before it; standing places first."""

    eyes: np.ndarray
    """Positions of the camera, [p, 3] [audit units]."""

    feet: np.ndarray
    """Where a person stands to hold the camera there, [p, 3] [audit units]; NaN if not known."""

    num_standing: int
    """Number of places above the person's feet, which come first; the others are reached at arm's
    length."""

    is_checked: bool
    """False if the floor is not known: then standing was not checked."""

    standpoints: np.ndarray
    """Positions from which surfaces are evaluated, [q, 3] [audit units]: above a person's feet and,
    in free space, near a picture."""

    @property
    def seen_from(self) -> str:
        """Description of the surface evaluated from the standpoints, for reports."""
        if self.is_checked:
            return "the surface visible from where a person could stand near the pictures"
        return "the surface visible from around the cameras"

    @property
    def standing(self) -> np.ndarray:
        """Places above the person's feet, [q, 3]; all places if the floor is not known."""
        return self.eyes[: self.num_standing]


def places_of(
    state: MapState,
    grid: OccupancyGrid,
    cameras: np.ndarray,
    num: int,
    *,
    is_dense: bool,
    meter: float | None,
    center: np.ndarray | None = None,
    with_cameras: bool = False,
    num_standpoints: int = NUM_STANDPOINTS,
) -> Places:
    """Spreads places where a person could hold a camera, and standpoints among them.

    Args:
        state: the map of the capture.
        grid: free and occupied space.
        cameras: camera positions, [n, 3] [audit units].
        num: maximum number of places.
        is_dense: True if depth images show where space is free.
        meter: length of a meter [audit units]; None if the capture's unit is not known.
        center: center of an object that the cameras surround; None if there is none.
        with_cameras: True to have the cameras' own positions among the places, but for a dome.
        num_standpoints: maximum number of standpoints in a place of up to 20 m; larger places have
            more, by the number of their neighborhoods.

    Returns:
        Places in known free space; if there are few, also the cameras' own positions.
    """
    voxels = np.asarray(state.center, np.float64).T[np.asarray(state.occupied)]
    if center is not None:
        found = places_on_dome(cameras, center, voxels)
    elif is_dense:
        found = places_in_free_space(grid, cameras)
    else:
        found = places_in_hull(cameras, voxels)
        found = found[is_free_at(grid, found)]
    if (with_cameras and center is None) or len(found) < _FEWEST:
        found = np.concatenate([found, cameras])
    is_walked = is_dense and center is None
    ground = ground_of(grid, voxels, cameras, meter) if is_walked else None
    footing = None if ground is None else ground.footing(found)
    reach = _NEAR_PICTURES * (meter or 1.0) if is_walked else np.inf
    if footing is None or footing.is_over.all():
        eyes = found[spread(found, num)]
        standpoints = _standpoints(found, cameras, reach, num_standpoints)
        return Places(eyes, np.full_like(eyes, np.nan), len(eyes), False, standpoints)
    standing = np.flatnonzero(~footing.is_over)
    standpoints = _standpoints(found[standing], cameras, reach, num_standpoints)
    reached = np.flatnonzero(footing.is_over & footing.is_reached)
    few = min(num // _OVER, len(reached))
    standing = standing[spread(found[standing], num - few)]
    if few:
        reached = reached[spread(found[reached], few)]
    rows = np.concatenate([standing, reached[:few]])
    return Places(found[rows], footing.feet[rows], len(standing), True, standpoints)


def _standpoints(standing: np.ndarray, cameras: np.ndarray, reach: float, num: int) -> np.ndarray:
    """Spreads standpoints over the places [c, 3] within reach of a camera [n, 3], if there are any.

    Returns:
        [q, 3], q >= 1.
    """
    near = standing[np.asarray(KDTree(cameras).query(standing)[0]) <= reach]
    chosen = near if len(near) else standing
    return chosen[spread(chosen, as_dense(num, cameras))]


def as_dense(num: int, cameras: np.ndarray) -> int:
    """Returns a number of places for a house of 20 m, or proportionally more for a larger place.

    In 256 rooms, 24 places would judge a tenth of them.

    Args:
        num: the number for a house.
        cameras: camera positions, [n, 3] [audit units].
    """
    return num * max(1, round(len(divided(cameras, RANGE)) / _CUBES))


_CUBES = 16
"""Neighborhoods in a house of 20 m."""

_INWARD = 0.85
"""Minimum share of the cameras that look at the center of an object."""

_ASIDE = 0.35
"""A camera looks at the center if its axis passes within this share of its distance."""

_AROUND = 60.0
"""Minimum angle between the directions of at least two cameras [deg]."""

_WITHIN = 0.7
"""Half of the points seen lie within this share of the cameras' distance from the center."""

_DOME = 400
"""Number of candidate directions on the dome."""


def inward_center(poses: np.ndarray, points: np.ndarray) -> np.ndarray | None:
    """Finds the center of an object that the cameras surround, [3]; None if there is none.

    Args:
        poses: `T_world_camera`, [n, 4, 4].
        points: points on surfaces, [m, 3] in the same coordinates.
    """
    eye, axis = poses[:, :3, 3], poses[:, :3, 2]
    # The point nearest to all axes: sum of (1 - a a^T) (c - eye) = 0.
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    total = across.sum(axis=0)
    if len(poses) < 3 or np.linalg.cond(total) > 1e6:
        return None
    center = np.linalg.solve(total, np.einsum("nij,nj->i", across, eye))
    offset = center - eye
    ahead = (offset * axis).sum(axis=1)
    aside = np.linalg.norm(offset - ahead[:, None] * axis, axis=1)
    looks = (ahead > 0.0) & (aside <= _ASIDE * np.maximum(ahead, 1e-9))
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    toward = offset / distance[:, None]
    is_round = float((toward @ toward.T).min()) <= np.cos(np.radians(_AROUND))
    if looks.mean() < _INWARD or not is_round or not len(points):
        return None
    size = float(np.median(np.linalg.norm(points - center, axis=1)))
    return center if size <= _WITHIN * float(np.median(distance)) else None


def places_on_dome(cameras: np.ndarray, center: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """Lists places around an object at the distance of its cameras, not below the lowest, [c, 3].

    Args:
        cameras: camera positions, [n, 3] [audit units].
        center: center of the object, [3].
        voxels: centers of all voxels, [m, 3], m >= 1.
    """
    offset = cameras - center
    distance = np.linalg.norm(offset, axis=1)
    lowest = float((offset[:, 2] / np.maximum(distance, 1e-9)).min())
    directions = fibonacci_lattice(_DOME)
    directions = directions[directions[:, 2] >= lowest - 0.05]
    places = center + float(np.median(distance)) * directions
    apart, _ = KDTree(voxels).query(places)
    return places[np.asarray(apart) >= MARGIN]


def places_in_free_space(grid: OccupancyGrid, cameras: np.ndarray) -> np.ndarray:
    """Finds the centers of the free cells where a camera could be held, [c, 3] [audit units].

    Args:
        grid: free and occupied space.
        cameras: camera positions, [n, 3] [audit units].
    """
    cell = float(grid.cell_size)
    safe = safe_cells(np.asarray(grid.free), cell, MARGIN)
    labels = np.zeros(safe.shape, dtype=np.int32)
    ndimage.label(safe, output=labels)
    cells = np.argwhere(safe)
    if not len(cells):
        return np.zeros((0, 3))
    centers = centers_on_host(grid, cells)
    # A camera near a wall is in a cell that is not safe: use the nearest safe cell.
    distance, nearest = KDTree(centers).query(cameras)
    close = cells[np.asarray(nearest)[np.asarray(distance) <= 2.0 * MARGIN + cell]]
    if not len(close):
        return np.zeros((0, 3))
    is_reached = np.isin(labels[tuple(cells.T)], np.unique(labels[tuple(close.T)]))
    low, high = np.percentile(cameras[:, 2], _HEIGHTS)
    is_held = (centers[:, 2] >= low - MARGIN) & (centers[:, 2] <= high + MARGIN)
    return centers[is_reached & is_held]


def places_in_hull(cameras: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """Finds places between the cameras, away from all voxels, [c, 3] [audit units].

    Args:
        cameras: camera positions, [n, 3].
        voxels: centers of all voxels, [m, 3], m >= 1.
    """
    # The hull of boxes around the cameras includes the margin and is never flat.
    boxes = (cameras[:, None, :] + MARGIN * _CORNERS).reshape(-1, 3)
    low, high = boxes.min(axis=0), boxes.max(axis=0)
    spacing = max(0.5 * MARGIN, float(np.cbrt(np.prod(high - low) / _MOST_LATTICE)))
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = lattice[Delaunay(boxes).find_simplex(lattice) >= 0]
    if not len(inside):
        return inside
    distance, _ = KDTree(voxels).query(inside)
    return inside[np.asarray(distance) >= MARGIN]
