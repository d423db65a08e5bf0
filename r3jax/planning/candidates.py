"""Candidate views, and the positions that they are drawn from. On the host: NumPy.

Positions lie in cells where the robot may stop (`Travel.goals`), away from the cell's faces: at
most a quarter of a cell from its center.

Shape symbols: X Y Z cells along the axes; C candidates; n positions; c positions to choose from; p
positions chosen.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import pose_along
from r3jax.mapping.occupancy import OccupancyGrid, frontier
from r3jax.planning.config import PlannerConfig
from r3jax.planning.robot.travel import Travel, segment_is_inside

JITTER = 0.25
"""Positions lie at most this far from their cell's center, along each axis [cells]."""

_NEIGHBORS = 256
"""A region of interest is viewed from one of this number of nearest cells."""

_poses_along = jax.jit(jax.vmap(pose_along))  # compiled once per number of candidates

_AHEAD = (1.0, 0.0, 0.0)
"""Placeholder direction of a candidate whose direction the panorama will choose."""

VIEW_DISTANCE = (0.3, 2.0)
"""Minimum and maximum distance from which a region of interest is viewed [m] (Active-GS)."""


class Candidates(eqx.Module):
    """Candidate views without roll.

    Every decision of a run scores the same number of candidates, so that scoring compiles once: if
    fewer can be drawn, `padded` adds invalid rows.
    """

    position: Float[np.ndarray, "C 3"]
    """Camera centers in the world [m]; float64, because paths end exactly there."""

    direction: Float[np.ndarray, "C 3"]
    """Viewing directions, world, of any length but 0 (normalizing would round them)."""

    valid: Bool[np.ndarray, " C"]
    """False for padding, which repeats valid views and is never chosen."""

    @property
    def axis(self) -> Float[np.ndarray, "C 3"]:
        """Viewing directions as unit vectors."""
        # Computed on demand: the directions themselves keep their bits.
        return self.direction / np.linalg.norm(self.direction, axis=1, keepdims=True)

    @property
    def num_valid(self) -> int:
        """Number of valid views."""
        return int(np.count_nonzero(self.valid))

    @property
    def T_world_camera(self) -> Float[np.ndarray, "C 4 4"]:
        """Poses for the host, float64, at exactly these positions."""
        return poses_along(self.position, self.direction)

    def poses_on_device(self) -> Float[Array, "C 4 4"]:
        """Returns the poses for scoring, in float32."""
        return _poses_along(
            jnp.asarray(self.position, dtype=jnp.float32),
            jnp.asarray(self.direction, dtype=jnp.float32),
        )

    def take(self, index: np.ndarray) -> "Candidates":
        """Gathers rows by index or mask."""
        return jax.tree.map(lambda x: x[index], self)

    def padded(self, num: int) -> "Candidates":
        """Repeats rows up to `num` in total; the repeats are not valid. Zero rows stay zero."""
        if not len(self.valid):
            return self
        rows = np.arange(num)
        # Repeats, not zeros: padding must not enlarge the box from which voxels are gathered.
        repeated = self.take(rows % len(self.valid))
        return eqx.tree_at(lambda c: c.valid, repeated, repeated.valid & (rows < len(self.valid)))


def candidates_along(positions: np.ndarray, directions: np.ndarray) -> Candidates:
    """Makes candidates at positions [C, 3] that look along directions [C, 3] of any length."""
    return Candidates(positions, directions, np.ones(len(positions), dtype=bool))


def candidates_at(positions: np.ndarray) -> Candidates:
    """Makes candidates at positions [C, 3] whose directions are not chosen yet."""
    return candidates_along(positions, np.tile(_AHEAD, (len(positions), 1)))


def host_generator(key: Array) -> np.random.Generator:
    """Makes NumPy's generator, seeded by a JAX key.

    Host code draws many small arrays of odd sizes.
    """
    # Takes both kinds of JAX keys: arrays of words, and typed keys.
    is_typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return np.random.default_rng(np.asarray(jax.random.key_data(key) if is_typed else key))


def random_views(
    travel: Travel, scoring_grid: OccupancyGrid, config: PlannerConfig, *, key: Array
) -> Candidates:
    """Draws C views: local ones in random directions, those for the frontier towards it."""
    position_key, direction_key = jax.random.split(key)
    positions, aims = draw_positions(travel, scoring_grid, config, key=position_key)
    directions = random_directions(len(positions), key=direction_key)
    # Directions are drawn for all rows, so that recorded runs can be repeated.
    is_aimed = np.isfinite(aims[:, :1])
    drawn = candidates_along(positions, np.where(is_aimed, aims - positions, directions))
    return drawn.padded(config.num_candidates)


