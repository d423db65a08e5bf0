"""Greedy choice from a pool of poses by a policy's utility: no robot, no paths.

Shape symbols: P poses of the pool.
"""

from typing import Any

import jax
import numpy as np

from r3jax.apps.benchmark.photos.choosers import totals_of
from r3jax.apps.benchmark.photos.known import nothing_known
from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.planning.candidates import host_generator, poses_along, random_directions
from r3jax.planning.registry import make_policy
from r3jax.simulators.base import Simulator
from r3jax.simulators.free_space import GroundTruth


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
    policy: Any = make_policy(name, num_candidates=len(poses), num_frontier=0)
    known = nothing_known(simulator.camera, simulator.bounds, poses, ExplorationConfig())
    key = jax.random.key(seed)
    state = policy.init(simulator.camera, known.grid, key=key)
    chosen: list[int] = []
    while len(chosen) < num:
        best = len(chosen)
        if best >= first:
            where = known.situation(state.memory, known_cells=known_cells)
            totals = totals_of(policy, where, poses, key=jax.random.fold_in(key, best))
            totals[chosen] = -np.inf
            best = int(np.argmax(totals))
        frame = simulator.render(poses[best])
        known = known.shown(frame)
        state = policy.observe(state, known.map_state, frame)
        chosen.append(best)
    return chosen, list(known.chosen)
