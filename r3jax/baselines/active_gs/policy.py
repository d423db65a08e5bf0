"""Active-GS: views that show much of the unknown and much that is not believed yet, far away.

    U = 1000 (visible unexplored cells / all cells) + mean over pixels of (1 - C) depth / d_max
    score = U / sum U - lambda2 L / sum L,    L the path length

A pixel with nothing in it counts depth d_max / 2 and C = 0; depth beyond d_max counts C = 1.

Shape symbols: C candidates, always `config.num_candidates`; h w pixels of a view.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.baselines.active_gs.confidence import aligned, glance, no_sightings, see
from r3jax.baselines.active_gs.regions import aimed_views, low_confidence, regions_of
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    Candidates,
    candidates_along,
    local_random,
    random_directions,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decision import PlannerState
from r3jax.planning.greedy import (
    Drawn,
    GreedyPolicy,
    Situation,
    draw_lots,
    score_by_pixels,
)
from r3jax.scoring.pixels import PixelView

EXPLORATION_WEIGHT = 1000.0
"""Weight of the share of all cells that are unexplored and in view."""

_REACH = 3.0
"""Voxels are drawn up to so many times the sensor's range: a known wall that is too far away for
a measurement promises nothing, which is not the same as an unseen one."""


def cells_and_doubt(view: PixelView) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Counts visible unexplored cells, and averages (1 - C) depth / d_max over the pixels.

    `view.rows` is the confidence C.
    """
    # Known, but too far to be measured: a look from here would not add to its confidence.
    is_far = view.hit & (view.depth > view.max_range)
    doubt = jnp.where(view.hit, jnp.where(is_far, 0.0, 1.0 - view.rows), 1.0)
    depth = jnp.where(view.hit, view.depth, 0.5 * view.max_range)
    return view.cells, jnp.mean(doubt * depth) / view.max_range


def draw_views(
    situation: Situation,
    config: PlannerConfig,
    count: np.ndarray,
    normal_sum: np.ndarray,
    *,
    key: Array,
) -> Candidates:
    """Draws up to `num_frontier` views of regions of interest; the others local, turned anyhow.

    Args:
        situation: where the robot can go, and what is unexplored.
        config: how many views.
        count: primitives of low confidence per cell, [X, Y, Z].
        normal_sum: sum of their normals, [3, X, Y, Z].
        key: source of randomness.

    Returns:
        `num_candidates` views; none if the robot can stop nowhere.
    """
    aim_key, local_key, direction_key = jax.random.split(key, 3)
    travel, unexplored = situation.travel, np.asarray(situation.scoring_grid.unexplored)
    regions = regions_of(travel.free, unexplored, count, normal_sum)
    places, aims = aimed_views(travel, regions, config.num_frontier, key=aim_key)
    local = local_random(travel, config.num_candidates - len(places), config.radius, key=local_key)
    positions = np.concatenate([places, local])
    directions = random_directions(len(local), key=direction_key)
    drawn = candidates_along(positions, np.concatenate([aims - places, directions]))
    return drawn.padded(config.num_candidates) if len(positions) else drawn


@dataclass(frozen=True)
class ActiveGS(GreedyPolicy):
    """Views of unexplored space and of far surfaces seen too rarely, too slanted or from afar."""

    name = "active-gs"
    source = "Active-GS, Jin et al., RA-L 2025"

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """No voxel was seen yet."""
        del camera, grid
        return no_sightings()

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Directions, distances and normals of the frame's voxels."""
        reach = self.config.scoring.max_range
        # The table may have grown with this frame, which moves its rows.
        before = aligned(state.memory, map_state)
        touched = see(before, map_state, frame, reach)
        return replace(state, memory=glance(before, touched, map_state, frame, reach))

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Up to `num_frontier` views of regions of interest; the others local, turned anyhow."""
        seen = aligned(situation.memory, situation.map_state)
        count, normal_sum = low_confidence(situation.map_state, seen, situation.scoring_grid)
        drawn = draw_views(
            situation, self.config, np.asarray(count), np.asarray(normal_sum), key=key
        )
        return Drawn(drawn, seen)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """U of every view, its two parts, and lots in case that every U is zero."""
        scoring, confidence = self.config.scoring, situation.memory.confidence
        reach = _REACH * float(scoring.max_range)
        cells, rendering = score_by_pixels(
            situation, cells_and_doubt, candidates, scoring, confidence, reach
        )
        # Of all cells of the box, not of those left: the weight means the same throughout a run.
        exploration = cells / situation.grid.log_odds.size
        return candidates, {
            "exploration": exploration,
            "rendering": rendering,
            "utility": EXPLORATION_WEIGHT * exploration + rendering,
        } | draw_lots(len(candidates.valid), key=key)

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The share of the utility less that of the path; the lots where nothing is of use."""
        is_reachable = np.isfinite(utilities["path"])
        # All zero: the path alone would keep the robot where it is for ever.
        if not np.any(utilities["utility"][is_reachable]):
            return np.where(is_reachable, utilities["lot"], -np.inf)
        return super().weigh(utilities)
