"""The voxels of a map as few enough blocks to be drawn.

A map of a house has a million voxels; a browser wants a tenth of that. Voxels are merged by
twos along each axis, again and again, until few enough are left: surfaces stay closed, whatever the
budget, and only get coarser.

Shape symbols: N rows of the map; m occupied ones; n blocks.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.apps.viewer.colors import CAUSE_COLORS, UNSEEN, paint
from r3jax.apps.viewer.look import TERMS
from r3jax.apps.viewer.terms import SurfaceTerms
from r3jax.exploration.explain_run import Reason
from r3jax.geometry.voxels import INDEX_LIMIT, unpack
from r3jax.mapping.state import MapState
from r3jax.scoring.explain import CAUSES

BUDGET = 120_000
"""Blocks that a browser gets at most."""

QUANTITIES = (*TERMS, "color")
"""What blocks can be colored by: R, its terms, and the mean color that was seen."""


CAUSE = "cause"
"""Colors blocks by why a view was taken; beside `QUANTITIES`, for that depends on the view."""


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
        """Voxels that the blocks stand for."""
        return len(self.rows)

    def mean(self, values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """The weighted mean over the voxels of each block.

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
    """The voxels of a map in at most `budget` blocks, as fine as that allows.

    Raises:
        ValueError: a budget without a block.
    """
    if budget < 1:
        raise ValueError(f"budget must be at least 1 block, got {budget}")
    rows = np.flatnonzero(np.asarray(map_state.occupied))
    # All rows, used or not: of another number of them, JAX would compile anew.
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
    """One number per index [3, m] from 0 on."""
    x, y, z = index
    return (x << 42) | (y << 21) | z


def block_values(blocks: Blocks, terms: SurfaceTerms, quantity: str) -> np.ndarray:
    """R or a term per block, [n] in [0, 1]; NaN where no position sees any of its voxels.

    Raises:
        KeyError: there is no such term.
    """
    of_term = (terms.value, terms.bias, terms.noise, terms.resolution)
    rows: dict[str, Array] = dict(zip(TERMS, of_term, strict=True))
    is_seen = (np.asarray(terms.sightings) > 0.0).astype(np.float64)
    return blocks.mean(np.asarray(rows[quantity]), is_seen)


def block_causes(blocks: Blocks, capacity: int, reason: Reason) -> np.ndarray:
    """The cause that took most of what the voxels of each block lacked for a view, [n] int.

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


def cause_colors(causes: np.ndarray) -> np.ndarray:
    """Color per block, [n, 3] uint8, of what `block_causes` found [n]."""
    return np.stack([np.asarray(UNSEEN, np.uint8), *CAUSE_COLORS[1:]])[causes]


def block_colors(
    blocks: Blocks, map_state: MapState, terms: SurfaceTerms | None, quantity: str
) -> np.ndarray:
    """Color per block, [n, 3] uint8.

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
