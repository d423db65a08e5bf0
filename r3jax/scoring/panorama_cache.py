"""Caches panoramas, to update them after imagined views.

Imagined views (`scoring.simulated`) change the R of voxels and the unexplored cells, but no
surface: visibility, the most expensive part of a panorama, stays the same. So a search over paths
determines visibility once and then only updates the sums.

Shape symbols: n voxels; c cells; p and q their bits, packed in bytes; B bins of the panorama.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.geometry.cameras import Camera
from r3jax.kernels.calls import Cells
from r3jax.mapping.state import MapState
from r3jax.scoring.backend import change_of_sums, sums_and_seen
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import Panorama, panorama_of_bins
from r3jax.visibility.views import panorama_view


class PanoramaCache(eqx.Module):
    """The cache of one or many panoramas: a bit for every gathered voxel and cell."""

    bin_scores: Float[Array, "*positions B"]
    """As in `Panorama`."""

    voxels: UInt8[Array, "*positions p"]
    """Which voxels the position sees."""

    cells: UInt8[Array, "*positions q"]
    """Which unexplored cells it sees."""

    @jax.jit
    def at(self, index: Int[Array, " k"]) -> "PanoramaCache":
        """Selects the caches of some positions out of many."""
        return PanoramaCache(self.bin_scores[index], self.voxels[index], self.cells[index])


def cached_panorama(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> tuple[Panorama, PanoramaCache]:
    """Computes `panorama_of`, and caches what is needed to score it again."""
    view, num_bins = panorama_view(position, config), config.panorama_bins
    deficits, unexplored, *seen = sums_and_seen(voxels, cells, view, camera.focal, config, num_bins)
    bins = deficits + config.lambda1 * unexplored
    kept = PanoramaCache(bins, *seen)
    return panorama_of_bins(bins, camera, position, config, allowed), kept


def panorama_from_cache(
    kept: PanoramaCache,
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> Panorama:
    """Updates `panorama_of` after imagined views, from the cache before them.

    Args:
        kept: the cache of this position.
        before: the voxels and cells that it was computed from.
        after: the same after any number of imagined views (`simulate_view_near`).
        camera: whose field of view and focal length count.
        position: camera center [m].
        config: as for the cache.
        allowed: as in `panorama_of`.
    """
    seen = (kept.voxels, kept.cells)
    change, gone = change_of_sums(
        before, after, seen, position, camera.focal, config, config.panorama_bins
    )
    # Rounding may leave a difference of sums just below 0.
    bins = jnp.maximum(kept.bin_scores + change - config.lambda1 * gone, 0.0)
    return panorama_of_bins(bins, camera, position, config, allowed)
