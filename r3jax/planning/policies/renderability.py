"""Ours and Ours-Pano: go where the closed-form renderability is low (arXiv 2601.07484).

    U_view = U / sum U - lambda2 L / sum L,    U = lambda1 U_G + U_R,  L the path length

Ours scores poses with random directions. Ours-Pano scores positions and takes the best
direction of each one's panorama: one depth buffer per position answers for all directions.

Shape symbols: C candidates, always `config.num_candidates`, so that scoring compiles once.
"""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.planning.candidates import Candidates, best_views
from r3jax.planning.greedy import Drawn, GreedyPolicy, ScoreViews, random_places
from r3jax.planning.policy import Situation
from r3jax.scoring.batch import score_positions, score_views
from r3jax.scoring.config import ScoringConfig

SETTLED = 8
"""Best estimates of a sample that are scored once more, exactly."""


@dataclass(frozen=True)
class Ours(GreedyPolicy):
    """Random nearby and frontier views, scored by renderability and unexplored space in view."""

    score_all: ScoreViews = score_views
    """Scores poses [C, 4, 4]."""

    name = "ours"
    source = "Ours, arXiv 2601.07484"
    climbs = True

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """U = lambda1 U_G + U_R of every view."""
        del key
        # On the masked grid: cells that no robot can look at would attract it forever.
        views = self.score_all(
            situation.map_state,
            situation.scoring_grid,
            situation.camera,
            candidates.poses_on_device(),
            self.config.scoring,
        )
        return candidates, {
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

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Positions of Ours; where they look is not chosen yet."""
        return Drawn(random_places(situation, self.config, key=key), situation.memory)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Every position's best direction that is allowed, and what the panorama promises there."""
        del key
        turned, utility = self._turned(situation, candidates, self.config.scoring)
        if self.config.scoring.sample > 1:
            turned, utility = self._settled(situation, turned, utility)
        return turned, {"utility": utility}

    def _turned(
        self, situation: Situation, candidates: Candidates, scoring: ScoringConfig
    ) -> tuple[Candidates, np.ndarray]:
        """Candidates along the best directions of their panoramas, and what those promise [C]."""
        panorama = self.score_all(
            situation.map_state,
            situation.scoring_grid,
            situation.camera,
            jnp.asarray(candidates.position, dtype=jnp.float32),
            scoring,
            situation.limits.allowed_axes(candidates.position, scoring.panorama_bins),
        )
        # Positions stay, lines of sight are the panorama's choice.
        return best_views(candidates, panorama)

    def _settled(
        self, situation: Situation, turned: Candidates, estimate: np.ndarray
    ) -> tuple[Candidates, np.ndarray]:
        """The same where the best estimates of a sample are replaced by what is exact."""
        # Not padding: it repeats others, and is never chosen.
        order = np.argsort(np.where(turned.valid, -estimate, np.inf), kind="stable")
        best = order[:SETTLED]
        exact = dataclasses.replace(self.config.scoring, sample=1)
        again, utility = self._turned(situation, turned.take(best), exact)
        # What was chosen for its estimate was overrated on the average: so the others are, too.
        known = estimate[best] > 0.0
        ratio = float(np.median(utility[known] / estimate[best][known])) if known.any() else 1.0
        settled, direction = ratio * estimate, turned.direction.copy()
        settled[best], direction[best] = utility, again.direction
        return dataclasses.replace(turned, direction=direction), settled
