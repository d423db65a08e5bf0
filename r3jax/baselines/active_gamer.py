"""ActiveGAMER on r3jax's map: a pool of lattice views, ranked by their number of empty pixels.

Candidates are kept between decisions (`Pool`). Those of stage 0 lie on a 1 m lattice,
1.75 m above the floor, with 5 directions each; those of stage 1 on a 0.5 m lattice, 1.0 and 2.5 m
above it, with 15. With the gain g = share of the view's pixels in which the map shows nothing, at
any distance, and the straight distance d to the candidate [m], over the candidates scored:

    score = (1 - softmax(d)) g / sum(g)

A candidate with g < 0.5 % leaves the pool for good. A stage ends for good when every candidate
that its pool ever held has left.

Choices that the paper leaves to its scenes' settings or to its simulator:

* Its candidates are free cells at a distance from surfaces; here, cells in which the robot may
  stop.
* It reads the true depth to leave out pixels that no view can fill, such as windows. Instead, a
  view that was chosen leaves the pool: what it did not show then, it will never show.
* It scores the whole pool at every decision. Here at most `num_candidates` are scored: those with
  the greatest gain when last scored first, those never scored counting as wholly empty; ties
  nearest first. Gains hardly ever rise, so that old ones bound new ones.
* When no candidate of an open stage can be reached, and after the last stage, views are random.
* Its robot takes a frame every 0.1 m and 10 degrees of its path, and maps them all; here that is
  `capture_every`, for every policy.

A candidate is a column of a stage's lattice, a level above the floor and a direction. It stands
in the cell of the column in which the robot may stop that is nearest to the level, within 0.5 m:
ceilings may be low. It enters the pool when there is such a cell, and sits out the decisions for
which there is none.

The arrays have a place for every candidate that the grid's box allows: the pool cannot overflow,
and cannot hold a candidate twice.

Shape symbols: X Y Z cells; P places of a stage (columns x levels); D its directions; C
candidates drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.baselines.pixels import PixelView, score_pixels
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates, candidates_along, draw_lots, free_views
from r3jax.planning.decide import Drawn, GreedyPolicy, Scored
from r3jax.planning.policy import Situation
from r3jax.planning.robot.limits import UNBOUND, Limits
from r3jax.planning.robot.travel import Travel
from r3jax.scoring.config import ScoringConfig

LEAST_GAIN = 0.005
"""Minimum share of empty pixels of a view."""

_SLACK = 0.5
"""A candidate stands at most this far above or below its level [m]."""

_BELOW_FLOOR = 0.02
"""Share of the known free cells that may lie below the floor: seen through
windows, or put there by the sensor's noise."""


@dataclass(frozen=True)
class LatticeStage:
    """Where the candidates of one stage lie."""

    spacing: float
    """Lattice spacing along x and y [m]."""

    heights: tuple[float, ...]
    """Levels above the floor, ascending [m]."""

    num_directions: int
    """Directions of the Fibonacci lattice at every place."""

    def columns(self, grid_shape: Sequence[int], cell_size: float) -> np.ndarray:
        """Finds the cells (x, y) that hold a point of the lattice, [n, 2], each once.

        The lattice lies half a spacing inside the box's lower corner.
        """
        axes: list[np.ndarray] = []
        for length in grid_shape[:2]:
            points = np.arange(0.5 * self.spacing, length * cell_size, self.spacing)
            # The nudge puts points that lie on a border of cells on the same side of it.
            cells = np.floor(points / cell_size + 1e-3).astype(np.int64)
            # Cells wider than the spacing hold several points, and are still one place.
            axes.append(np.unique(cells[cells < length]))
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)

    def places(self, travel: Travel) -> tuple[np.ndarray, np.ndarray]:
        """Finds the cell [P, 3] of each place's candidates, and where there is one [P].

        Places are ordered by column, then by level. The levels share a column's cells out among
        them, so that no two places ever mean the same cell.
        """
        columns = self.columns(travel.usable.shape, travel.cell_size)
        # Safe ones only: the robot's own cell is a goal without the margin, but only for now.
        stops = (travel.goals & travel.safe)[tuple(columns.T)]
        layer_of_floor = floor_layer(travel.free)
        height = (np.arange(stops.shape[1]) + 0.5 - layer_of_floor) * travel.cell_size
        lowest, highest = (np.array(travel.heights) - travel.origin[2]) - (
            layer_of_floor * travel.cell_size
        )
        # Cells halfway between two levels belong to one of them only.
        borders = [-np.inf, *(0.5 * (a + b) for a, b in pairwise(self.heights)), np.inf]
        layers: list[np.ndarray] = []
        is_there: list[np.ndarray] = []
        for level, (low, high) in zip(self.heights, pairwise(borders), strict=True):
            # A robot that never comes up or down to the level has it where it comes nearest.
            gap = np.abs(height - np.clip(level, lowest, highest))
            may_stand = stops & (height >= low) & (height < high) & (gap <= _SLACK + 1e-6)
            gaps = np.where(may_stand, gap, np.inf)
            # Where no cell will do, argmin says 0: the flag beside it tells that from layer 0.
            layers.append(gaps.argmin(axis=1))
            is_there.append(may_stand.any(axis=1))
        cells = np.repeat(columns, len(self.heights), axis=0)
        layer = np.stack(layers, axis=1).reshape(-1, 1)
        return np.concatenate([cells, layer], axis=1), np.stack(is_there, axis=1).reshape(-1)


