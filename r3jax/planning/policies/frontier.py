"""Frontier exploration: goes to the nearest view of the boundary to unknown space.

A frontier cell that was viewed once is not viewed again before all others: some, in front of a
window or behind a chair, never become known.
"""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array
from scipy.spatial import KDTree

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, frontier
from r3jax.planning.candidates import (
    VIEW_DISTANCE,
    Candidates,
    candidates_along,
    draw_lots,
    free_views,
    host_generator,
    in_plain_view,
)
from r3jax.planning.decide import Drawn, GreedyPolicy, Scored
from r3jax.planning.policy import Situation
from r3jax.planning.robot.limits import UNBOUND, Limits
from r3jax.planning.robot.travel import Travel

_MAX_TARGETS = 300
"""Maximum number of frontier cells per decision, drawn at random."""

_STOPS_PER_TARGET = 4
"""Number of positions tried per frontier cell: the nearest by path among its neighbors."""

_ATTEMPT_COSINE = 0.9
_ATTEMPT_REACH = 3.0
"""Frontier cells within 26 degrees of the viewing direction and 3 m count as viewed, too: they are
in the image of any camera with a field of view of 52 degrees or more."""


@dataclass(frozen=True)
class Frontier(GreedyPolicy):
    """The nearest view of a frontier cell by path length; random views when none is left."""

    name = "frontier"
    source = "Yamauchi, CIRA 1997: the nearest frontier"
    memory_by_cell = True

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> np.ndarray:
        """Returns the frontier cells viewed so far, [X, Y, Z] bool: none."""
        del camera
        return np.zeros(grid.log_odds.shape, dtype=bool)

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws views of the nearest frontier cells that were not viewed yet.

        If there are none, random nearby views are drawn. The notes are True if views of the
        frontier were found.
        """
        target_key, random_key = jax.random.split(key)
        num = self.config.num_candidates
        targets, attempted = np.asarray(frontier(situation.scoring_grid)), situation.memory
        # All were viewed: start over, since the map has changed.
        if not np.any(targets & ~attempted):
            attempted = np.zeros_like(attempted)
        fresh = targets & ~attempted
        stops, aims = nearest_views(situation.travel, fresh, num, situation.limits, key=target_key)
        if len(stops) == 0:
            # The memory stays: random views do not aim at the frontier.
            anywhere = free_views(situation.travel, num, self.config.radius, key=random_key)
            return Drawn(anywhere, situation.memory, notes=False)
        return Drawn(candidates_along(stops, aims - stops).padded(num), attempted, notes=True)

    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Returns equal scores, so that the path decides; random ones without a frontier."""
        lots = {} if situation.notes else draw_lots(len(candidates.valid), key=key)
        return candidates, lots

    def score_again(
        self, situation: Situation, candidates: Candidates, *, before: np.ndarray, key: Array
    ) -> Scored:
        """Keeps the order of the candidates, whose target cells are no longer known."""
        del situation, key
        return candidates, {"lot": before}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the negative path length, or random scores."""
        return utilities.get("lot", -utilities["path"])

    def weigh_far(self, near: dict[str, np.ndarray], far: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the negative path lengths; random views only count without any frontier."""
        own = -near["path"] if near else np.zeros(0)
        return np.concatenate([np.full_like(own, -np.inf) if "lot" in near else own, -far["path"]])

    def conclude(
        self,
        situation: Situation,
        candidates: Candidates,
        utilities: dict[str, np.ndarray],
        best: int,
    ) -> Any:
        """Marks the cells as viewed that the chosen view of the frontier shows."""
        del utilities
        if not situation.notes:
            return situation.memory
        cells = np.moveaxis(np.indices(situation.memory.shape), 0, -1)
        centers = situation.travel.centers(cells)
        # The pose, not the direction: lines to cell centers lie on the border of the cone, and
        # recorded runs depend on its float32 rounding.
        pose = candidates.T_world_camera[best]
        return situation.memory | _is_looked_at(centers, pose)


def _is_looked_at(centers: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """Finds the cells that a view shows, ignoring walls, [X, Y, Z] bool."""
    offset = centers - T_world_camera[:3, 3]
    distance = np.linalg.norm(offset, axis=-1)
    along = offset @ T_world_camera[:3, 2]
    return (along >= _ATTEMPT_COSINE * distance) & (distance <= _ATTEMPT_REACH)


def _may_look(limits: Limits, place: np.ndarray, aim: np.ndarray) -> bool:
    """Checks whether the nearest allowed view from a position shows the target."""
    # Never 0 / 0: positions nearer than `VIEW_DISTANCE` were dropped before.
    direction = (aim - place) / np.linalg.norm(aim - place)
    return bool(limits.nearness(place[None], direction[None])[0] >= _ATTEMPT_COSINE)


def nearest_views(
    travel: Travel,
    targets: np.ndarray,
    num: int,
    limits: Limits = UNBOUND,
    *,
    key: Array,
) -> tuple[np.ndarray, np.ndarray]:
    """Finds up to `num` positions with a free line to a target cell, nearest by path first.

    Args:
        travel: positions to stop at, and path lengths to them.
        targets: free cells to view, [X, Y, Z] bool.
        num: number of positions.
        limits: of the robot; the allowed view nearest to the target must still show it.
        key: for sampling targets, if there are very many.

    Returns:
        Positions and the targets' centers, [n, 3] float64 each [m], n <= num.
    """
    cells, stops = np.argwhere(targets), np.argwhere(travel.goals)
    if len(cells) == 0 or len(stops) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    # Hundreds of targets are enough to find the nearest; thousands take seconds.
    if len(cells) > _MAX_TARGETS:
        cells = host_generator(key).choice(cells, size=_MAX_TARGETS, replace=False)
    closest, farthest = VIEW_DISTANCE
    places, aims = travel.stops(stops), travel.centers(cells)
    # Many more than are tried: the nearest in a straight line may be far away by path.
    count = min(64, len(stops))
    distance, index = KDTree(places).query(aims, k=count, distance_upper_bound=farthest)
    # SciPy drops the axis of neighbors if only one is requested.
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    is_allowed = (distance >= closest) & (distance <= farthest)
    cost = np.append(travel.cost[tuple(stops.T)], np.inf)[index]  # index of nothing: len(stops)
    # Too near or too far to see the target counts as out of reach.
    cost = np.where(is_allowed, cost, np.inf)
    best = np.argsort(cost, axis=1)[:, :_STOPS_PER_TARGET]
    aim_index = np.repeat(np.arange(len(cells)), best.shape[1])
    index, cost = (np.take_along_axis(a, best, axis=1).ravel() for a in (index, cost))
    found: list[tuple[np.ndarray, np.ndarray]] = []
    # Nearest first, so that the expensive visibility test ends early.
    for pair in np.argsort(cost, kind="stable"):
        if not np.isfinite(cost[pair]) or len(found) == num:
            break
        place, aim = places[index[pair]], aims[aim_index[pair]]
        if _may_look(limits, place, aim) and in_plain_view(travel, place, aim):
            found.append((place, aim))
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3))
    return np.stack([place for place, _ in found]), np.stack([aim for _, aim in found])
