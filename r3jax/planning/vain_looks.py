"""Surfaces that views should have mended and did not: they promise the same for ever.

A voxel may look visible in the map's depth buffer and still get no pixel: it lies a hair behind an
edge, behind a pane of glass, or was a false measurement. Its renderability stays what it was, and
a planner that sums what is lacking is drawn back to it again and again. After a look a voxel that
was observed renders well *from there*; one that does not was looked at in vain.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.mapping.table import hash_key
from r3jax.scoring.backend import rows_in_pixels, terms_of_rows
from r3jax.scoring.config import ScoringConfig
from r3jax.visibility.views import pinhole_view

SLOTS = 1 << 20
"""Counters. Voxels share them by a hash of their keys: rows change whenever the table grows. Of
the few voxels that are looked at in vain hardly two share one."""

LACKING = 0.5
"""A visible voxel with a smaller R from the very pose of a view was not observed by it."""

FINEST = 1e6
"""A resolution that nobody asks for more than [px/m]."""

MOST = np.iinfo(np.uint8).max


def no_looks() -> UInt8[np.ndarray, " S"]:
    """Counters before the first view."""
    return np.zeros(SLOTS, dtype=np.uint8)


@jax.jit
def count_vain_looks(
    counts: UInt8[Array, " S"],
    map_state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> UInt8[Array, " S"]:
    """Counts, for every voxel, the views that should have observed it and did not.

    Args:
        counts: before this view.
        map_state: the map, this view included.
        camera: the camera of the view.
        T_world_camera: where it was taken.
        config: how far, and in which resolution, visibility is worked out.
    """
    rows = rows_in_pixels(map_state, pinhole_view(camera, T_world_camera, config), config)
    nowhere = jnp.zeros(map_state.capacity, dtype=bool)
    # Pixels that show nothing have row -1, which would be the last one.
    is_visible = nowhere.at[jnp.where(rows < 0, map_state.capacity, rows)].set(True, mode="drop")
    terms = terms_of_rows(map_state, T_world_camera[:3, 3], camera.focal, config.forms)
    is_vain = is_visible & (terms.value < LACKING)
    slot = jnp.where(is_vain, _slots(map_state), SLOTS)
    # Each counter once a view, however many voxels share it; full counters stay full.
    hit = jnp.zeros(SLOTS, dtype=jnp.uint8).at[slot].set(jnp.uint8(1), mode="drop")
    return counts + jnp.where(counts < MOST, hit, jnp.uint8(0))


@jax.jit
def without_hopeless(
    map_state: MapState, counts: UInt8[Array, " S"], patience: UInt8[Array, ""]
) -> MapState:
    """Takes voxels that `patience` views looked at in vain for well seen; they still hide others.

    For scores only: nothing may be integrated into what is returned.
    """
    is_hopeless = map_state.present & (counts[_slots(map_state)] >= patience)
    # R = b eps gamma = 1 from everywhere: all directions seen, alike, and from as near as can be.
    return eqx.tree_at(
        lambda m: (m.visited, m.m2, m.resolution),
        map_state,
        (
            jnp.where(is_hopeless, _all_bins(map_state.num_bins)[:, None], map_state.visited),
            jnp.where(is_hopeless, 0.0, map_state.m2),
            jnp.where(is_hopeless, FINEST, map_state.resolution),
        ),
    )


def _slots(map_state: MapState) -> Array:
    return (hash_key(*map_state.key) & jnp.uint32(SLOTS - 1)).astype(jnp.int32)


def _all_bins(num_bins: int) -> np.ndarray:
    """The words of `visited` with the bit of every bin set, and no bit beyond them."""
    bits = np.zeros(-(-num_bins // 32) * 32, dtype=np.uint64)
    bits[:num_bins] = 1
    return (bits.reshape(-1, 32) << np.arange(32, dtype=np.uint64)).sum(axis=1).astype(np.uint32)
