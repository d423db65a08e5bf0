"""Panoramas that are kept, to be scored again after views that are only imagined.

Such views (`scoring.simulated`) change what voxels are worth and which cells are left to explore,
but no surface: what a position sees stays, and finding that is most of what a panorama takes. So
a search over paths finds it once, and again adds up only what has changed.

Shape symbols: n voxels; c cells; p and q their bits, packed in bytes; B bins of the panorama.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.scoring.backend import sums_and_seen
from r3jax.scoring.cells import Cells, unexplored_by_direction
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.deficit import deficit_per_bin
from r3jax.scoring.panorama import Panorama, panorama_of_bins
from r3jax.visibility.selection import Selection, narrow, select
from r3jax.visibility.views import panorama_view


class PanoramaCache(eqx.Module):
    """What is kept of a panorama, or of many: a bit for every voxel and cell at hand."""

    bin_scores: Float[Array, "*positions B"]
    """As in `Panorama`."""

    voxels: UInt8[Array, "*positions p"]
    """Which voxels the position sees."""

    cells: UInt8[Array, "*positions q"]
    """Which unexplored cells it sees."""

    @jax.jit
    def at(self, index: Int[Array, " k"]) -> "PanoramaCache":
        """Those of some of many positions."""
        return PanoramaCache(self.bin_scores[index], self.voxels[index], self.cells[index])

    def replaced(self, index: Int[Array, " k"], others: "PanoramaCache") -> "PanoramaCache":
        """The same of many positions, but for some."""
        return PanoramaCache(
            self.bin_scores.at[index].set(others.bin_scores),
            self.voxels.at[index].set(others.voxels),
            self.cells.at[index].set(others.cells),
        )


class Changes(eqx.Module):
    """What imagined views have changed: `before` them and `after`, the same voxels and cells."""

    before: tuple[MapState, Cells]
    after: tuple[MapState, Cells]

    voxels: Selection
    """Those that the views would show."""

    cells: Selection
    """Those that are no longer unexplored."""


def changes_between(before: tuple[MapState, Cells], after: tuple[MapState, Cells]) -> Changes:
    """What differs; `after` comes of `before` by `simulate_view_near`, any number of times."""
    # The count tells: an imagined view adds to it in just the voxels that it shows.
    shown = after[0].count > before[0].count
    explored = before[1].unexplored & ~after[1].unexplored
    return Changes(before, after, select(shown), select(explored))


def cached_panorama(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> tuple[Panorama, PanoramaCache]:
    """`panorama_of`, and what is needed to score it again."""
    view, num_bins = panorama_view(position, config), config.panorama_bins
    deficits, unexplored, *seen = sums_and_seen(voxels, cells, view, camera.focal, config, num_bins)
    bins = deficits + config.lambda1 * unexplored
    kept = PanoramaCache(bins, *seen)
    return panorama_of_bins(bins, camera, position, config, allowed), kept


def panorama_from_cache(
    kept: PanoramaCache,
    changes: Changes,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> Panorama:
    """`panorama_of` of what is after the changes, from what was kept before them.

    Args:
        kept: of this position, before.
        changes: since.
        camera: whose field of view and focal length count.
        position: camera center [m].
        config: as when it was kept.
        allowed: as in `panorama_of`.
    """
    (voxels, cells), (voxels_after, _) = changes.before, changes.after
    num_bins, focal, forms = config.panorama_bins, camera.focal, config.forms
    shown = narrow(changes.voxels, lambda index: _is_set(kept.voxels, index))
    explored = narrow(changes.cells, lambda index: _is_set(kept.cells, index))
    was = deficit_per_bin(voxels, shown, position, focal, forms, num_bins)
    now = deficit_per_bin(voxels_after, shown, position, focal, forms, num_bins)
    gone = unexplored_by_direction(cells, explored, position, num_bins)
    # A difference of sums may end just below 0 by rounding, which no bin is worth.
    bins = jnp.maximum(kept.bin_scores + (now - was) - config.lambda1 * gone, 0.0)
    return panorama_of_bins(bins, camera, position, config, allowed)


def _is_set(bits: UInt8[Array, " p"], index: Int[Array, " k"]) -> Bool[Array, " k"]:
    shift = (7 - (index & 7)).astype(jnp.uint8)  # packbits puts the first item highest
    return ((bits[index >> 3] >> shift) & 1) == 1
