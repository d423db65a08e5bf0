"""ActiveGAMER on our map: a pool of lattice views, ranked by how many of their pixels are empty.

Candidates are kept between decisions (`pool`). Those of stage 0 lie on a 1 m lattice,
1.75 m above the floor, with 5 directions each; those of stage 1 on a 0.5 m lattice, 1.0 and 2.5 m
above it, with 15. With the gain g = share of the view's pixels in which the map shows nothing, at
any distance, and the straight distance d to the candidate [m], over the candidates scored:

    score = (1 - softmax(d)) g / sum(g)

A candidate with g < 0.5 % leaves the pool for good. A stage ends for good when every candidate
that its pool ever held has left.

What the paper leaves to its scenes' settings or to its simulator is decided here:

* Its candidates are free cells at a distance from matter; ours those in which the robot may stop.
* It reads the true depth to leave out pixels that no view can fill, such as windows. Instead, a
  view that was chosen leaves the pool: what it did not show then, it will never show.
* It scores the whole pool at every decision. Here at most `num_candidates` are scored: those with
  the greatest gain when last scored first, those never scored counting as wholly empty; ties
  nearest first. Gains hardly ever rise, so that old ones bound new ones.
* When no candidate of an open stage can be reached, and after the last stage, views are random.
* Its robot takes a frame every 0.1 m and 10 degrees of its way, and maps them all; here that is
  `capture_every`, for whoever flies.
"""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.baselines.active_gamer.pool import Pools, dismiss, draw_candidates, empty_pools
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates
from r3jax.planning.greedy import (
    Drawn,
    GreedyPolicy,
    ScoreViews,
    Situation,
    draw_lots,
    free_views,
)
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.pixels import PixelView, score_pixels


def empty_share(view: PixelView) -> Float[Array, ""]:
    """The gain: share of the pixels in which the map shows nothing."""
    return jnp.mean(~view.hit, dtype=jnp.float32)


def score_of(gain: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(1 - softmax(d)) g / sum(g) of gains and distances [m], [C] each; 0 if all gains are 0."""
    # Shifted by the largest: exp of a hundred meters would overflow.
    far = np.exp(distance - distance.max())
    return (1.0 - far / far.sum()) * gain / (gain.sum() or 1.0)


@dataclass(frozen=True)
class ActiveGamer(GreedyPolicy):
    """The emptiest view of a pool of lattice views, the farthest ones marked down."""

    score_all: ScoreViews = score_pixels
    """Scores poses [C, 4, 4], as `score_pixels` does."""

    name = "active-gamer"
    scores_by_notes = True
    source = "ActiveGAMER, Chen et al., CVPR 2025"

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Pools:
        """Empty pools."""
        del camera
        return empty_pools(grid.log_odds.shape, float(grid.cell_size))

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """The pool's candidates, noted where they stand in it; any nearby view if there is none."""
        num = self.config.num_candidates
        pools, found = draw_candidates(situation.memory, situation.travel, num, situation.limits)
        if found is None:
            return Drawn(free_views(situation, num, self.config.radius, key=key), pools)
        return Drawn(found.candidates.padded(num), pools, notes=found)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Gain and distance of the pool's candidates; lots for others."""
        if situation.notes is None:
            return candidates, draw_lots(len(candidates.valid), key=key)
        gain = self._gain(situation.camera, situation.map_state, situation.grid, candidates)
        # Padding must have no share in the sums of the score: no gain, and no distance.
        distance = np.full(len(gain), -np.inf)
        distance[candidates.valid] = situation.notes.distance
        return candidates, {"utility": gain, "distance": distance}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The score of the paper, or the lots: the path itself costs nothing."""
        if "lot" in utilities:
            return utilities["lot"]
        return score_of(utilities["utility"], utilities["distance"])

    def conclude(
        self,
        situation: Situation,
        candidates: Candidates,
        utilities: dict[str, np.ndarray],
        best: int,
    ) -> Pools:
        """The chosen candidate leaves the pool, and those that are worth nothing."""
        pools, found = situation.memory, situation.notes
        # Random views came from no pool, so that none can leave one.
        if found is None:
            return pools
        of_stage = list(pools.of_stage)
        # Padding comes last: without it `best` still counts the same rows.
        gain = utilities["utility"][candidates.valid]
        of_stage[found.stage] = dismiss(of_stage[found.stage], found, gain, best)
        return replace(pools, of_stage=tuple(of_stage))

    def scoring_for(self, grid: OccupancyGrid) -> ScoringConfig:
        """The settings of the score: what the map holds counts at any distance within the box."""
        # The diagonal of the box: nothing within it is out of range.
        extent = np.linalg.norm(grid.log_odds.shape) * float(grid.cell_size)
        return replace(self.config.scoring, max_range=extent)

    def _gain(
        self, camera: Camera, map_state: MapState, grid: OccupancyGrid, candidates: Candidates
    ) -> np.ndarray:
        """Share of empty pixels of each view [C]; 0 for padding."""
        poses, scoring = candidates.poses_on_device(), self.scoring_for(grid)
        gain = self.score_all(empty_share, map_state, grid, camera, poses, scoring)
        return np.where(candidates.valid, np.asarray(gain, dtype=np.float64), 0.0)
