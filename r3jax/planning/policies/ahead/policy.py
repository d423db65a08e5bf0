"""Ours, several views ahead: the first view of the best path through all reachable space.

Candidates are those of Ours-Pano, local ones and some in sight of the frontier, and places that are
spread over all space that the robot can reach. The best path of `horizon` views among them
(`lookahead`) decides; its first view is taken, and then all is planned anew. So a room
that is done is left for one that is not, however far, if nothing nearer is worth its time.

Shape symbols: C candidates.
"""

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    Candidates,
    best_views,
    candidates_at,
    path_lengths,
    spread,
)
from r3jax.planning.greedy import Drawn, GreedyPolicy, draw_positions
from r3jax.planning.policies.ahead.lookahead import (
    SPEED,
    AheadConfig,
    BeamProblem,
    lengths_between,
    search,
)
from r3jax.planning.policy import Situation
from r3jax.planning.refinement.refine import refine_best
from r3jax.scoring.batch import cache_positions_near
from r3jax.scoring.cells import Cells
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.panorama_cache import PanoramaCache


@dataclass(frozen=True)
class OursAhead(GreedyPolicy):
    """The first view of the best path of several, each as if those before it had been taken."""

    config: AheadConfig = field(default_factory=AheadConfig)

    name = "ours-ahead"
    source = "look-ahead on Ours-Pano, this project"
    Config = AheadConfig

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Positions of Ours, and some spread over all reachable space; no directions yet."""
        travel = situation.travel
        num = self.config.num_candidates
        # One at least is drawn as Ours draws it: settings with fewer would be refused.
        num_spread = min(self.config.num_spread, num - 1)
        num_own = num - num_spread
        # The shares add up to what every policy scores: comparisons are at equal cost.
        own = replace(
            self.config,
            num_candidates=num_own,
            num_frontier=min(self.config.num_frontier, num_own),
            refine=0,  # climbs what was chosen, never what is drawn: it may exceed this share
        )
        positions, _ = draw_positions(travel, situation.scoring_grid, own, key=key)
        stops = travel.stops(np.argwhere(travel.goals))
        if len(positions) == 0 or len(stops) == 0:
            return Drawn(candidates_at(stops[:0]), situation.memory)
        wide = stops[spread(stops, num_spread)] if num_spread else stops[:0]
        drawn = candidates_at(np.concatenate([positions, wide]))
        return Drawn(drawn.padded(num), situation.memory)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Every position's best direction and its worth; `ahead`, the rate of its best path.

        A position from which no path of the beam begins has no rate: -inf.
        """
        del key
        scoring, travel = self.config.scoring, situation.travel
        positions = candidates.position
        places = jnp.asarray(positions, dtype=jnp.float32)
        voxels, cells, _ = gather_in_range(
            situation.map_state, situation.scoring_grid, places, scoring
        )
        allowed = situation.limits.allowed_axes(positions, scoring.panorama_bins)
        start = (voxels, cells)
        panorama, kept = cache_positions_near(*start, situation.camera, places, scoring, allowed)
        turned, utility = best_views(candidates, panorama)
        turned = situation.limits.project_to_feasible(turned)
        if self.config.refine:
            turned, utility = self._refined(situation, turned, utility)
            # A view that climbed may have moved: its panorama must be that of the new place.
            kept = self._kept_again(kept, start, situation.camera, positions, turned.position)
        problem = BeamProblem(
            turned,
            utility,
            path_lengths(travel, turned),
            lengths_between(travel, turned.position),
            kept,
            start,
            situation.camera,
            self.config,
            situation.limits,
        )
        # Places where no path of the beam begins were beaten: they must not be chosen.
        rate = np.full(len(positions), -np.inf)
        for path in search(problem):
            rate[path.places[0]] = max(rate[path.places[0]], path.rate)
        return turned, {"utility": utility, "ahead": rate}

    def _refined(
        self, situation: Situation, candidates: Candidates, utility: np.ndarray
    ) -> tuple[Candidates, np.ndarray]:
        """Views of the greatest rate, climbed before paths are searched: all of them gain by it."""
        limits, travel = situation.limits, situation.travel
        speed = limits.motion.speed or SPEED
        ways = limits.path_costs(path_lengths(travel, candidates), candidates.direction)

        def weigh(utility: np.ndarray, path: np.ndarray) -> np.ndarray:
            return utility / np.maximum(self.config.view_seconds + path / speed, 1e-9)

        known = {"utility": utility, "path": ways}
        candidates, found = refine_best(situation, candidates, known, self.config, weigh)
        return candidates, found["utility"]

    def _kept_again(
        self,
        kept: PanoramaCache,
        start: tuple[MapState, Cells],
        camera: Camera,
        before: np.ndarray,
        after: np.ndarray,
    ) -> PanoramaCache:
        """The same panoramas, but for the few positions [C, 3] that have moved."""
        moved = np.flatnonzero((before != after).any(axis=1))
        if len(moved) == 0:
            return kept
        room = -(-len(moved) // self.config.refine) * self.config.refine  # compiles once
        padded = jnp.asarray(moved[np.arange(room) % len(moved)])
        places = jnp.asarray(after, dtype=jnp.float32)[padded]
        _, others = cache_positions_near(*start, camera, places, self.config.scoring)
        return kept.replaced(padded, others)

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The rate of the best path: the path is in it."""
        return utilities["ahead"]