STAGES = (LatticeStage(1.0, (1.75,), 5), LatticeStage(0.5, (1.0, 2.5), 15))
"""Coarse, then fine."""


def floor_layer(free: np.ndarray) -> int:
    """Finds the lowest layer of free cells [X, Y, Z], ignoring the lowest 2 % of them.

    The layer is 0 if no cell is free.
    """
    layers = np.nonzero(free)[2]
    return int(np.quantile(layers, _BELOW_FLOOR, method="higher")) if len(layers) else 0


class Pool(eqx.Module):
    """Every candidate that one stage can ever have, so that none is ever held twice or lost."""

    entered: Bool[Array, "P D"] = eqx.field(converter=jnp.asarray)
    """Candidates that could be stood at, once."""

    left: Bool[Array, "P D"] = eqx.field(converter=jnp.asarray)
    """Those that gained nothing or were chosen; they never return."""

    gain: Float[Array, "P D"] = eqx.field(converter=jnp.asarray)
    """Share of empty pixels when last scored; 1 before."""

    @property
    def is_spent(self) -> bool:
        """True if it once held candidates and none is left."""
        return bool(jnp.any(self.entered)) and bool(jnp.all(self.left == self.entered))


class Pools(eqx.Module):
    """What the policy remembers."""

    of_stage: tuple[Pool, ...]

    num_ended: Int[Array, ""] = eqx.field(converter=jnp.asarray)
    """Stages that are over for good."""


@dataclass(frozen=True)
class Draw:
    """The candidates that are scored in one decision. All arrays [C] hold at least one."""

    stage: int

    place: np.ndarray
    """Row of each in the stage's pool."""

    direction: np.ndarray
    """Column of each in the stage's pool."""

    candidates: Candidates
    """Views from those places along those directions."""

    distance: np.ndarray
    """Straight from the robot [m]."""


def empty_pools(grid_shape: Sequence[int], cell_size: float) -> Pools:
    """Makes pools for a grid in which nothing is known yet."""
    pools: list[Pool] = []
    for stage in STAGES:
        num_places = len(stage.columns(grid_shape, cell_size)) * len(stage.heights)
        shape = (num_places, stage.num_directions)
        nothing = np.zeros(shape, dtype=bool)
        pools.append(Pool(nothing, nothing, np.ones(shape, dtype=np.float32)))
    return Pools(tuple(pools), np.zeros((), dtype=np.int32))


def admit(pool: Pool, has_place: np.ndarray) -> Pool:
    """Adds all directions of the places [P] where a camera can stand to the pool."""
    return replace(pool, entered=np.asarray(pool.entered) | has_place[:, None])


def dismiss(pool: Pool, draw: Draw, gain: np.ndarray, best: int) -> Pool:
    """Notes the gains [C]; the chosen candidate and those without gain leave."""
    is_done = gain < LEAST_GAIN
    # What the chosen view did not show now, it will never show.
    is_done[best] = True
    remembered, left = np.array(pool.gain), np.array(pool.left)
    remembered[draw.place, draw.direction] = gain
    left[draw.place, draw.direction] |= is_done
    return replace(pool, gain=remembered, left=left)


