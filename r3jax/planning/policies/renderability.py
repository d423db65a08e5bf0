"""Ours and Ours-Pano: go where the closed-form renderability is low (arXiv 2601.07484).

    U_view = U / sum U - lambda2 L / sum L,    U = lambda1 U_G + U_R,  L the path length

Ours scores poses with random directions. Ours-Pano scores positions and takes the best
direction of each one's panorama: one depth buffer per position answers for all directions.

Shape symbols: C candidates, always `config.num_candidates`, so that scoring compiles once.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array

from r3jax.planning.candidates import best_views
from r3jax.planning.greedy import GreedyPolicy, ScoreViews
from r3jax.planning.situation import Situation
from r3jax.scoring.batch import score_positions, score_views
from r3jax.scoring.config import ScoringConfig


@dataclass(frozen=True)
class Ours(GreedyPolicy):
    """Random nearby and frontier views, scored by renderability and unexplored space in view."""

    score_all: ScoreViews = score_views
    """Scores poses [C, 4, 4]."""

    name = "ours"
    source = "Ours, arXiv 2601.07484"
    climbs = True

    def score(
        self, situation: Situation, poses: np.ndarray, *, key: Array
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """U = lambda1 U_G + U_R of every pose."""
        del key
        views = self.score_all(
            situation.map_state,
            situation.scoring_grid,
            situation.camera,
            poses.astype(np.float32),
            self.config.scoring,
        )
        return poses, {
            "exploration": np.asarray(views.exploration, dtype=np.float64),
            "rendering": np.asarray(views.rendering, dtype=np.float64),
            "utility": np.asarray(views.total, dtype=np.float64),
        }


@dataclass(frozen=True)
class OursPano(GreedyPolicy):
    """Random nearby and frontier positions; each looks where its panorama needs views most."""

    score_all: ScoreViews = score_positions
    """Scores positions [C, 3]."""

    name = "ours-pano"
    source = "Ours-Pano, arXiv 2601.07484"
    climbs = True

    def score(
        self, situation: Situation, poses: np.ndarray, *, key: Array
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Every position's best direction that is allowed, and what the panorama promises there."""
        del key
        return turned_views(self.score_all, situation, poses[:, :3, 3], self.config.scoring)


def turned_views(
    score_all: ScoreViews,
    situation: Situation,
    positions: np.ndarray,
    scoring: ScoringConfig,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """What `GreedyPolicy.score` answers for positions that look where it is worth most.

    Args:
        score_all: `score_positions`, or a stand-in for it.
        situation: what is known.
        positions: [C, 3] [m].
        scoring: settings of the utilities.
    """
    panorama = score_all(
        situation.map_state,
        situation.scoring_grid,
        situation.camera,
        positions.astype(np.float32),
        scoring,
        situation.limits.allowed_axes(positions, scoring.panorama_bins),
    )
    turned, utility = best_views(positions, panorama)
    return turned, {"utility": utility}
