"""The classical explorer: go to the nearest place from which the unknown begins, and look.

A frontier cell that was looked at once is left alone until all others were: some, before a
window or behind a chair, never turn into known space.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.spatial import KDTree

from r3jax.mapping.occupancy import OccupancyGrid, frontier
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import VIEW_DISTANCE, host_generator, in_plain_view, poses_along
from r3jax.planning.decision import PlannerState, Stopwatch, look_round, settle
from r3jax.planning.greedy import GreedyPolicy
from r3jax.planning.policies.random import Random
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.travel import Travel

_MAX_TARGETS = 300
"""Frontier cells that are considered per decision, drawn at random."""

_STOPS_PER_TARGET = 4
"""Places that are tried per frontier cell: the nearest by path among its neighbours."""

_ATTEMPT_COSINE = 0.9
_ATTEMPT_REACH = 3.0
"""Frontier cells within 26 degrees of the line of sight and 3 m count as looked at too: they lie
inside the picture of any camera with 52 degrees or more."""


@dataclass(frozen=True)
class Frontier(GreedyPolicy):
    """The nearest view of a frontier cell by path length; random views when none is left."""

    name = "frontier"
    source = "Yamauchi, CIRA 1997: the nearest frontier"

    def decide(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """A view of the nearest frontier; `total` is minus the path length."""
        stopwatch, config = Stopwatch(), self.config
        target_key, random_key = jax.random.split(key)
        with stopwatch.part("travel"):
            looked, travel, masked = look_round(state, map_state, grid, T_world_camera, config)
        with stopwatch.part("candidates"):
            targets = np.asarray(frontier(masked))
            attempted = np.asarray(state.attempted)
            if not np.any(targets & ~attempted):
                attempted = np.zeros_like(attempted)
            stops, aims = nearest_views(
                travel, targets & ~attempted, config.num_candidates, key=target_key
            )
        if len(stops) == 0:
            everything = Random(config)
            return everything.decide(state, map_state, grid, T_world_camera, key=random_key)
        with stopwatch.part("candidates"):
            # Always as many as can be asked for, so that nothing compiles again.
            padding = np.arange(config.num_candidates) % len(stops)
            poses = poses_along(stops[padding], (aims - stops)[padding])[: len(stops)]
        with stopwatch.part("travel"):
            path = travel.lengths(stops)
        utilities = {"path": path, "total": -path}
        decision, state, info = settle(looked, travel, poses, utilities, stopwatch)
        chosen = np.argmin(path)
        centers = travel.centers(np.moveaxis(np.indices(targets.shape), 0, -1))
        looked_at = attempted | _is_looked_at(centers, stops[chosen], aims[chosen])
        state = eqx.tree_at(lambda s: s.attempted, state, jnp.asarray(looked_at))
        return decision, state, info


def _is_looked_at(centers: np.ndarray, place: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """Which cells a view from `place` to `aim` shows, walls left aside: [X, Y, Z] bool."""
    offset, axis = centers - place, aim - place
    distance = np.linalg.norm(offset, axis=-1)
    along = offset @ (axis / np.linalg.norm(axis))
    return (along >= _ATTEMPT_COSINE * distance) & (distance <= _ATTEMPT_REACH)


def nearest_views(
    travel: Travel, targets: np.ndarray, num: int, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Up to `num` places from which a target cell is in plain view, nearest by path first.

    Args:
        travel: where the robot may stop, and how far that is.
        targets: free cells to look at, [X, Y, Z] bool.
        num: places wanted.
        key: draws the targets that are considered, if there are very many.

    Returns:
        Places and the targets' centres, [n, 3] float64 each [m], n <= num.
    """
    cells, stops = np.argwhere(targets), np.argwhere(travel.goals)
    if len(cells) == 0 or len(stops) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    if len(cells) > _MAX_TARGETS:
        cells = host_generator(key).choice(cells, size=_MAX_TARGETS, replace=False)
    closest, farthest = VIEW_DISTANCE
    places, aims = travel.centers(stops), travel.centers(cells)
    count = min(64, len(stops))
    distance, index = KDTree(places).query(aims, k=count, distance_upper_bound=farthest)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    is_allowed = (distance >= closest) & (distance <= farthest)
    cost = np.append(travel.cost[tuple(stops.T)], np.inf)[index]  # index of nothing: len(stops)
    cost = np.where(is_allowed, cost, np.inf)
    best = np.argsort(cost, axis=1)[:, :_STOPS_PER_TARGET]
    aim_index = np.repeat(np.arange(len(cells)), best.shape[1])
    index, cost = (np.take_along_axis(a, best, axis=1).ravel() for a in (index, cost))
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for pair in np.argsort(cost, kind="stable"):
        if not np.isfinite(cost[pair]) or len(found) == num:
            break
        place, aim = places[index[pair]], aims[aim_index[pair]]
        if in_plain_view(travel, place, aim):
            found.append((place, aim))
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3))
    return np.stack([place for place, _ in found]), np.stack([aim for _, aim in found])
