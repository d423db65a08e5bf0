"""Active-GS: views of unexplored space and of distant surfaces with low confidence.

    U = 1000 (visible unexplored cells / all cells) + mean over pixels of (1 - C) depth / d_max
    score = U / sum U - lambda2 L / sum L,    L the path length

A pixel with nothing in it counts depth d_max / 2 and C = 0; depth beyond d_max counts C = 1.

It aims at regions: the frontier, and cells with many voxels of low confidence C (`confidence`).

Shape symbols: C candidates, always `config.num_candidates`; h w pixels of a view; X Y Z cells along
the axes; N capacity of the map; R regions; n places.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.baselines.confidence import Sightings, aligned, glance, no_sightings, see
from r3jax.baselines.pixels import PixelView, score_by_pixels
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid, world_to_cell
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    VIEW_DISTANCE,
    Candidates,
    candidates_along,
    draw_lots,
    host_generator,
    local_random,
    random_directions,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import Drawn, GreedyPolicy, PlannerState
from r3jax.planning.policy import Situation
from r3jax.planning.robot.travel import Travel

LOW_CONFIDENCE = 0.3
"""Voxels with less confidence than this count as regions of interest."""

MANY = 5
"""A cell is a region of interest if it has more such voxels than this."""

PER_REGION = 5
"""Candidates aimed at one region, at most."""

MIN_COSINE = 0.5
"""Between a region's normal and the direction to a candidate, at least."""

_DRAWS = 128
"""Places tried per region."""

_BATCH = 32
"""Regions that are tried at once."""

_MOST = 256
"""Regions that are tried at all: the nearest."""

_INSET = 0.25
"""Candidates lie at most this far from their cell's center, along each axis [cells]."""

_FACES = [tuple(sign * (axis == i) for i in range(3)) for axis in range(3) for sign in (-1, 1)]


@dataclass(frozen=True)
class Regions:
    """Unexplored cells that count. On the host: NumPy."""

    cells: np.ndarray
    """Their indices, [R, 3] int64."""

    normals: np.ndarray
    """Unit vectors from which side to look, [R, 3]; 0 where no side is better."""


@jax.jit
def low_confidence(
    state: MapState, seen: Sightings, grid: OccupancyGrid
) -> tuple[Int[Array, "X Y Z"], Float[Array, "3 X Y Z"]]:
    """Counts the voxels of low confidence per cell, and sums their normals."""
    cell = world_to_cell(grid, state.center.T)
    shape = grid.log_odds.shape
    is_low = state.present & (seen.confidence < LOW_CONFIDENCE)
    flat = jnp.zeros(state.capacity, dtype=jnp.int32)
    for axis, n in enumerate(shape):
        # The map has no bounds, the grid has: voxels outside lie in no cell.
        is_low &= (cell[:, axis] >= 0) & (cell[:, axis] < n)
        flat = flat * n + cell[:, axis]
    # One past the end is dropped by the scatter; -1 would wrap round.
    flat = jnp.where(is_low, flat, grid.log_odds.size)
    count = jnp.zeros(grid.log_odds.size, dtype=jnp.int32).at[flat].add(1, mode="drop")
    total = jnp.zeros((3, grid.log_odds.size)).at[:, flat].add(seen.normal, mode="drop")
    return count.reshape(shape), total.reshape(3, *shape)


def regions_of(
    free: np.ndarray, unexplored: np.ndarray, count: np.ndarray, normal_sum: np.ndarray
) -> Regions:
    """Finds the frontier, and the cells of low confidence that have a free face neighbor.

    A frontier cell is unexplored and is looked at from the mean direction to its free face
    neighbors, any other from the mean normal of its voxels of low confidence.

    Args:
        free: cells known to be free, [X, Y, Z] bool.
        unexplored: cells neither free nor occupied, [X, Y, Z] bool.
        count: voxels of low confidence per cell, [X, Y, Z].
        normal_sum: sum of their normals, [3, X, Y, Z].
    """
    # Beyond the box nothing is known to be free: a border of zeros says so.
    padded = np.pad(free, 1)
    to_free = np.zeros((*free.shape, 3))
    has_free = np.zeros(free.shape, dtype=bool)
    for face in _FACES:
        window = tuple(slice(1 + d, 1 + d + n) for d, n in zip(face, free.shape, strict=True))
        to_free += padded[window][..., None] * np.array(face)
        has_free |= padded[window]
    cells = np.argwhere(has_free & (unexplored | (count > MANY)))
    at = tuple(cells.T)
    is_frontier = unexplored[at][:, None]
    normals = np.where(is_frontier, to_free[at], normal_sum[(slice(None), *at)].T)
    # Directions to free cells on opposite sides cancel: then no side is better.
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Regions(cells, np.where(length > 1e-6, normals / np.maximum(length, 1e-6), 0.0))


