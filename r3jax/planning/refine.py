"""Refines the best candidates by gradient ascent of the smooth utility, in boxes of free space.

From a view, `scoring.soft_utility` is ascended in position, azimuth and elevation by jaxopt's
projected gradient. Each end point is projected to the nearest view that the robot may take. A view
replaces its start only if its exact utility is better, both with and without the path's cost. On
the host; scores are jitted.

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
"""Maximum number of steps; most ascents converge earlier."""

_TOLERANCE = 1e-2
"""Convergence: gradient as a share of the start's utility per `_UNIT`."""

_UNIT = 0.3
"""Scales of the parameters of a view [m] or [rad]."""


def refine_best(
    situation: Situation,
    candidates: Candidates,
    utilities: dict[str, np.ndarray],
    config: PlannerConfig,
) -> tuple[Candidates, dict[str, np.ndarray]]:
    """Replaces the best candidates by better views near them, if gradient ascent finds any.

    Args:
        situation: map, grid, pose and limits.
        candidates: within the robot's limits.
        utilities: [C] each; `utility`, that of `scoring.utility`, among them.
        config: number of candidates and maximum displacement.

    Returns:
        Candidates and utilities; of those replaced, utilities rise by what the exact utility gains
        from start to end.
    """
    cost = lambda views: situation.limits.path_costs(
        path_lengths(situation.travel, views), views.direction
    )
    utility, path = utilities["utility"], cost(candidates)
    # Sums over the original candidates: a refined view must not lower the shares of others.
    weigh = functools.partial(net_utility, lambda2=config.lambda2, among=(utility, path))
    chosen = _best(candidates, weigh(utility, path), config.refine)
    if len(chosen) == 0:
        return candidates, utilities
    climbed, gains = _climbed(situation, candidates.take(chosen), config)
    # The smooth utility only proposes views; the exact one decides.
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
    # One box per start: convex, so that no step has to test for collisions.
    low, high = (np.stack(corners) for corners in zip(*boxes, strict=True))
    corners = jnp.asarray(np.concatenate([low, high]), dtype=jnp.float32)
    near = gather_in_range(situation.map_state, situation.scoring_grid, corners, scoring)[:2]
    origin = np.column_stack([starts.position, *angles_along(starts.direction)])
    # The azimuth is periodic and has no bounds.
    ends = [(-np.inf, np.inf), np.radians(limits.motion.elevations)]
    lowest, highest = (
        np.column_stack([corner, *np.tile([end[i] for end in ends], (len(low), 1)).T])
        for i, corner in enumerate((low, high))
    )
    poses = starts.poses_on_device()
    numbers = (jnp.asarray(x, dtype=jnp.float32) for x in (origin, lowest, highest))
    found = np.asarray(_climb(*near, camera, scoring, poses, *numbers), np.float64)
    # float32 rounds: positions are clipped to the box here, directions below.
    positions = np.clip(found[:, :3], low, high)
    # The ascent is bounded in position and elevation, but not by the robot's limits of turning.
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
        # Divided by the initial utility, so that one tolerance suits all scales.
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

    # One after the other: for some starts in the office, XLA's vectorized code did not terminate.
    return jax.lax.map(climb, (poses, origin, lowest, highest))


def _best(candidates: Candidates, total: np.ndarray, num: int) -> np.ndarray:
    """Selects the `num` best, without duplicates if there are enough views.

    The result is empty if none can be reached. A robot that cannot move draws its own position
    repeatedly.
    """
    ranked = np.argsort(-total, kind="stable")
    ranked = ranked[np.isfinite(total[ranked]) & candidates.valid[ranked]]
    views = np.concatenate([candidates.position, candidates.direction], axis=1)[ranked]
    # Refining one view twice would waste a start.
    _, first = np.unique(views, axis=0, return_index=True)
    distinct = ranked[np.sort(first)][:num]
    # Padded with repeats, so that the ascent compiles once.
    return distinct[np.arange(num) % len(distinct)] if len(distinct) else distinct


def free_box(travel: Travel, position: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Finds a box around a position in which the robot may stop everywhere.

    The box of cells around the position's own grows, layer by layer, over safe reachable cells. It
    ends where candidates may be: a quarter of a cell from the centers of its outermost cells.

    Args:
        travel: positions to stop at.

        position: one of them, [3] [m].
        radius: the box ends at this distance along each axis [m].

    Returns:
        The lowest and the highest corner [3] [m]; both are the position itself if its cell does not
        keep the margin.
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
    # Layer by layer in turn, so that the box grows along all axes.
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
    # The box always contains the start, even if it was jittered to the border.
    return np.minimum(low, position), np.maximum(high, position)
