"""Ours-Demand: go where a view repairs most, not where most is broken.

    U_view = U / sum U - lambda2 L / sum L,    U = lambda1 U_G + gain,  L the path length

Renderability's U_R asks how badly a view would render now. A surface that no view can mend draws it
again and again, and one behind the sofa counts like one that everybody looks at. Here standpoints,
spread over the space that the robot can reach, stand for everybody; the gain of a view is the
renderability that it would add to what they see (`scoring.demand`). Positions and their best
directions are as in Ours-Pano.

Shape symbols: C candidates, always `config.num_candidates`, so that scoring compiles once.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array

from r3jax.planning.candidates import standpoints
from r3jax.planning.greedy import GreedyPolicy, ScoreViews
from r3jax.planning.policies.renderability import turned_views
from r3jax.planning.situation import Situation
from r3jax.scoring.batch import score_positions


@dataclass(frozen=True)
class OursDemand(GreedyPolicy):
    """Ours-Pano by gain instead of lack: what a view would add to what all free space can see."""

    score_all: ScoreViews = score_positions
    """Scores positions [C, 3] for standpoints."""

    name = "ours-demand"
    source = "ours, after facility location, Nemhauser et al. 1978"
    climbs = True

    def score(
        self, situation: Situation, poses: np.ndarray, *, key: Array
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Every position's best direction, and what the panorama promises there."""
        positions = poses[:, :3, 3]
        places = self.standpoints(situation, positions, key=key)
        scoring = self.config.scoring
        return turned_views(self.score_all, situation, positions, scoring, standpoints=places)

    def standpoints(self, situation: Situation, positions: np.ndarray, *, key: Array) -> np.ndarray:
        """Spread over the space that the robot can reach, in sight of the candidates."""
        reach = float(self.config.scoring.max_range)
        num = self.config.num_standpoints
        return standpoints(situation.travel, num, positions, reach, key=key)
