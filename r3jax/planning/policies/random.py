"""The floor of every table: any view that can be reached, chosen by chance."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from r3jax.planning.candidates import host_generator, local_random, poses_along, random_directions
from r3jax.planning.greedy import GreedyPolicy, Situation


@dataclass(frozen=True)
class Random(GreedyPolicy):
    """A random nearby view: the candidates of `ours` (without the frontier's), no score."""

    name = "random"
    source = "the floor of every comparison"

    def draw(self, situation: Situation, *, key: Array) -> tuple[np.ndarray, Any]:
        """Nearby positions, random directions."""
        position_key, direction_key = jax.random.split(key)
        config = self.config
        positions = local_random(
            situation.travel, config.num_candidates, config.radius, key=position_key
        )
        if len(positions) == 0:
            return np.zeros((0, 4, 4)), situation.memory
        directions = random_directions(len(positions), key=direction_key)
        return poses_along(positions, directions), situation.memory

    def score(
        self, situation: Situation, poses: np.ndarray, *, key: Array
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The lot that each candidate draws."""
        del situation
        return poses, {"lot": host_generator(key).random(len(poses))}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The lot alone: paths cost nothing."""
        return utilities["lot"]
