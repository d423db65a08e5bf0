"""The best few candidates climb: each may give way to a better view near it.

Candidates are drawn by chance, and a panorama knows directions to 10 degrees. From the best few the
utility is climbed over position and direction (`planning.climb`), on a smooth stand-in
(`scoring.soft`), within a box of free space (`planning.free_box`). Where a climb ends becomes the
nearest view that the carrier may take; and then the exact utility decides: a view replaces its
start only if it is worth more, both alone and net of the way. On the host; scores are jitted.

Shape symbols: C candidates; K starts, always `config.refine`, so that climbing compiles once.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from r3jax.planning.candidates import poses_along
from r3jax.planning.climb import Starts, climb
from r3jax.planning.config import PlannerConfig
from r3jax.planning.free_box import free_box
from r3jax.planning.situation import Situation
from r3jax.scoring.batch import score_views_near
from r3jax.scoring.gather import gather_in_range

Weigh = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From utilities and paths [K] what views are worth net of the way, by a measure that other
candidates do not change."""

_STILL = 1e-3
"""Boxes that are no larger leave nothing to climb but directions [m]."""


def refine_best(
    situation: Situation,
    poses: np.ndarray,
    utilities: dict[str, np.ndarray],
    config: PlannerConfig,
    weigh: Weigh,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Replaces the best few candidates by what lies up the slope, where that is better.

    Args:
        situation: what is known.
        poses: the candidates [C, 4, 4], within the carrier's limits.
        utilities: [C] each; `utility` and `path` among them.
        config: how many, how far.
        weigh: by what they are the best.

    Returns:
        Candidates and utilities; of those replaced, utilities rise by what the exact utility says
        of the view and its start.
    """
    chosen = _best(poses, weigh(utilities["utility"], utilities["path"]), config.refine)
    if len(chosen) == 0:
        return poses, utilities
    starts, travel, limits = poses[chosen], situation.travel, situation.limits
    boxes = [free_box(travel, pose[:3, 3], config.refine_radius) for pose in starts]
    low, high = (np.stack(corners) for corners in zip(*boxes, strict=True))
    scoring, camera = config.scoring, situation.camera
    corners = jnp.asarray(np.concatenate([low, high]), dtype=jnp.float32)
    voxels, cells, _ = gather_in_range(
        situation.map_state, situation.scoring_grid, corners, scoring
    )
    elevations = np.tile(np.radians(limits.motion.elevations), (len(starts), 1))
    fields = (jnp.asarray(x, dtype=jnp.float32) for x in (starts, low, high, elevations))
    moves = bool(np.any(high - low > _STILL))
    ends = climb(voxels, cells, camera, scoring, Starts(*fields), moves=moves)
    numbers = np.asarray(ends, dtype=np.float64)
    # float32 rounds: the box is kept to the last bit here, and the directions below.
    positions = np.clip(numbers[:, :3], low, high)
    climbed = limits.project_to_feasible(poses_along(positions, _directions(*numbers[:, 3:].T)))
    both = jnp.asarray(np.concatenate([starts, climbed]), dtype=jnp.float32)
    exact = score_views_near(voxels, cells, camera, both, scoring)
    gains = {
        name: np.diff(np.asarray(values, np.float64).reshape(2, -1), axis=0)[0]
        for name, values in (
            ("utility", exact.total),
            ("exploration", exact.exploration),
            ("rendering", exact.rendering),
        )
    }
    path = limits.path_costs(travel.lengths(climbed[:, :3, 3]), climbed)
    utility, before = utilities["utility"][chosen], utilities["path"][chosen]
    is_better = gains["utility"] > 0.0
    is_better &= weigh(utility + gains["utility"], path) > weigh(utility, before)
    taken = chosen[is_better]
    refined = poses.copy()
    refined[taken] = climbed[is_better]
    found = {name: values.copy() for name, values in utilities.items()}
    found["path"][taken] = path[is_better]
    for name in gains.keys() & found.keys():
        found[name][taken] += gains[name][is_better]
    return refined, found


def _best(poses: np.ndarray, total: np.ndarray, num: int) -> np.ndarray:
    """Indices of the `num` best, no view twice while there are others; none if none can be reached.

    Candidates repeat where places are few.
    """
    ranked = np.argsort(-total, kind="stable")
    ranked = ranked[np.isfinite(total[ranked])]
    views = poses[ranked].reshape(-1, 16)
    _, first = np.unique(views, axis=0, return_index=True)
    distinct = ranked[np.sort(first)][:num]
    return distinct[np.arange(num) % len(distinct)] if len(distinct) else distinct


def _directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
