"""Merges the voxels of a map into blocks for drawing, and colors them by renderability.

A map of a house has a million voxels; a browser can draw a tenth of that. Voxels are merged in
pairs along each axis, repeatedly, until few enough are left: surfaces stay closed and only become
coarser.

R depends on a voxel and a camera. To color a map, R and its terms are averaged over positions that
see the voxel: either positions spread over known free space, or that of the dragged camera.

Shape symbols: N rows of the map; m occupied ones; n blocks; P positions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.apps.viewer.pictures import CAUSE_COLORS, TERMS, UNSEEN, paint
from r3jax.apps.viewer.story import Moment
from r3jax.errors import InputError
from r3jax.exploration.coverage import probe_poses
from r3jax.exploration.taken_views import StepRow
from r3jax.geometry.cameras import Camera
from r3jax.geometry.selection import for_selected
from r3jax.geometry.voxels import INDEX_LIMIT, unpack
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.seen import visible_rows
from r3jax.mapping.state import MapState
from r3jax.runs.header import RunHeader
from r3jax.runs.replay import Reason
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.explain import CAUSES
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.views import panorama_view

NUM_PROBES = 24
"""Number of positions over which a map's colors are averaged: enough to see every room of a large
house."""


class SurfaceTerms(eqx.Module):
    """The terms of every row of a map, each a mean over the positions that see it."""

    value: Float[Array, " N"]
    """R; 0 where no position sees the voxel."""

    bias: Float[Array, " N"]
    """b, the term of the angle; 0 where no position sees the voxel."""

    noise: Float[Array, " N"]
    """eps, the term of the color's consistency; 0 where no position sees the voxel."""

    resolution: Float[Array, " N"]
    """gamma, the term of the resolution; 0 where no position sees the voxel."""

    sightings: Float[Array, " N"]
    """Number of positions that see the voxel."""


def probe_positions(grid: OccupancyGrid, num: int = NUM_PROBES) -> np.ndarray:
    """Returns positions in known free space [m], evenly spread, [P, 3] float32, P <= num.

    They are those of the probe views that measure a run's mean renderability.
    """
    return np.asarray(probe_poses(grid, num)[:, :3, 3], dtype=np.float32)


def surface_terms(
    state: MapState,
    camera: Camera,
    positions: np.ndarray,
    config: ScoringConfig,
    *,
    pad_to: int = 1,
) -> SurfaceTerms:
    """Computes the terms of every voxel, averaged over the positions that see it.

    Args:
        state: the map.
        camera: its focal length sets the target resolution.
        positions: camera centers [P, 3] [m]; every direction round them counts.
        config: range and settings of the closed forms.
        pad_to: pads to this number of positions, so that a growing set compiles once.
    """
    given = np.asarray(positions, dtype=np.float32).reshape(-1, 3)
    missing = max(pad_to, 1) - len(given)
    padded = np.concatenate([given, np.zeros((max(missing, 0), 3), np.float32)])
    is_real = np.arange(len(padded)) < len(given)
    return _surface_terms(state, camera, jnp.asarray(padded), jnp.asarray(is_real), config)


@jax.jit
def _surface_terms(
    state: MapState,
    camera: Camera,
    positions: Float[Array, "P 3"],
    is_real: Bool[Array, " P"],
    config: ScoringConfig,
) -> SurfaceTerms:
    def add(i: Int[Array, ""], totals: Float[Array, "5 N"]) -> Float[Array, "5 N"]:
        return jax.lax.cond(
            is_real[i],
            lambda: _add_sightings(state, camera, positions[i], config, totals),
            lambda: totals,
        )

    start = jnp.zeros((5, state.capacity), dtype=jnp.float32)
    totals = jax.lax.fori_loop(0, positions.shape[0], add, start)
    mean = totals[:4] / jnp.maximum(totals[4:], 1.0)
    return SurfaceTerms(mean[0], mean[1], mean[2], mean[3], totals[4])


