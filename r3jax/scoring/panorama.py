"""The panorama of a position: the utility of all directions at once, and the best one.

Imagined views (`scoring.simulated`) change the R of voxels and the unexplored cells, but no
surface: visibility, the most expensive part of a panorama, stays the same. So a search over paths
determines visibility once (`PanoramaCache`) and then only updates the sums.

Shape symbols: n voxels; c cells; p and q their bits, packed in bytes; B bins of the panorama.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.geometry.arguments import a_camera, a_point, checked
from r3jax.geometry.cameras import Camera, nan_unless_valid, pose_along
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid, a_grid, cells_of
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.backend import change_of_sums, sums_and_seen, sums_in_view
from r3jax.scoring.config import ScoringConfig, scoring_settings
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


class Panorama(eqx.Module):
    """Scores of all directions from one position."""

    bin_scores: Float[Array, " B"]
    """Per bin: lambda1 times its visible unexplored cells, plus the sum of (1 - R) over its visible
    voxels."""

    direction_scores: Float[Array, " B"]
    """Per camera axis q_k: the sum of the bins inside the camera's field of view."""

    best_direction: Float[Array, " 3"]
    """The allowed axis with the largest score; unit length."""

    best_score: Float[Array, ""]
    """Its score: lambda1 U_G + U_R of that view, to the resolution of the bins."""

    T_world_camera: Float[Array, "4 4"]
    """The roll-free pose at the position that looks along the best direction."""


@checked(state=a_map, grid=a_grid, camera=a_camera, position=a_point, config=scoring_settings)
@jax.jit
def panorama(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig | None = None,
) -> Panorama:
    """Scores every direction from one position with one depth buffer (arXiv 2601.07484).

    Args:
        state: the map.
        grid: the coarse grid.
        camera: whose field of view and focal length count.
        position: camera center [m]. `jax.vmap` over many, or use
            `scoring.batch.score_positions`.
        config: settings.
    """
    config = ScoringConfig() if config is None else config
    scores = panorama_of(state, cells_of(grid), camera, position, config)
    factor = nan_unless_valid(camera, scores.T_world_camera, state.voxel_size, grid.cell_size)
    return jax.tree.map(lambda part: factor * part, scores)


def panorama_of(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> Panorama:
    """Computes `panorama` from gathered voxels and cells.

    Args:
        voxels: of the map.
        cells: of the grid.
        camera: whose field of view and focal length count.
        position: camera center [m].
        config: settings.
        allowed: axes q_k that the best direction is taken from, at least one; None: all.
    """
    view, num_bins = panorama_view(position, config), config.panorama_bins
    deficits, unexplored = sums_in_view(
        voxels, cells, view, position, camera.focal, config, num_bins
    )
    bins = deficits + config.lambda1 * unexplored
    return panorama_of_bins(bins, camera, position, config, allowed)


def panorama_of_bins(
    bins: Float[Array, " B"],
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> Panorama:
    """Builds the panorama whose bins have these scores."""
    num_bins = config.panorama_bins
    directions = bins_in_view(camera, num_bins) @ bins
    # Ties go to the first, so that the choice is repeatable.
    best = jnp.argmax(directions if allowed is None else jnp.where(allowed, directions, -jnp.inf))
    axis = jnp.asarray(fibonacci_lattice(num_bins), dtype=jnp.float32)[best]
    return Panorama(bins, directions, axis, directions[best], pose_along(position, axis))


def bins_in_view(camera: Camera, num_bins: int) -> Float[Array, "B B"]:
    """Computes N(k): 1 for the bins j in the roll-free, rectangular field of view along q_k."""
    lattice = jnp.asarray(fibonacci_lattice(num_bins), dtype=jnp.float32)
    R = jax.vmap(lambda q: pose_along(jnp.zeros(3, dtype=jnp.float32), q)[:3, :3])(lattice)
    x, y, z = jnp.einsum("kij,bi->jkb", R, lattice)
    is_ahead = z > 1e-6
    z_safe = jnp.where(is_ahead, z, 1.0)
    column = camera.fx * x / z_safe + camera.cx
    row = camera.fy * y / z_safe + camera.cy
    is_in = (column >= 0.0) & (column < camera.width) & (row >= 0.0) & (row < camera.height)
    return (is_ahead & is_in).astype(jnp.float32)


def cached_panorama(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    allowed: Bool[Array, " B"] | None = None,
) -> tuple[Panorama, PanoramaCache]:
    """Computes `panorama_of`, and caches the data for scoring it again."""
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
