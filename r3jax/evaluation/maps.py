"""Renderability of test views on a map of the training views."""

from collections.abc import Iterable

import numpy as np

from r3jax.frame import Frame
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.scoring.renderability import renderability, renderability_image


def map_of(
    frames: Iterable[Frame],
    *,
    voxel_size: float = 0.05,
    max_range: float = 5.0,
    num_bins: int = 64,
    drop_edges: bool = True,
) -> MapState:
    """Builds the map of these frames and no others; it grows as needed.

    A run's own map contains the held-out views, too, and would overestimate a model trained without
    them.

    Args:
        frames: those that the model was trained on.
        voxel_size: edge of a voxel [m].
        max_range: depth beyond it is ignored [m].
        num_bins: direction bins per voxel.
        drop_edges: False lets pixels on depth edges in.
    """
    state = empty_map(voxel_size=voxel_size, num_bins=num_bins)
    for frame in frames:
        state = integrate_growing(state, frame, max_range, drop_edges=drop_edges)
    return state


def expected_renderability(state: MapState, frames: Iterable[Frame]) -> list[float]:
    """Computes R of each frame's view, in [0, 1].

    The frames must be as recorded, not made smaller: a voxel's resolution is compared with the
    one at which it was mapped.
    """
    return [float(renderability(state, f.camera, f.T_world_camera)) for f in frames]


def expected_image(state: MapState, frame: Frame) -> np.ndarray:
    """Computes R of the surface at each pixel of a frame's view, [h, w] in [0, 1]."""
    return np.asarray(renderability_image(state, frame.camera, frame.T_world_camera))
