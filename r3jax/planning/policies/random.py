"""The random baseline: any reachable view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array

from r3jax.planning.candidates import Candidates, draw_lots, free_views
from r3jax.planning.decide import Drawn, GreedyPolicy, Scored
from r3jax.planning.policy import Situation


@dataclass(frozen=True)
class Random(GreedyPolicy):
    """A random nearby view: the candidates of `r3` (without the frontier's), no score."""

    name = "random"
    source = "the floor of every comparison"

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws nearby positions and random directions."""
        num, radius = self.config.num_candidates, self.config.radius
        return Drawn(free_views(situation.travel, num, radius, key=key), situation.memory)

    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Draws a random score for each candidate."""
        del situation
        return candidates, draw_lots(len(candidates.valid), key=key)

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the random scores: paths cost nothing."""
        return utilities["lot"]
