"""Where the next view could be taken from. On the host: NumPy.

Positions lie in cells where the robot may stop (`Travel.goals`), away from the cell's faces: at
most a quarter of a cell from its center.

Shape symbols: X Y Z cells along the axes; n candidates; c places to choose from; p places chosen.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.geometry.cameras import pose_along
from r3jax.planning.travel import Travel, segment_is_inside

JITTER = 0.25
"""Positions lie at most this far from their cell's center, along each axis [cells]."""

_NEIGHBORS = 256
"""A region of interest is looked at from one of this many nearest cells."""

_poses_along = jax.jit(jax.vmap(pose_along))  # compiled once per number of candidates

VIEW_DISTANCE = (0.3, 2.0)
"""A region of interest is looked at from between these distances [m] (Active-GS)."""


def host_generator(key: Array) -> np.random.Generator:
    """NumPy's generator, seeded by a JAX key: host code draws many small arrays of odd sizes."""
    is_typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return np.random.default_rng(np.asarray(jax.random.key_data(key) if is_typed else key))


def local_random(travel: Travel, num: int, radius: float = 0.5, *, key: Array) -> np.ndarray:
    """`num` positions uniform over the safe, reachable cells within `radius` of the robot.

    The cells are those with their center within the radius, and the robot's own (if it is known
    to be free). Several positions may share a cell. If the robot's own cell does not keep the
    safety margin, the only position in it is the present one.

    Returns:
        [num, 3] float64 [m]; [0, 3] if there is no such cell.
    """
    rng = host_generator(key)
    cells = np.argwhere(travel.goals)
    is_own = np.all(cells == np.array(travel.start_cell), axis=1)
    offset = travel.centers(cells) - travel.start
    is_near = is_own | (np.linalg.norm(offset, axis=1) <= radius)
    cells, is_own = cells[is_near], is_own[is_near]
    if len(cells) == 0:
        return np.zeros((0, 3))
    chosen = rng.integers(len(cells), size=num)
    centers = travel.stops(cells[chosen])
    positions = _jitter(centers, travel.cell_size, rng)
    is_far = np.linalg.norm(positions - travel.start, axis=1) > radius
    positions[is_far] = centers[is_far]
    if not travel.safe[travel.start_cell]:
        positions[is_own[chosen]] = travel.start
    return positions


