"""ActiveGAMER on our map: a pool of lattice views, ranked by how many of their pixels are empty.

Candidates are kept between decisions (`planning.pool`). Those of stage 0 lie on a 1 m lattice,
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
"""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.decision import PlannerState, Stopwatch, settle, ways_from
from r3jax.planning.greedy import GreedyPolicy, ScoreViews
from r3jax.planning.policies.random import Random
from r3jax.planning.policy import Decision, PlanInfo
from r3jax.planning.pool import Pools, dismiss, draw_candidates, empty_pools
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.pixels import PixelView, score_pixels


def empty_share(view: PixelView) -> Float[Array, ""]:
    """The gain: share of the pixels in which the map shows nothing."""
    return jnp.mean(~view.hit, dtype=jnp.float32)


def score_of(gain: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(1 - softmax(d)) g / sum(g) of gains and distances [m], [C] each; 0 if all gains are 0."""
    far = np.exp(distance - distance.max())
    return (1.0 - far / far.sum()) * gain / (gain.sum() or 1.0)


@dataclass(frozen=True)
class ActiveGamer(GreedyPolicy):
    """The emptiest view of a pool of lattice views, the farthest ones marked down."""

    score_all: ScoreViews = score_pixels
    """Scores poses [C, 4, 4], as `score_pixels` does."""

    name = "active-gamer"
    source = "ActiveGAMER, Chen et al., CVPR 2025"

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Pools:
        """Empty pools."""
        del camera
        return empty_pools(grid.log_odds.shape, float(grid.cell_size))

    def decide(
        self,
        state: PlannerState,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, PlannerState, PlanInfo]:
        """The pool's best view; a random nearby one when no candidate can be reached."""
        stopwatch, config = Stopwatch(), self.config
        with stopwatch.part("travel"):
            travel = ways_from(state, grid, T_world_camera, config)
        with stopwatch.part("candidates"):
            pools, draw = draw_candidates(state.memory, travel, config.num_candidates)
        state = replace(state, memory=pools)
        if draw is None:
            return Random(config).decide(state, map_state, grid, T_world_camera, key=key)
        with stopwatch.part("scoring"):
            gain = self._gain(state.camera, map_state, grid, draw.poses)
        with stopwatch.part("travel"):
            path = travel.lengths(draw.poses[:, :3, 3])
        total = score_of(gain, draw.distance)
        utilities = {"utility": gain, "distance": draw.distance, "path": path, "total": total}
        decision, state, info = settle(state, travel, draw.poses, utilities, stopwatch)
        of_stage = list(pools.of_stage)
        of_stage[draw.stage] = dismiss(of_stage[draw.stage], draw, gain, int(np.argmax(total)))
        return decision, replace(state, memory=replace(pools, of_stage=tuple(of_stage))), info

    def scoring_for(self, grid: OccupancyGrid) -> ScoringConfig:
        """The settings of the score: what the map holds counts at any distance within the box."""
        extent = np.linalg.norm(grid.log_odds.shape) * float(grid.cell_size)
        return replace(self.config.scoring, max_range=extent)

    def _gain(
        self, camera: Camera, map_state: MapState, grid: OccupancyGrid, poses: np.ndarray
    ) -> np.ndarray:
        """Share of empty pixels of each pose [C]; always as many are scored."""
        num = self.config.num_candidates
        padded = poses[np.arange(num) % len(poses)].astype(np.float32)
        scoring = self.scoring_for(grid)
        gain = self.score_all(empty_share, map_state, grid, camera, padded, scoring)
        return np.asarray(gain, dtype=np.float64)[: len(poses)]
