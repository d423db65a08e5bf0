"""Refinement: the best few candidates climb the smooth utility, each within a box of free space.

From a view, `scoring.soft_utility` is ascended in position, azimuth and elevation by jaxopt's
projected gradient. Where a climb ends becomes the nearest view that the robot may take. Then the
exact utility decides: a view replaces its start only if it is better, both alone and net of the
path. On the host; scores are jitted.

Shape symbols: C candidates; K starts, always `config.refine`, so that climbing compiles once.
"""

import functools
import itertools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera, pose_along
from r3jax.kernels.calls import Cells
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import JITTER, Candidates, path_lengths
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import net_utility
from r3jax.planning.policy import Situation
from r3jax.planning.robot.limits import angles_along, directions_along
from r3jax.planning.robot.travel import Travel
from r3jax.scoring.batch import score_views_near
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.soft_utility import soft_utility_near

with warnings.catch_warnings():
    # It warns on import that it is no longer developed.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

_MAX_STEPS = 20
"""Steps of a climb; most end before."""

_TOLERANCE = 1e-2
"""A climb ends where the gradient is smaller: shares of the start's utility per `_UNIT`."""

_UNIT = 0.3
"""Steps of the same effect along the numbers of a view [m] or [rad]."""


def refine_best(
    situation: Situation,
    candidates: Candidates,
    utilities: dict[str, np.ndarray],
    config: PlannerConfig,
) -> tuple[Candidates, dict[str, np.ndarray]]:
    """Replaces the best few candidates by better views near them, where a climb finds any.

    Args:
        situation: what is known.
        candidates: within the robot's limits.
        utilities: [C] each; `utility`, that of `scoring.utility`, among them.
        config: how many, how far.

    Returns:
        Candidates and utilities; of those replaced, utilities rise by what the exact utility gains
        from start to end.
    """
    cost = lambda views: situation.limits.path_costs(
        path_lengths(situation.travel, views), views.direction
    )
    utility, path = utilities["utility"], cost(candidates)
    # The sums stay those of the candidates as drawn: a view that rises must not lower the others.
    weigh = functools.partial(net_utility, lambda2=config.lambda2, among=(utility, path))
    chosen = _best(candidates, weigh(utility, path), config.refine)
    if len(chosen) == 0:
        return candidates, utilities
    climbed, gains = _climbed(situation, candidates.take(chosen), config)
    # The smooth utility only proposes: a view that is not exactly better is not taken.
    is_better = gains["utility"] > 0.0
    net = weigh(utility[chosen] + gains["utility"], cost(climbed))
    is_better &= net > weigh(utility[chosen], path[chosen])
    taken = chosen[is_better]
    position, direction = candidates.position.copy(), candidates.direction.copy()
    position[taken], direction[taken] = climbed.position[is_better], climbed.direction[is_better]
    found = {name: values.copy() for name, values in utilities.items()}
    for name in gains.keys() & found.keys():
        found[name][taken] += gains[name][is_better]
    return Candidates(position, direction, candidates.valid), found


def _climbed(
    situation: Situation, starts: Candidates, config: PlannerConfig
) -> tuple[Candidates, dict[str, np.ndarray]]:
    """Finds the views where climbs from K starts end, and their gains in exact utility [K]."""
    limits, camera, scoring = situation.limits, situation.camera, config.scoring
    boxes = [
        free_box(situation.travel, position, config.refine_radius) for position in starts.position
    ]
    # A box per start: convex, so that no step of a climb has to test for collisions.
    low, high = (np.stack(corners) for corners in zip(*boxes, strict=True))
    corners = jnp.asarray(np.concatenate([low, high]), dtype=jnp.float32)
    near = gather_in_range(situation.map_state, situation.scoring_grid, corners, scoring)[:2]
    origin = np.column_stack([starts.position, *angles_along(starts.direction)])
    # The azimuth goes round in a circle: a bound on it would be a wall in one direction.
    ends = [(-np.inf, np.inf), np.radians(limits.motion.elevations)]
    lowest, highest = (
        np.column_stack([corner, *np.tile([end[i] for end in ends], (len(low), 1)).T])
        for i, corner in enumerate((low, high))
    )
    poses = starts.poses_on_device()
    numbers = (jnp.asarray(x, dtype=jnp.float32) for x in (origin, lowest, highest))
    found = np.asarray(_climb(*near, camera, scoring, poses, *numbers), np.float64)
    # float32 rounds: the box is kept to the last bit here, and the directions below.
    positions = np.clip(found[:, :3], low, high)
    # A climb knows boxes and elevations, but not how far the robot may turn on the path.
    climbed = limits.project_to_feasible(
        Candidates(positions, directions_along(*found[:, 3:].T), starts.valid)
    )
    # Starts are scored again with the ends: the gain is a difference on the same voxels.
    both = jnp.concatenate([poses, climbed.poses_on_device()])
    exact = score_views_near(*near, camera, both, scoring)
    before_after = {
        "utility": exact.total, "exploration": exact.exploration, "rendering": exact.rendering
    }  # fmt: skip
    difference = lambda x: np.diff(np.asarray(x, np.float64).reshape(2, -1), axis=0)[0]
    return climbed, {name: difference(values) for name, values in before_after.items()}


@jax.jit
def _climb(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    poses: Float[Array, "K 4 4"],
    origin: Float[Array, "K 5"],
    lowest: Float[Array, "K 5"],
    highest: Float[Array, "K 5"],
) -> Float[Array, "K 5"]:
    """Climbs the utility from poses by its gradient.

    Returns positions [m], azimuths and elevations [rad], within bounds.
    """

    def pose_at(numbers: Float[Array, " 5"]) -> Float[Array, "4 4"]:
        azimuth, elevation = numbers[3], numbers[4]
        level = jnp.cos(elevation)
        axis = [level * jnp.cos(azimuth), level * jnp.sin(azimuth), jnp.sin(elevation)]
        return pose_along(numbers[:3], jnp.stack(axis))

    def climb(start: tuple[Array, Array, Array, Array]) -> Float[Array, " 5"]:
        pose, origin, lowest, highest = start
        utility = soft_utility_near(voxels, cells, camera, pose, config)
        # Divided by the start, utilities of thousands and of tens meet one tolerance.
        least = jnp.maximum(utility(pose), 1.0)
        solver = jaxopt.ProjectedGradient(
            lambda offset: -utility(pose_at(origin + _UNIT * offset)) / least,
            jaxopt.projection.projection_box,
            maxiter=_MAX_STEPS,
            tol=_TOLERANCE,
            acceleration=False,
        )
        bounds = ((lowest - origin) / _UNIT, (highest - origin) / _UNIT)
        # Offsets from the start, so that float32 keeps its digits.
        found = solver.run(jnp.zeros(5), bounds).params
        # Scaled back, the numbers may round past the box.
        return jnp.clip(origin + _UNIT * found, lowest, highest)

    # One after the other: for some starts in an office, XLA's code for all at once never ended.
    return jax.lax.map(climb, (poses, origin, lowest, highest))


def _best(candidates: Candidates, total: np.ndarray, num: int) -> np.ndarray:
    """Selects the `num` best, no view twice while there are others.

    The result is empty if none can be reached.

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
    """Finds a box round a place in which the robot may stop everywhere.

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
