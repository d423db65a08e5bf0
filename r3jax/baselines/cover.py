"""COVER: views of known surfaces from new directions.

    utility = 1000 U_G / cells of the grid  +  1 - mean over the covered pixels of c
    c       = max over the directions q_k from which the voxel was seen of (1 + <q_k, r>) / 2

with r the direction from the pixel's voxel to the camera (NBV-Gym, CVPR 2026, which takes the view
of the lowest mean). Ours are 64 direction bins a voxel instead of 128 a primitive, and visibility
is the map's on both sides. The published rule has no unknown space; so that it can explore, U_G
is added, weighted as in Active-GS. Every table must mention this.

Shape symbols: C candidates; h w pixels; N rows of the map; W words of bins.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from r3jax.baselines.pixels import PixelView, score_by_pixels
from r3jax.planning.candidates import Candidates
from r3jax.planning.decide import GreedyPolicy, Scored
from r3jax.planning.policy import Situation
from r3jax.scoring.terms import nearest_seen

UNSEEN_WEIGHT = 1000.0
"""Utility of a view that shows every cell of the grid, all unexplored (Active-GS)."""


class SeenBins(eqx.Module):
    """The directions from which voxels were seen, for the rows of a map or the pixels of a view."""

    visited: UInt32[Array, "W ..."]
    """Bit `k % 32` of word `k // 32` is set for each visited bin k."""

    num_bins: int = eqx.field(static=True)
    """Direction bins B."""


def coverage_of_pixels(
    seen: SeenBins, offset: Float[Array, "3 h w"], hit: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Computes the mean of c over the covered pixels, in [0, 1]; 1 if no pixel is covered.

    A view that shows nothing of the map has no direction that could be new: it must not win over
    views that have, so it counts as covered, and only its unexplored cells speak for it.

    Args:
        seen: the bins of each pixel's voxel.
        offset: from the voxel to the camera [m].
        hit: 1 for covered pixels, else 0.
    """
    length = jnp.sqrt(jnp.sum(offset * offset, axis=0))
    direction = offset / jnp.maximum(length, 1e-6)[None]
    nearest = nearest_seen(seen.visited, direction, seen.num_bins)
    total, num = jnp.sum(hit * 0.5 * (1.0 + nearest)), jnp.sum(hit)
    # Clipped: rounding may carry the mean past 1, and the novelty below 0.
    return jnp.where(num > 0.0, jnp.clip(total / jnp.maximum(num, 1.0), 0.0, 1.0), 1.0)


def _novelty_and_cells(view: PixelView) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Computes 1 - mean c, and counts the visible unexplored cells."""
    hit = view.hit.astype(jnp.float32)
    return 1.0 - coverage_of_pixels(view.rows, view.offset, hit), view.cells


@dataclass(frozen=True)
class Cover(GreedyPolicy):
    """Views of known surfaces from new directions (mean over pixels), plus unexplored cells."""

    name = "cover"
    source = "COVER of NBV-Gym, CVPR 2026, plus unexplored cells"

    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Scores each view by new directions (`rendering`) and unexplored cells (`exploration`)."""
        del key
        state = situation.map_state
        seen = SeenBins(state.visited, state.num_bins)
        rendering, cells = score_by_pixels(
            situation, _novelty_and_cells, candidates, self.config.scoring, seen
        )
        exploration = UNSEEN_WEIGHT * cells / situation.grid.log_odds.size
        return candidates, {
            "exploration": exploration,
            "rendering": rendering,
            "utility": exploration + rendering,
        }
