"""Unknown space alone: what exploration is worth when nothing is asked about known surfaces.

Unseen counts the unexplored cells that a view shows, U_G. UnseenDepth adds up their distances,
in units of the sensor's range, so that long views into the open win.

Shape symbols: C candidates.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from r3jax.planning.candidates import Candidates
from r3jax.planning.config import PlannerConfig
from r3jax.planning.greedy import GreedyPolicy, draw_lots, score_by_pixels
from r3jax.planning.policy import Situation
from r3jax.scoring.pixels import PixelView


def _cells_and_distance(view: PixelView) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Visible unexplored cells, and the sum of their distances in sensor ranges."""
    return view.cells, view.cell_distance / view.max_range


def unseen_utilities(
    situation: Situation,
    candidates: Candidates,
    config: PlannerConfig,
    *,
    weighted: bool,
    key: Array,
) -> dict[str, np.ndarray]:
    """`cells`, `depth` and `utility` of candidates, [C] each.

    Args:
        situation: what is known.
        candidates: views on offer.
        config: settings of the policy.
        weighted: True to take the distances for the utility, False to count.
        key: draws lots as utilities where no candidate shows an unexplored cell. Without them
            the path alone would decide, and the robot would stay where it is.
    """
    cells, depth = score_by_pixels(situation, _cells_and_distance, candidates, config.scoring)
    utility = depth if weighted else cells
    if not utility.any():
        utility = draw_lots(len(candidates.valid), key=key)["lot"]
    return {"cells": cells, "depth": depth, "utility": utility}


@dataclass(frozen=True)
class Unseen(GreedyPolicy):
    """The number of unexplored cells in view; lots where no candidate shows any."""

    name = "unseen"
    source = "unmapped volume in view, as in Bircher et al., ICRA 2016"

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """U_G of every view."""
        config = self.config
        return candidates, unseen_utilities(situation, candidates, config, weighted=False, key=key)


@dataclass(frozen=True)
class UnseenDepth(GreedyPolicy):
    """The unexplored cells in view, each weighed by its distance; lots where there are none."""

    name = "unseen-depth"
    source = "unseen, times the depth factor of Active-GS"

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """The sum over the visible unexplored cells of distance / range."""
        config = self.config
        return candidates, unseen_utilities(situation, candidates, config, weighted=True, key=key)