def aimed_views(
    travel: Travel, regions: Regions, num: int, *, key: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Finds up to `num` places to view regions from, for the nearest regions first.

    At most five for each: safe and reachable, 0.3 to 2 m from the region's center, within 60
    degrees of its normal, the straight line to its center free up to the region itself.

    Args:
        travel: where the robot may stop.
        regions: what to look at.
        num: places wanted.
        key: source of randomness.

    Returns:
        Places and the regions' centers, [n, 3] float64 each [m], n <= num, in order of the
        regions' distance from the robot.
    """
    rng = host_generator(key)
    # Nearest regions first: they are filled before the number of candidates is used up.
    distance = np.linalg.norm(travel.centers(regions.cells) - travel.start, axis=1)
    order = np.argsort(distance, kind="stable")[:_MOST]
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for begin in range(0, len(order), _BATCH):
        batch = order[begin : begin + _BATCH]
        cells = regions.cells[batch]
        places, is_good = _draw(travel, cells, regions.normals[batch], rng)
        # The cheap tests come first; lines are walked only for what passed them.
        is_good[is_good] = _is_clear(travel, places[is_good], cells[np.nonzero(is_good)[0]])
        for cell, row, good in zip(cells, places, is_good, strict=True):
            wanted = min(PER_REGION, num - len(found))
            found += [(place, travel.centers(cell)) for place in row[good][:wanted]]
        if len(found) == num:
            break
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3))
    return np.stack([place for place, _ in found]), np.stack([aim for _, aim in found])


def _draw(
    travel: Travel, cells: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draws random places round cells, [R, _DRAWS, 3] [m], and checks which are suitable."""
    closest, farthest = VIEW_DISTANCE
    aims = travel.centers(cells)[:, None, :]
    directions = _draw_directions(normals, rng)
    # Cube roots of uniform numbers are uniform in volume, not crowded at the center.
    cubed = rng.uniform(closest**3, farthest**3, size=(len(cells), _DRAWS, 1))
    index = (aims + np.cbrt(cubed) * directions - travel.origin) / travel.cell_size
    stop = np.floor(index).astype(np.int64)
    middle = stop + 0.5
    places = travel.origin + np.clip(index, middle - _INSET, middle + _INSET) * travel.cell_size
    size = np.array(travel.goals.shape)
    is_inside = np.all((stop >= 0) & (stop < size), axis=2)
    # Clipped for the lookup alone: `is_inside` has already refused what lies outside.
    stop = np.clip(stop, 0, size - 1)
    is_good = is_inside & travel.goals[tuple(np.moveaxis(stop, 2, 0))]
    # Measured again: keeping off the faces of cells has moved the places.
    offset = places - aims
    distance = np.linalg.norm(offset, axis=2)
    is_good &= (distance >= closest) & (distance <= farthest)
    cosine = np.sum(offset * normals[:, None, :], axis=2)
    has_side = np.any(normals != 0.0, axis=1, keepdims=True)
    return places, is_good & (~has_side | (cosine >= MIN_COSINE * distance))


def _draw_directions(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws random unit vectors within 60 degrees of normals [R, 3], [R, _DRAWS, 3].

    Where the normal is zero, they are uniform on the sphere.
    """

    def unit(x: np.ndarray) -> np.ndarray:
        return x / np.maximum(np.linalg.norm(x, axis=2, keepdims=True), 1e-12)

    anywhere = rng.normal(size=(len(normals), _DRAWS, 3))
    # Uniform in the cosine is uniform over the cap; in the angle it would crowd at the normal.
    cosine = rng.uniform(MIN_COSINE, 1.0, size=(len(normals), _DRAWS, 1))
    axis = normals[:, None, :]
    across = unit(anywhere - np.sum(anywhere * axis, axis=2, keepdims=True) * axis)
    around = cosine * axis + np.sqrt(1.0 - cosine * cosine) * across
    return np.where(np.any(axis != 0.0, axis=2, keepdims=True), around, unit(anywhere))


def _is_clear(travel: Travel, places: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Checks which lines from places to cells run through free cells and that cell, [n].

    Every quarter of a cell is looked at: what a line only grazes does not hide its end.
    """
    start = (places - travel.origin) / travel.cell_size
    # As many steps for every line as for the longest: one array, no loop over lines.
    steps = int(np.ceil(4.0 * VIEW_DISTANCE[1] / travel.cell_size))
    t = np.linspace(0.0, 1.0, steps + 1)[:, None]
    line = start[:, None, :] + t * (cells[:, None, :] + 0.5 - start[:, None, :])
    crossed = np.floor(line).astype(np.int64)  # inside the grid, as both ends are
    is_end = np.all(crossed == cells[:, None, :], axis=2)
    return np.all(is_end | travel.free[tuple(np.moveaxis(crossed, 2, 0))], axis=1)


EXPLORATION_WEIGHT = 1000.0
"""Weight of the share of all cells that are unexplored and in view."""

_REACH = 3.0
"""Voxels are drawn up to this multiple of the sensor's range: a known wall that is too far away for
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
        situation: paths of the robot, and the unexplored space.
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
    """Views of unexplored space and of surfaces seen too rarely, too obliquely or too far away."""

    name = "active-gs"
    source = "Active-GS, Jin et al., RA-L 2025"

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Any:
        """Returns the memory before the first frame: no voxel has been seen."""
        del camera, grid
        return no_sightings()

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Adds the directions, distances and normals of the frame's voxels to the memory."""
        reach = self.config.scoring.max_range
        # The table may have grown with this frame, which moves its rows.
        before = aligned(state.memory, map_state)
        touched = see(before, map_state, frame, reach)
        return replace(state, memory=glance(before, touched, map_state, frame, reach))

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws up to `num_frontier` views of regions of interest, and other views nearby."""
        seen = aligned(situation.memory, situation.map_state)
        count, normal_sum = low_confidence(situation.map_state, seen, situation.scoring_grid)
        drawn = draw_views(
            situation, self.config, np.asarray(count), np.asarray(normal_sum), key=key
        )
        return Drawn(drawn, seen)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes U of every view and its two parts; random scores decide if every U is 0."""
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
        """Computes the utility's share minus the path's; random scores if all utilities are 0."""
        is_reachable = np.isfinite(utilities["path"])
        # All zero: the path alone would keep the robot where it is.
        if not np.any(utilities["utility"][is_reachable]):
            return np.where(is_reachable, utilities["lot"], -np.inf)
        return super().weigh(utilities)
