"""The best few candidates climb: each may give way to a better view near it.

Candidates are drawn by chance, and a panorama knows directions to 10 degrees. From the best few the
utility is climbed over position and direction (`planning.refinement.climb`), on a smooth surrogate
(`scoring.surrogate`), within a box of free space: boxes are
convex, so that what climbs in one need not look out. Where a climb ends becomes the
nearest view that the robot may take; and then the exact utility decides: a view replaces its
start only if it is worth more, both alone and net of the way. On the host; scores are jitted.

Shape symbols: C candidates; K starts, always `config.refine`, so that climbing compiles once.
"""

import itertools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from r3jax.planning.candidates import JITTER, Candidates, path_lengths
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policy import Situation
from r3jax.planning.refinement.climb import Starts, climb
from r3jax.planning.robot.limits import directions_along
from r3jax.planning.robot.travel import Travel
from r3jax.scoring.batch import score_views_near
from r3jax.scoring.gather import gather_in_range

Weigh = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From utilities and paths [K] what views are worth net of the way, by a measure that other
candidates do not change."""

_STILL = 1e-3
"""Boxes that are no larger leave nothing to climb but directions [m]."""


def refine_best(
    situation: Situation,
    candidates: Candidates,
    utilities: dict[str, np.ndarray],
    config: PlannerConfig,
    weigh: Weigh,
) -> tuple[Candidates, dict[str, np.ndarray]]:
    """Replaces the best few candidates by what lies up the slope, where that is better.

    Args:
        situation: what is known.
        candidates: within the robot's limits.
        utilities: [C] each; `utility` and `path` among them.
        config: how many, how far.
        weigh: by what they are the best.

    Returns:
        Candidates and utilities; of those replaced, utilities rise by what the exact utility says
        of the view and its start.
    """
    chosen = _best(candidates, weigh(utilities["utility"], utilities["path"]), config.refine)
    if len(chosen) == 0:
        return candidates, utilities
    starts, travel, limits = candidates.take(chosen), situation.travel, situation.limits
    boxes = [free_box(travel, position, config.refine_radius) for position in starts.position]
    # A box per start: convex, so that no step of a climb needs to ask for collisions.
    low, high = (np.stack(corners) for corners in zip(*boxes, strict=True))
    scoring, camera = config.scoring, situation.camera
    # Gathered for the corners: whatever a climb can see from anywhere in its box is at hand.
    corners = jnp.asarray(np.concatenate([low, high]), dtype=jnp.float32)
    voxels, cells, _ = gather_in_range(
        situation.map_state, situation.scoring_grid, corners, scoring
    )
    elevations = np.tile(np.radians(limits.motion.elevations), (len(chosen), 1))
    numbers_of = (starts.position, starts.direction, low, high, elevations)
    fields = (jnp.asarray(x, dtype=jnp.float32) for x in numbers_of)
    # Two programs, and the one that only turns is far cheaper.
    moves = bool(np.any(high - low > _STILL))
    ends = climb(voxels, cells, camera, scoring, Starts(*fields), moves=moves)
    numbers = np.asarray(ends, dtype=np.float64)
    # float32 rounds: the box is kept to the last bit here, and the directions below.
    positions = np.clip(numbers[:, :3], low, high)
    directions = directions_along(*numbers[:, 3:].T)
    # A climb knows boxes and elevations, but not how far the robot may turn on the way.
    climbed = limits.project_to_feasible(Candidates(positions, directions, starts.valid))
    # Starts are scored again with the ends: the gain is a difference on the same voxels.
    both = jnp.concatenate([starts.poses_on_device(), climbed.poses_on_device()])
    exact = score_views_near(voxels, cells, camera, both, scoring)
    gains = {
        name: np.diff(np.asarray(values, np.float64).reshape(2, -1), axis=0)[0]
        for name, values in (
            ("utility", exact.total),
            ("exploration", exact.exploration),
            ("rendering", exact.rendering),
        )
    }
    path = limits.path_costs(path_lengths(travel, climbed), climbed.direction)
    utility, before = utilities["utility"][chosen], utilities["path"][chosen]
    # The surrogate only proposes: a view that is not exactly better is not taken.
    is_better = gains["utility"] > 0.0
    is_better &= weigh(utility + gains["utility"], path) > weigh(utility, before)
    taken = chosen[is_better]
    position, direction = candidates.position.copy(), candidates.direction.copy()
    position[taken], direction[taken] = climbed.position[is_better], climbed.direction[is_better]
    refined = Candidates(position, direction, candidates.valid)
    found = {name: values.copy() for name, values in utilities.items()}
    found["path"][taken] = path[is_better]
    for name in gains.keys() & found.keys():
        found[name][taken] += gains[name][is_better]
    return refined, found


def _best(candidates: Candidates, total: np.ndarray, num: int) -> np.ndarray:
    """Indices of the `num` best, no view twice while there are others; none if none can be reached.

    A robot that cannot move draws its own place again and again.
    """
    ranked = np.argsort(-total, kind="stable")
    ranked = ranked[np.isfinite(total[ranked]) & candidates.valid[ranked]]
    views = np.concatenate([candidates.position, candidates.direction], axis=1)[ranked]
    # Climbing one view twice would waste a start.
    _, first = np.unique(views, axis=0, return_index=True)
    distinct = ranked[np.sort(first)][:num]
    # Repeats fill up the starts, so that climbing compiles once.
    return distinct[np.arange(num) % len(distinct)] if len(distinct) else distinct


def free_box(travel: Travel, position: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """A box round a place all over which the robot may stop.

    The box of cells round the place's own grows, one layer at a time, over safe cells to which a
    way leads, and ends where candidates do: a quarter of a cell from the middles of its outermost.

    Args:
        travel: where the robot may stop.
        position: where it may [3] [m].
        radius: the box ends at this distance along each axis [m].

    Returns:
        The lowest and the highest corner [3] [m]; twice the position where its cell does not keep
        the margin: what stands there has nowhere to go.
    """
    # Not `goals`: those hold the robot's own cell even without the margin.
    stops = travel.safe & travel.reachable
    cell = travel.cell_of(position)
    if not (travel.contains(cell) and stops[cell]):
        return position.copy(), position.copy()
    lowest = np.maximum(travel.cell_of(position - radius), 0)
    highest = np.minimum(travel.cell_of(position + radius), np.array(stops.shape) - 1)
    first, last = np.array(cell), np.array(cell)
    grows = True
    # Layer by layer in turn, so that no axis takes all the room before the others grow.
    while grows:
        grows = False
        for axis, (end, step) in itertools.product(range(3), ((first, -1), (last, 1))):
            beyond = end[axis] + step
            layer = [slice(a, b + 1) for a, b in zip(first, last, strict=True)]
            layer[axis] = slice(beyond, beyond + 1)
            # A whole layer at a time keeps it a box, and so convex.
            if lowest[axis] <= beyond <= highest[axis] and stops[tuple(layer)].all():
                end[axis] = beyond
                grows = True
    reach = JITTER * travel.cell_size
    low, high = travel.centers(first) - reach, travel.centers(last) + reach
    low, high = np.maximum(low, position - radius), np.minimum(high, position + radius)
    low[2], high[2] = np.clip((low[2], high[2]), *travel.heights)
    # The start itself always lies in its box, jittered to the border or not.
    return np.minimum(low, position), np.maximum(high, position)
