"""Greedy choice from a pool of poses by a policy's utility: no robot, no paths.

Shape symbols: P poses of the pool.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.mapping.occupancy import (
    empty_grid,
    integrate_depth,
    mark_free_ball,
    world_to_cell,
)
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning.candidates import (
    candidates_along,
    host_generator,
    poses_along,
    random_directions,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policies.active_gamer.policy import ActiveGamer, empty_share
from r3jax.planning.policy import Situation
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.travel import plan_travel
from r3jax.scoring.pixels import score_pixels
from r3jax.simulators.base import Simulator
from r3jax.simulators.free_space import GroundTruth

SCORED = (
    "ours",
    "active-gs",
    "active-gs-no-depth",
    "active-gamer",
    "cover",
    "gavis",
    "unseen",
    "unseen-depth",
    "uniform",
    "random",
)
"""Policies that give a pose a score."""

_integrate_depth = jax.jit(integrate_depth)
_mark_free_ball = jax.jit(mark_free_ball)


def pool_of(truth: GroundTruth, num: int, *, key: jax.Array) -> np.ndarray:
    """Poses at random free places that a camera can reach, in random directions, [num, 4, 4]."""
    place_key, direction_key = jax.random.split(key)
    places = truth.free_positions((0.25, 0.25, 0.25), 0.3)
    drawn = host_generator(place_key).choice(len(places), num, replace=num > len(places))
    return poses_along(places[drawn], random_directions(num, key=direction_key))


def choose(
    name: str,
    simulator: Simulator,
    poses: np.ndarray,
    first: int,
    num: int,
    seed: int,
    *,
    known_cells: bool = False,
) -> tuple[list[int], list[Frame]]:
    """Greedy choice of `num` of the poses [P, 4, 4], the first `first` of which are given.

    Args:
        name: of the policy.
        simulator: renders the chosen poses.
        poses: the pool.
        first: views that are not chosen but given.
        num: views, the first ones included.
        seed: of what the policy leaves to chance.
        known_cells: True tells the utilities that no cell is unexplored: U_G is 0 everywhere.

    Returns:
        The numbers of the chosen poses in order, and their frames.
    """
    config = ExplorationConfig()
    policy: Any = make_policy(name, num_candidates=len(poses), num_frontier=0)
    grid = empty_grid(simulator.bounds, config.cell_size)
    # Whatever the pool reaches counts as reachable: there is no robot that must get there.
    cells = np.asarray(world_to_cell(grid, jnp.asarray(poses[:, :3, 3], jnp.float32)))
    reached = np.zeros(grid.log_odds.shape, dtype=bool)
    reached[tuple(cells.T)] = True
    map_state = empty_map(config.capacity, config.voxel_size, config.num_bins)
    key = jax.random.key(seed)
    state = policy.init(simulator.camera, grid, key=key)
    chosen: list[int] = []
    frames: list[Frame] = []
    while len(chosen) < num:
        best = len(chosen)
        if best >= first:
            travel = plan_travel(grid, poses[chosen[-1], :3, 3], PlannerConfig().safety_margin)
            masked = mask_unexplorable(grid, reached)
            if known_cells:
                masked = masked.ignoring(np.ones(grid.log_odds.shape, dtype=bool))
            where = Situation(map_state, grid, masked, travel, simulator.camera, state.memory)
            totals = totals_of(policy, where, poses, key=jax.random.fold_in(key, best))
            totals[chosen] = -np.inf
            best = int(np.argmax(totals))
        frame = simulator.render(poses[best])
        map_state = integrate_growing(map_state, frame, config.max_range)
        grid = _integrate_depth(grid, frame, config.max_range)
        grid = _mark_free_ball(grid, frame.position, config.body_radius)
        state = policy.observe(state, map_state, frame)
        chosen.append(best)
        frames.append(frame)
    return chosen, frames


def totals_of(policy: Any, where: Situation, poses: np.ndarray, *, key: jax.Array) -> np.ndarray:
    """What a policy gives each pose if no path costs anything, [P] float64."""
    if isinstance(policy, ActiveGamer):
        state, grid, scoring = where.map_state, where.grid, policy.scoring_for(where.grid)
        flat = poses.astype(np.float32)
        return np.array(
            score_pixels(empty_share, state, grid, where.camera, flat, scoring), np.float64
        )
    candidates = candidates_along(poses[:, :3, 3], poses[:, :3, 2])
    _, utilities = policy.score(where, candidates, key=key)
    return np.array(policy.weigh(utilities | {"path": np.zeros(len(poses))}), np.float64)