def draw_candidates(
    pools: Pools, travel: Travel, num: int, limits: Limits = UNBOUND
) -> tuple[Pools, Draw | None]:
    """Updates the pools, and draws up to `num` candidates of the first stage that has any.

    Those for which the camera cannot turn far enough on the path from here are left out, too.
    """
    of_stage, num_ended = list(pools.of_stage), int(pools.num_ended)
    found = None
    # Stages before the one that is due have ended for good. Later ones step in while it has no
    # candidate that can be reached.
    for k in range(num_ended, len(STAGES)):
        cells, has_place = STAGES[k].places(travel)
        of_stage[k] = pool = admit(of_stage[k], has_place)
        # Only the stage that is due may end: a later one waits, even if it is spent for now.
        if k == num_ended and pool.is_spent:
            num_ended += 1
            continue
        lattice = fibonacci_lattice(STAGES[k].num_directions)
        can_turn = limits.may_turn(travel.stops(cells)[:, None, :], lattice)
        is_open = np.asarray(pool.entered & ~pool.left) & has_place[:, None] & can_turn
        if is_open.any():
            found = _best_remembered(pool, is_open, travel, cells, k, num)
            break
    return Pools(tuple(of_stage), np.int32(num_ended)), found


def _best_remembered(
    pool: Pool, is_open: np.ndarray, travel: Travel, cells: np.ndarray, stage: int, num: int
) -> Draw:
    """Selects up to `num` open candidates [P, D]: the greatest gains, then the nearest."""
    place, direction = np.nonzero(is_open)
    positions = travel.stops(cells[place])
    distance = np.linalg.norm(positions - travel.start, axis=1)
    # Gains hardly ever rise, so that an old one is a bound, and 1 means never scored.
    remembered = np.asarray(pool.gain)[place, direction]
    # The last key of a lexsort rules: gains first, distances among equals.
    order = np.lexsort((distance, -remembered))[:num]
    place, direction = place[order], direction[order]
    lattice = fibonacci_lattice(STAGES[stage].num_directions)
    views = candidates_along(positions[order], lattice[direction])
    return Draw(stage, place, direction, views, distance[order])


def empty_share(view: PixelView) -> Float[Array, ""]:
    """Computes the gain: the share of pixels in which the map shows nothing."""
    return jnp.mean(~view.hit, dtype=jnp.float32)


def score_of(gain: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Computes (1 - softmax(d)) g / sum(g) of gains and distances [m], [C] each.

    All scores are 0 if all gains are 0.
    """
    # Shifted by the largest: exp of a hundred meters would overflow.
    far = np.exp(distance - distance.max())
    return (1.0 - far / far.sum()) * gain / (gain.sum() or 1.0)


@dataclass(frozen=True)
class ActiveGamer(GreedyPolicy):
    """The view with most empty pixels in a pool of lattice views, discounted by distance."""

    name = "active-gamer"
    source = "ActiveGAMER, Chen et al., CVPR 2025"

    def first_memory(self, camera: Camera, grid: OccupancyGrid) -> Pools:
        """Returns empty pools."""
        del camera
        return empty_pools(grid.log_odds.shape, float(grid.cell_size))

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws candidates from the pools, and notes their places there.

        If the pools have none, any nearby views are drawn.
        """
        num = self.config.num_candidates
        pools, found = draw_candidates(situation.memory, situation.travel, num, situation.limits)
        if found is None:
            return Drawn(free_views(situation.travel, num, self.config.radius, key=key), pools)
        return Drawn(found.candidates.padded(num), pools, notes=found)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes the gain and distance of the pool's candidates; others draw random scores."""
        if situation.notes is None:
            return candidates, draw_lots(len(candidates.valid), key=key)
        gain = self._gain(situation.camera, situation.map_state, situation.grid, candidates)
        # Padding must have no share in the sums of the score: no gain, and no distance.
        distance = np.full(len(gain), -np.inf)
        distance[candidates.valid] = situation.notes.distance
        return candidates, {"utility": gain, "distance": distance}

    def score_again(
        self, situation: Situation, candidates: Candidates, *, before: np.ndarray, key: Array
    ) -> Scored:
        """Keeps the order of the candidates: their places in the pool are no longer known."""
        del situation, key
        return candidates, {"lot": before}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the score of the paper, or random scores: the path itself costs nothing."""
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
        """Removes the chosen candidate and those without gain from the pool."""
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
        """Returns the settings of the score.

        Voxels of the map count at any distance within the box.
        """
        # The diagonal of the box: nothing within it is out of range.
        extent = np.linalg.norm(grid.log_odds.shape) * float(grid.cell_size)
        return replace(self.config.scoring, max_range=extent)

    def _gain(
        self, camera: Camera, map_state: MapState, grid: OccupancyGrid, candidates: Candidates
    ) -> np.ndarray:
        """Computes the share of empty pixels of each view [C]; 0 for padding."""
        poses, scoring = candidates.poses_on_device(), self.scoring_for(grid)
        gain = score_pixels(empty_share, map_state, grid, camera, poses, scoring)
        return np.where(candidates.valid, np.asarray(gain, dtype=np.float64), 0.0)
