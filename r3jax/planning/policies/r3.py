"""R3 and R3-Pano: choose views with low closed-form renderability (arXiv 2601.07484).

    U_view = U / sum U - lambda2 L / sum L,    U = lambda1 U_G + U_R,  L the path length

R3 scores poses with random directions. R3-Pano scores positions and takes the best direction of
each panorama, which needs only one depth buffer per position.

Shape symbols: C candidates, always `config.num_candidates`, so that scoring compiles once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.planning.candidates import Candidates, best_views, random_places
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import Drawn, GreedyPolicy, Scored
from r3jax.planning.policy import Situation
from r3jax.scoring.batch import score_positions, score_views


@dataclass(frozen=True)
class R3(GreedyPolicy):
    """Random nearby and frontier views, scored by renderability and unexplored space in view."""

    score_all: Callable[..., Any] = score_views
    """Scores poses [C, 4, 4]."""

    name = "r3"
    source = "Ours, arXiv 2601.07484"

    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Computes U = lambda1 U_G + U_R of every view."""
        del key
        # On the masked grid: cells that the robot can never see would attract it forever.
        views = self.score_all(
            situation.map_state,
            situation.scoring_grid,
            situation.camera,
            candidates.poses_on_device(),
            self.config.scoring,
        )
        utilities = {
            "exploration": np.asarray(views.exploration, dtype=np.float64),
            "rendering": np.asarray(views.rendering, dtype=np.float64),
            "utility": np.asarray(views.total, dtype=np.float64),
        }
        return _refined(situation, candidates, utilities, self.config)


@dataclass(frozen=True)
class R3Pano(GreedyPolicy):
    """Random nearby and frontier positions; each in the direction of the highest utility."""

    score_all: Callable[..., Any] = score_positions
    """Scores positions [C, 3]."""

    name = "r3-pano"
    source = "Ours-Pano, arXiv 2601.07484"

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws positions as R3 does; their directions are chosen later."""
        travel, grid = situation.travel, situation.scoring_grid
        return Drawn(random_places(travel, grid, self.config, key=key), situation.memory)

    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Finds the best allowed direction of each position's panorama, and its score."""
        del key
        scoring, limits = self.config.scoring, situation.limits
        panorama = self.score_all(
            situation.map_state,
            situation.scoring_grid,
            situation.camera,
            jnp.asarray(candidates.position, dtype=jnp.float32),
            scoring,
            limits.allowed_axes(candidates.position, scoring.panorama_bins),
        )
        # Positions stay; the panorama chooses the directions.
        turned, utility = best_views(candidates, panorama)
        feasible = limits.project_to_feasible(turned)
        return _refined(situation, feasible, {"utility": utility}, self.config)


def _refined(
    situation: Situation,
    candidates: Candidates,
    utilities: dict[str, np.ndarray],
    config: PlannerConfig,
) -> Scored:
    """Refines the best candidates by gradient ascent if the settings say so."""
    if not config.refine:
        return candidates, utilities
    # A lazy import: jaxopt takes a second to load.
    from r3jax.planning.refine import refine_best

    return refine_best(situation, candidates, utilities, config)
