"""R and its terms for every voxel of a map, as cameras in free space see it.

R belongs to a voxel and a camera together. To color a map, it is averaged over positions that see
the voxel: some that are spread over known free space, or the one where a camera is held.

Shape symbols: N rows of the map; P positions.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.exploration.coverage import probe_poses
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import score_voxels
from r3jax.visibility.depth_buffer import seen_in
from r3jax.visibility.selection import for_selected
from r3jax.visibility.views import panorama_view

NUM_PROBES = 24
"""Positions that a map's colors are averaged over: a large house has every room in view."""


class SurfaceTerms(eqx.Module):
    """The terms of every row of a map, each a mean over the positions that see it."""

    value: Float[Array, " N"]
    """R; 0 where no position sees the voxel."""

    bias: Float[Array, " N"]
    """b, the term of the angle; 0 where no position sees the voxel."""

    noise: Float[Array, " N"]
    """eps, the term of the color's consistency; 0 where no position sees the voxel."""

    resolution: Float[Array, " N"]
    """gamma, the term of the sharpness; 0 where no position sees the voxel."""

    sightings: Float[Array, " N"]
    """How many positions see the voxel."""


def probe_positions(grid: OccupancyGrid, num: int = NUM_PROBES) -> np.ndarray:
    """Positions in known free space [m], evenly spread, [P, 3] float32, P <= num.

    They are those of the probe views that a run's mean renderability is measured with.
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
    """The terms of every voxel, averaged over the positions that see it.

    Args:
        state: the map.
        camera: its focal length sets the resolution that is asked for.
        positions: camera centers [P, 3] [m]; every direction round them counts.
        config: range and settings of the closed forms.
        pad_to: at least so many positions are computed, so that a growing set compiles once.
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
    _, visible = seen_in(voxels, panorama_view(position, config), config)
    num = totals.shape[1]

    def add(
        index: Int[Array, " K"], valid: Bool[Array, " K"], totals: Float[Array, "5 N"]
    ) -> Float[Array, "5 N"]:
        part = score_voxels(voxels.take(index, valid), position, camera.focal, config.forms)
        rows = [part.value, part.bias, part.noise, part.resolution, jnp.ones_like(part.value)]
        target = jnp.where(valid, index, num)  # out of range on purpose: dropped
        return totals.at[:, target].add(jnp.stack(rows), mode="drop")

    return for_selected(visible, add, totals)