def region_of_interest(
    travel: Travel, targets: np.ndarray, num: int, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Up to `num` positions from which randomly drawn target cells are in plain view.

    For every draw a target is taken at random, and one of the nearest cells where the robot may
    stop that lie 0.3 to 2 m from it; the straight line between them must be known free. Large
    target regions are drawn more often.

    Args:
        travel: where the robot may stop.
        targets: free cells worth looking at, such as the frontier, [X, Y, Z] bool.
        num: positions wanted.
        key: source of randomness.

    Returns:
        Positions and the targets' centers, [n, 3] float64 each [m], n <= num.
    """
    rng = host_generator(key)
    goals = np.argwhere(targets)
    positions, aims = [], []
    # Some draws end behind a corner: twice as many as wanted.
    drawn = goals[rng.integers(len(goals), size=2 * num)] if len(goals) else goals
    for target, aim in zip(drawn, travel.centers(drawn), strict=True):
        if len(positions) == num:
            break
        stops = travel.stops(_stops_round(travel, target))
        if len(stops) == 0:
            continue
        position = _jitter(stops[rng.integers(len(stops))], travel.cell_size, rng)
        if in_plain_view(travel, position, aim):
            positions.append(position)
            aims.append(aim)
    return np.reshape(positions, (-1, 3)), np.reshape(aims, (-1, 3))


def _stops_round(travel: Travel, target: np.ndarray) -> np.ndarray:
    """Of the nearest cells where the robot may stop, those at a distance to look at `target`.

    Asks a window round the target only: the work does not grow with the scene.

    Returns:
        Indices of cells, [n, 3], n <= 256.
    """
    closest, farthest = VIEW_DISTANCE
    reach = int(np.ceil(farthest / travel.cell_size))
    low = np.maximum(target - reach, 0)
    window = tuple(slice(a, b) for a, b in zip(low, target + reach + 1, strict=True))
    cells = np.argwhere(travel.goals[window]) + low
    distance = np.linalg.norm(cells - target, axis=1) * travel.cell_size
    nearest = np.argsort(distance, kind="stable")[:_NEIGHBORS]
    is_apart = (distance[nearest] >= closest) & (distance[nearest] <= farthest)
    return cells[nearest[is_apart]]


def lattice(travel: Travel, spacing: tuple[float, float, float] = (1.0, 1.0, 0.75)) -> np.ndarray:
    """Positions on a regular lattice that fall into cells where the robot may stop.

    Args:
        travel: where the robot may stop.
        spacing: distance between lattice points along x, y and z [m].

    Returns:
        [n, 3] float64 [m], each where the camera stands in its cell, no cell twice.
    """
    shape = travel.usable.shape
    axes = [
        np.arange(0.5 * step, n * travel.cell_size, step)
        for n, step in zip(shape, spacing, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # The nudge puts points that lie on a border of cells on the same side of it.
    cells = np.unique(np.floor(points / travel.cell_size + 1e-3).astype(np.int64), axis=0)
    cells = cells[np.all(cells < np.array(shape), axis=1)]
    return travel.stops(cells[travel.goals[tuple(cells.T)]])


def spread(places: np.ndarray, num: int) -> np.ndarray:
    """Indices of up to `num` places, each the farthest from those before (Gonzalez 1985).

    The first is the one nearest to the middle of all: it does not depend on their order, but for
    ties.

    Args:
        places: [c, 3], c >= 1.
        num: p at most.
    """
    first = int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    chosen = [first]
    gap = np.linalg.norm(places - places[first], axis=1)
    while len(chosen) < min(num, len(places)):
        farthest = int(np.argmax(gap))
        if gap[farthest] <= 0.0:
            break  # the rest repeats what is there
        chosen.append(farthest)
        gap = np.minimum(gap, np.linalg.norm(places - places[farthest], axis=1))
    return np.asarray(chosen)


def in_plain_view(travel: Travel, a: np.ndarray, b: np.ndarray) -> bool:
    """True if the straight line between two positions [m] runs through known free space."""
    scale = travel.cell_size
    return segment_is_inside(travel.free, (a - travel.origin) / scale, (b - travel.origin) / scale)


def random_directions(num: int, *, key: Array) -> np.ndarray:
    """`num` directions uniform on the sphere, [num, 3] float64.

    Not bounded in elevation: floors and ceilings are part of the scene, and test views look
    straight up and down too.
    """
    directions = host_generator(key).normal(size=(num, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def poses_along(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Roll-free poses at positions [n, 3] that look along directions [n, 3]; [n, 4, 4] float64."""
    poses = _poses_along(
        jnp.asarray(positions, dtype=jnp.float32), jnp.asarray(directions, dtype=jnp.float32)
    )
    exact = np.array(poses, dtype=np.float64)
    exact[:, :3, 3] = positions  # not rounded to float32: a path ends exactly there
    return exact


def best_views(positions: np.ndarray, panorama: Any) -> tuple[np.ndarray, np.ndarray]:
    """The views that look along the best directions of panoramas, and their scores.

    Args:
        positions: [n, 3] [m].
        panorama: their `scoring.panorama.Panorama`, fields of shape [n, ...].

    Returns:
        Poses [n, 4, 4] and scores [n], float64.
    """
    poses = np.array(panorama.T_world_camera, dtype=np.float64)
    poses[:, :3, 3] = positions  # not rounded to float32: a path ends exactly there
    return poses, np.asarray(panorama.best_score, dtype=np.float64)


def _jitter(centers: np.ndarray, cell_size: float, rng: np.random.Generator) -> np.ndarray:
    return centers + rng.uniform(-JITTER, JITTER, size=centers.shape) * cell_size
