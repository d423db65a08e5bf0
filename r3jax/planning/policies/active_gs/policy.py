"""Active-GS: views that show much of the unknown and much that is not believed yet, far away.

    U = 1000 (visible unexplored cells / all cells) + mean over pixels of (1 - C) depth / d_max
    score = U / sum U - lambda2 L / sum L,    L the path length

A pixel with nothing in it counts depth d_max / 2 and C = 0; depth beyond d_max counts C = 1.

Shape symbols: C candidates, always `config.num_candidates`; h w pixels of a view.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import local_random, poses_along, random_directions
from r3jax.planning.decision import PlannerState
from r3jax.planning.greedy import (
    Drawn,
    GreedyPolicy,
    Situation,
    draw_lots,
    score_by_pixels,
)
from r3jax.planning.policies.active_gs.confidence import aligned, no_sightings, see
from r3jax.planning.policies.active_gs.glance import glance
from r3jax.planning.policies.active_gs.regions import aimed_views, low_confidence, regions_of
from r3jax.scoring.pixels import PixelView, Value

EXPLORATION_WEIGHT = 1000.0
"""Of the share of all cells that are unexplored and in view."""

_REACH = 3.0
"""Voxels are drawn up to so many times the sensor's range: a known wall that is too far away for
a measurement promises nothing, which is not the same as an unseen one."""


def rendering_with_depth(view: PixelView) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Visible unexplored cells, and the mean over pixels of (1 - C) depth / d_max."""
    doubt, depth = _doubt(view)
    return view.cells, jnp.mean(doubt * depth) / view.max_range


def rendering_without_depth(view: PixelView) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Visible unexplored cells, and the mean over pixels of 1 - C."""
    return view.cells, jnp.mean(_doubt(view)[0])


def _doubt(view: PixelView) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """1 - C and the depth [m] of every pixel; `view.rows` is the confidence C."""
    is_far = view.hit & (view.depth > view.max_range)
    doubt = jnp.where(view.hit, jnp.where(is_far, 0.0, 1.0 - view.rows), 1.0)
    return doubt, jnp.where(view.hit, view.depth, 0.5 * view.max_range)


@dataclass(frozen=True)
class ActiveGS(GreedyPolicy):
    """Views of unexplored space and of far surfaces seen too rarely, too slanted or from afar."""

    name = "active-gs"
    source = "Active-GS, Jin et al., RA-L 2025"

    rendering: ClassVar[Value] = staticmethod(rendering_with_depth)
    """What a view shows, in two numbers."""

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """No voxel was seen yet."""
        del camera, grid
        return no_sightings()

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Directions, distances and normals of the frame's voxels."""
        reach = self.config.scoring.max_range
        before = aligned(state.memory, map_state)
        touched = see(before, map_state, frame, reach)
        return replace(state, memory=glance(before, touched, map_state, frame, reach))

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Up to `num_frontier` views of regions of interest; the others local, turned anyhow."""
        aim_key, local_key, direction_key = jax.random.split(key, 3)
        config, travel, grid = self.config, situation.travel, situation.scoring_grid
        seen = aligned(situation.memory, situation.map_state)
        count, normal_sum = low_confidence(situation.map_state, seen, grid)
        regions = regions_of(
            travel.free, np.asarray(grid.unexplored), np.asarray(count), np.asarray(normal_sum)
        )
        places, aims = aimed_views(travel, regions, config.num_frontier, key=aim_key)
        local = local_random(
            travel, config.num_candidates - len(places), config.radius, key=local_key
        )
        positions = np.concatenate([places, local])
        if len(positions) == 0:
            return Drawn(np.zeros((0, 4, 4)), seen)
        directions = random_directions(len(local), key=direction_key)
        directions = np.concatenate([aims - places, directions])
        # Nothing local: repeats keep the shape.
        repeats = np.arange(config.num_candidates) % len(positions)
        return Drawn(poses_along(positions[repeats], directions[repeats]), seen)

    def score(
        self, situation: Situation, poses: np.ndarray, *, key: Array
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """U of every pose, its two parts, and lots in case that every U is zero."""
        scoring, confidence = self.config.scoring, situation.memory.confidence
        reach = _REACH * float(scoring.max_range)
        cells, rendering = score_by_pixels(
            situation, self.rendering, poses, scoring, confidence, reach
        )
        exploration = cells / situation.grid.log_odds.size
        return poses, {
            "exploration": exploration,
            "rendering": rendering,
            "utility": EXPLORATION_WEIGHT * exploration + rendering,
        } | draw_lots(len(poses), key=key)

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """The share of the utility less that of the path; the lots where nothing is of use."""
        is_reachable = np.isfinite(utilities["path"])
        if not np.any(utilities["utility"][is_reachable]):
            return np.where(is_reachable, utilities["lot"], -np.inf)
        return super().weigh(utilities)


@dataclass(frozen=True)
class ActiveGSNoDepth(ActiveGS):
    """Active-GS without its depth factor: mean of (1 - C) over pixels, whatever their depth."""

    name = "active-gs-no-depth"
    source = "Active-GS, Jin et al., RA-L 2025: an ablation"

    rendering = staticmethod(rendering_without_depth)