def random_places(
    travel: Travel, scoring_grid: OccupancyGrid, config: PlannerConfig, *, key: Array
) -> Candidates:
    """Draws the positions of `random_views` for a score that finds the directions."""
    # The same half of the key as in `random_views`: both draw the same positions.
    position_key, _ = jax.random.split(key)
    positions, _ = draw_positions(travel, scoring_grid, config, key=position_key)
    return candidates_at(positions).padded(config.num_candidates)


def free_views(travel: Travel, num: int, radius: float, *, key: Array) -> Candidates:
    """Draws `num` views in random directions from safe positions within `radius` of the robot.

    Returns:
        `num` candidates; none if the robot cannot stop anywhere.
    """
    position_key, direction_key = jax.random.split(key)
    positions = local_random(travel, num, radius, key=position_key)
    directions = random_directions(len(positions), key=direction_key)
    return candidates_along(positions, directions)


def draw_lots(num: int, *, key: Array) -> dict[str, np.ndarray]:
    """Draws a random score for each candidate (the random policy; elsewhere a tie-breaker)."""
    return {"lot": host_generator(key).random(num)}


def draw_positions(
    travel: Travel, scoring_grid: OccupancyGrid, config: PlannerConfig, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Draws n positions: up to `num_frontier` in sight of the frontier, the others local.

    Args:
        travel: where the robot can go.
        scoring_grid: the grid without hopeless unexplored cells (`mask_unexplorable`).
        config: number and radius.
        key: source of randomness.

    Returns:
        Positions [n, 3] and the frontier cell of each [n, 3] (NaN for local ones), float64 [m];
        fewer than `num_candidates` if there is no local one, [0, 3] if the robot cannot stop
        anywhere.
    """
    frontier_key, local_key = jax.random.split(key)
    # Of the masked grid: a boundary that cannot be crossed is not a frontier.
    targets = np.asarray(frontier(scoring_grid))
    positions, aims = region_of_interest(travel, targets, config.num_frontier, key=frontier_key)
    # What the frontier leaves goes to local positions: every decision scores the same number.
    num = config.num_candidates - len(positions)
    new = new_places(travel, num // 2, key=local_key)
    local = local_random(travel, num - len(new), config.radius, key=local_key)
    local = np.concatenate([new, local])
    # Local views have no aim; NaN keeps the two arrays row by row alike.
    aims = np.concatenate([aims, np.full_like(local, np.nan)])
    return np.concatenate([positions, local]), aims


def local_random(travel: Travel, num: int, radius: float = 0.5, *, key: Array) -> np.ndarray:
    """Draws `num` positions, uniform over the safe, reachable cells within `radius` of the robot.

    The cells are those with their center within the radius, and the robot's own (if it is known
    to be free). Several positions may share a cell. If the robot's own cell does not keep the
    safety margin, the only position in it is the present one.

    Returns:
        [num, 3] float64 [m]; [0, 3] if there is no such cell.
    """
    rng = host_generator(key)
    # Drawn by cell, which works for free space of any shape.
    cells = np.argwhere(travel.goals)
    # With a small radius even the center of the robot's own cell may lie outside of it.
    is_own = np.all(cells == np.array(travel.start_cell), axis=1)
    offset = travel.centers(cells) - travel.start
    is_near = is_own | (np.linalg.norm(offset, axis=1) <= radius)
    cells, is_own = cells[is_near], is_own[is_near]
    if len(cells) == 0:
        return np.zeros((0, 3))
    # With replacement: near walls there may be fewer cells than candidates.
    chosen = rng.integers(len(cells), size=num)
    # Stop positions, not centers: a robot with a range of heights cannot be at every center.
    centers = travel.stops(cells[chosen])
    positions = _jitter(centers, travel.cell_size, rng)
    is_far = np.linalg.norm(positions - travel.start, axis=1) > radius
    # Jitter may leave the radius; the center of the cell does not.
    positions[is_far] = centers[is_far]
    # In a cell without the margin, only the present position is known to fit.
    if not travel.safe[travel.start_cell]:
        positions[is_own[chosen]] = travel.start
    return positions


def new_places(travel: Travel, num: int, *, key: Array) -> np.ndarray:
    """Draws up to `num` positions from the nearest columns where the robot has not been.

    Returns:
        [n, 3] float64 [m]; none where it does not matter (`Travel.fresh`).
    """
    if travel.fresh is None:
        return np.zeros((0, 3))
    rng = host_generator(jax.random.fold_in(key, 1))
    cells = np.argwhere(travel.goals & travel.fresh[:, :, None])
    if not len(cells):
        return np.zeros((0, 3))
    near = np.argsort(travel.cost[tuple(cells.T)], kind="stable")[:_NEIGHBORS]
    return travel.stops(cells[near[rng.integers(len(near), size=num)]])


def region_of_interest(
    travel: Travel, targets: np.ndarray, num: int, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Draws up to `num` positions from which randomly drawn target cells are in plain view.

    For every draw a target is taken at random, and one of the nearest cells where the robot may
    stop that lie 0.3 to 2 m from it; the straight line between them must be known free. Large
    target regions are drawn more often.

    Args:
        travel: where the robot may stop.
        targets: free cells to view, such as the frontier, [X, Y, Z] bool.
        num: number of positions.
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
        cells = _stops_round(travel, target)
        if len(cells) == 0:
            continue
        stop = travel.stops(cells[rng.integers(len(cells))])
        position = _jitter(stop, travel.cell_size, rng)
        if in_plain_view(travel, position, aim):
            positions.append(position)
            aims.append(aim)
    return np.reshape(positions, (-1, 3)), np.reshape(aims, (-1, 3))


def _stops_round(travel: Travel, target: np.ndarray) -> np.ndarray:
    """Finds the nearest cells to stop in, at a distance from which to view `target`.

    Searches a window around the target only: the cost does not grow with the scene.

    Returns:
        Indices of cells, [n, 3], n <= 256.
    """
    # Lazy import: Numba is only loaded when a path is planned.
    from r3jax.kernels.robot.cells import nearest_in_ring

    reach = int(np.ceil(VIEW_DISTANCE[1] / travel.cell_size))
    # Filtered after taking the nearest, so that a near wall leaves few positions, not far ones.
    return nearest_in_ring(
        travel.goals, target, reach, travel.cell_size, *VIEW_DISTANCE, _NEIGHBORS
    )


def spread(places: np.ndarray, num: int) -> np.ndarray:
    """Selects up to `num` positions, each the farthest from those before (Gonzalez 1985).

    The first is the one nearest to the middle of all, which does not depend on their order, except
    for ties.

    Args:
        places: [c, 3], c >= 1.
        num: p at most.
    """
    # The middle, not a random position: the choice must not depend on a seed or an order.
    first = int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    chosen = [first]
    gap = np.linalg.norm(places - places[first], axis=1)
    while len(chosen) < min(num, len(places)):
        farthest = int(np.argmax(gap))
        if gap[farthest] <= 0.0:
            break  # the rest are repeats
        chosen.append(farthest)
        # Only the newest position can reduce a distance: p passes over c positions, no table of all
        # pairs.
        gap = np.minimum(gap, np.linalg.norm(places - places[farthest], axis=1))
    return np.asarray(chosen)


def in_plain_view(travel: Travel, a: np.ndarray, b: np.ndarray) -> bool:
    """Checks whether the straight line between two positions [m] lies in known free space."""
    scale = travel.cell_size
    return segment_is_inside(travel.free, (a - travel.origin) / scale, (b - travel.origin) / scale)


def random_directions(num: int, *, key: Array) -> np.ndarray:
    """Draws `num` directions uniform on the sphere, [num, 3] float64.

    Not bounded in elevation: floors and ceilings are part of the scene, and test views look
    straight up and down too.
    """
    # Normalized normal vectors are uniform; uniform angles would cluster at the poles.
    directions = host_generator(key).normal(size=(num, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def poses_along(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Makes roll-free poses [n, 4, 4] float64 at positions [n, 3] along directions [n, 3]."""
    # The function that scoring uses: another formula would differ in the last bits.
    poses = _poses_along(
        jnp.asarray(positions, dtype=jnp.float32), jnp.asarray(directions, dtype=jnp.float32)
    )
    exact = np.array(poses, dtype=np.float64)
    exact[:, :3, 3] = positions  # not rounded to float32: paths end exactly there
    return exact


def best_views(candidates: Candidates, panorama: Any) -> tuple[Candidates, np.ndarray]:
    """Turns candidates along the best directions of their panoramas.

    Args:
        candidates: positions that were scored.
        panorama: their `scoring.panorama.Panorama`, fields of shape [C, ...].

    Returns:
        The candidates, and the scores of those directions, [C] float64.
    """
    # Not normalized again: the pose is then bit-identical to the scored one.
    direction = np.asarray(panorama.best_direction, dtype=np.float64)
    turned = eqx.tree_at(lambda c: c.direction, candidates, direction)
    return turned, np.asarray(panorama.best_score, dtype=np.float64)


def path_lengths(travel: Travel, candidates: Candidates) -> np.ndarray:
    """Computes the path length to each candidate, [C] [m]; inf without a path and for padding."""
    # Padding is skipped: it is never chosen, and each length takes a walk through the grid.
    lengths = np.full(len(candidates.valid), np.inf)
    lengths[candidates.valid] = travel.lengths(candidates.position[candidates.valid])
    return lengths


def _jitter(centers: np.ndarray, cell_size: float, rng: np.random.Generator) -> np.ndarray:
    return centers + rng.uniform(-JITTER, JITTER, size=centers.shape) * cell_size