def _add_sightings(
    voxels: MapState,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    totals: Float[Array, "5 N"],
) -> Float[Array, "5 N"]:
    """Adds the terms of the voxels that one position sees, and one sighting each."""
    visible = visible_rows(voxels, panorama_view(position, config), config)
    num = totals.shape[1]

    def add(
        index: Int[Array, " K"], valid: Bool[Array, " K"], totals: Float[Array, "5 N"]
    ) -> Float[Array, "5 N"]:
        part = score_voxels(voxels.take(index, valid), position, camera.focal, config.score)
        rows = [part.value, part.bias, part.noise, part.resolution, jnp.ones_like(part.value)]
        target = jnp.where(valid, index, num)  # out of range on purpose: dropped
        return totals.at[:, target].add(jnp.stack(rows), mode="drop")

    return for_selected(visible, add, totals)


BUDGET = 300_000
"""Maximum number of blocks for a browser."""

QUANTITIES = (*TERMS, "color")
"""Quantities to color blocks by: R, its terms, and the mean observed color."""


CAUSE = "cause"
"""Colors blocks by the cause of a view; not one of `QUANTITIES`, as it depends on the view."""


@dataclass(frozen=True)
class Blocks:
    """The occupied voxels of a map, merged."""

    centers: np.ndarray
    """Mean center of the voxels in each block [m], [n, 3] float32."""

    edge: float
    """Edge of a block [m]."""

    rows: np.ndarray
    """The occupied rows of the map, [m]."""

    block_of: np.ndarray
    """The block of each of them, [m]."""

    @property
    def num_voxels(self) -> int:
        """Number of voxels in the blocks."""
        return len(self.rows)

    def mean(self, values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Computes the weighted mean over the voxels of each block.

        Args:
            values: of every row of the map, [N].
            weights: of every row, [N]; None: all alike.

        Returns:
            [n] float64; NaN where the weights of a block sum to 0.
        """
        weight = np.ones(len(self.rows)) if weights is None else np.asarray(weights)[self.rows]
        num = len(self.centers)
        totals = np.bincount(self.block_of, weight, num)
        sums = np.bincount(self.block_of, weight * np.asarray(values)[self.rows], num)
        return np.where(totals > 0.0, sums / np.where(totals > 0.0, totals, 1.0), np.nan)


def blocks_of(map_state: MapState, budget: int = BUDGET) -> Blocks:
    """Groups the voxels of a map into at most `budget` blocks, as fine as that allows.

    Raises:
        ValueError: a budget without a block.
    """
    if budget < 1:
        raise InputError(f"budget must be at least 1 block, got {budget}")
    rows = np.flatnonzero(np.asarray(map_state.present))
    # All rows, used or not: another number of them would make JAX recompile.
    index = np.asarray(jnp.stack(unpack(map_state.key[0], map_state.key[1])))[:, rows]
    size = float(map_state.voxel_size)
    points = (index.astype(np.float64) + 0.5) * size
    # Counted from the lowest index there is: halving -1 and 0 would never make them one.
    counted = index.astype(np.int64) + INDEX_LIMIT
    halvings, block_of, num = 0, np.arange(len(rows)), len(rows)
    while num > budget:
        halvings += 1
        merged, block_of = np.unique(_packed(counted >> halvings), return_inverse=True)
        num = len(merged)
    count = np.maximum(np.bincount(block_of, minlength=num), 1)
    centers = np.stack([np.bincount(block_of, axis, num) / count for axis in points], axis=1)
    return Blocks(centers.astype(np.float32), size * 2.0**halvings, rows, block_of)


def _packed(index: np.ndarray) -> np.ndarray:
    """Packs each index [3, m], from 0 on, into one number."""
    x, y, z = index
    return (x << 42) | (y << 21) | z


def block_values(blocks: Blocks, terms: SurfaceTerms, quantity: str) -> np.ndarray:
    """Computes R or a term per block, [n] in [0, 1]; NaN where no position sees any of its voxels.

    Raises:
        KeyError: there is no such term.
    """
    of_term = (terms.value, terms.bias, terms.noise, terms.resolution)
    rows: dict[str, Array] = dict(zip(TERMS, of_term, strict=True))
    is_seen = (np.asarray(terms.sightings) > 0.0).astype(np.float64)
    return blocks.mean(np.asarray(rows[quantity]), is_seen)


def block_causes(blocks: Blocks, capacity: int, reason: Reason) -> np.ndarray:
    """Finds the cause with the largest share in the deficit of each block for a view, [n] int.

    Args:
        blocks: of the map that the view was chosen on.
        capacity: rows of that map, N.
        reason: of the view.

    Returns:
        An index into `scoring.explain.CAUSES`; 0, which no voxel has, where the view was to see
        none of the block, or none that lacked anything.
    """
    lack = np.zeros((len(CAUSES) - 1, capacity))
    lack[:, reason.rows] = reason.shares
    means = np.stack([blocks.mean(of_cause) for of_cause in lack])
    return np.where(means.max(axis=0, initial=0.0) > 0.0, 1 + np.argmax(means, axis=0), 0)


_SHADE = 0.5
"""How much the grays of what was not to be seen follow the light of the map's own colors."""


def cause_colors(causes: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns the color per block, [n, 3] uint8, of the causes from `block_causes` [n].

    Args:
        causes: per block; where none took anything, it is gray.
        own: the map's own colors [n, 3] uint8: as light as they are, grays show walls and doors.
    """
    light = own.mean(axis=1, keepdims=True) if len(own) else np.zeros((0, 1))
    grays = np.rint((1.0 - _SHADE) * np.asarray(UNSEEN) + _SHADE * light).astype(np.uint8)
    table = np.stack([np.asarray(UNSEEN, np.uint8), *CAUSE_COLORS[1:]])
    return np.where((causes == 0)[:, None], grays, table[causes])


def block_colors(
    blocks: Blocks, map_state: MapState, terms: SurfaceTerms | None, quantity: str
) -> np.ndarray:
    """Computes the color per block, [n, 3] uint8.

    Args:
        blocks: of the map.
        map_state: the map.
        terms: of the map; not needed for `color`.
        quantity: one of `QUANTITIES`.
    """
    if quantity == "color" or terms is None:
        channels = [blocks.mean(channel) for channel in np.asarray(map_state.mean)]
        stacked = np.stack(channels, axis=1) if channels else np.zeros((0, 3))
        return np.rint(stacked.clip(0.0, 1.0) * 255.0).astype(np.uint8)
    return paint(block_values(blocks, terms, quantity))


_ABOVE_HEADS = 0.6
_BELOW_CEILING = 0.3


@dataclass(frozen=True)
class Known:
    """A moment, ready to be drawn."""

    moment: Moment
    blocks: Blocks

    terms: SurfaceTerms | None
    """As probes in known free space see them; None where only colors are wanted."""


def known_at(
    moment: Moment, camera: Camera, config: ScoringConfig, budget: int, *, with_terms: bool = True
) -> Known:
    """Groups a moment's map into blocks, and scores its voxels from known free space.

    Args:
        moment: the moment.
        camera: of the run.
        config: of the scores.
        budget: blocks at most.
        with_terms: False leaves the terms out, which take most of the time.
    """
    state = moment.map_state
    terms = None
    if with_terms:
        positions = probe_positions(moment.grid)
        terms = surface_terms(state, camera, positions, config, pad_to=NUM_PROBES)
    return Known(moment, blocks_of(state, budget), terms)


def scoring_of(header: RunHeader) -> ScoringConfig:
    """Returns the settings of the scores, with the range of the run's sensor."""
    max_range = float(header.config.get("max_range", 5.0))
    return ScoringConfig(max_range=jnp.asarray(max_range, dtype=jnp.float32))


def title_of(header: RunHeader) -> str:
    """Names a run by its policy and its scene; of a file, without its folders."""
    scene = str(header.scene.get("name", "")).rpartition("/")[2]
    return f"{header.policy.get('name', '')} in {scene}"


def cut_height(rows: Sequence[StepRow], points: np.ndarray) -> float:
    """Returns the height [m] above which nothing is drawn, so that the place is open from above.

    Args:
        rows: of the trace, at least one: the cameras stay in view.
        points: centers of blocks [n, 3] [m].
    """
    typical = float(np.median([row.pose[2, 3] for row in rows])) + _ABOVE_HEADS
    if len(points) == 0:
        return typical
    # Below the ceiling in any case, even where the cameras flew right under it.
    return min(typical, float(np.percentile(points[:, 2], 99.5)) - _BELOW_CEILING)
