"""Extracts the observations of each frame of a capture, on the rows of the map of all frames.

    1. all frames join one map, which gives the surfaces;
    2. each frame joins an empty map with the same rows, which gives its own observations.

Rows are numbered in the order of their keys, so that nothing depends on the order of the frames.

Shape symbols: N rows; n frames; m observations.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from r3jax.captures.capture_maps import blank
from r3jax.captures.neighborhoods import divided, neighborhoods
from r3jax.captures.survey import RANGE
from r3jax.frame import Frame, read_ahead
from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.state import MapState


@dataclass(frozen=True)
class Observed:
    """Observations of all frames, frame by frame."""

    key: np.ndarray
    """Packed voxels of the rows, [2, N] uint32, ascending."""

    voxel_size: float
    """Edge of a voxel."""

    first: np.ndarray
    """Index of the first observation of each frame, then their total number, [n + 1] int64."""

    row: np.ndarray
    """[m] int32, ascending within a frame."""

    resolution: np.ndarray
    """[px/m], [m] float32."""

    color: np.ndarray
    """Mean color of the frame's pixels, [m, 3] float32."""

    is_colored: np.ndarray
    """False if the voxel was seen but no pixel fell into it, [m]."""

    position: np.ndarray
    """Camera center of each frame, [n, 3] float32."""

    sharpness: np.ndarray
    """Sharpness of each frame in (0, 1]: 1 over the width of its blur [px], [n] float32."""

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self.first) - 1

    @property
    def num_rows(self) -> int:
        """Number of rows N."""
        return self.key.shape[1]

    @property
    def center(self) -> np.ndarray:
        """Centers of the voxels, [N, 3] float32."""
        index = jnp.stack(unpack(*jnp.asarray(self.key)))
        return np.ascontiguousarray(np.asarray(voxel_center(index, jnp.float32(self.voxel_size))).T)

    @property
    def frame(self) -> np.ndarray:
        """Frame of each observation, [m] int64."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))


def observe(
    whole: MapState,
    read: Callable[[int], Frame],
    eyes: np.ndarray,
    cameras: Iterable[Camera],
    join: Callable[[MapState, MapState, Frame], MapState],
    on_frame: Callable[[], None] = lambda: None,
    *,
    max_range: float = RANGE,
) -> Observed:
    """Computes the observations of each frame.

    Args:
        whole: the map of all frames.
        read: reads the frame with an index.
        eyes: camera centers, [n, 3].
        cameras: their lenses.
        join: adds a frame to a map that has the rows of the map of all frames.
        on_frame: called after each frame.
        max_range: surfaces farther than this do not count.
    """
    key, occupied = np.asarray(whole.key), ordered_rows(whole)
    row_of = np.full(whole.capacity + 1, -1, np.int32)
    row_of[occupied] = np.arange(len(occupied), dtype=np.int32)
    parts: dict[int, tuple[np.ndarray, ...]] = {}
    position = np.empty((len(eyes), 3), np.float32)
    frames = read_ahead(map(read, np.concatenate(divided(eyes, max_range)).tolist()))
    for near in neighborhoods(whole, eyes, cameras, max_range):
        nothing, own = blank(near.state), row_of[near.row]
        for number, frame in zip(near.numbers.tolist(), frames, strict=False):
            position[number] = frame.position
            parts[number] = _part(join(nothing, near.state, frame), own)
            on_frame()
    columns = tuple(map(list, zip(*(parts.pop(i) for i in range(len(eyes))), strict=True)))
    first = np.cumsum([0, *map(len, columns[0])])
    size, sharp = float(whole.voxel_size), np.ones(len(eyes), np.float32)
    row, resolution, color, is_colored = map(_joined, columns)
    return Observed(
        key[:, occupied], size, first, row, resolution, color, is_colored, position, sharp
    )


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """Concatenates the parts of a column and frees them, as long captures need gigabytes."""
    whole = np.concatenate(parts)
    parts.clear()
    return whole


def ordered_rows(whole: MapState) -> np.ndarray:
    """Finds the rows of a map that hold voxels, in the order of their keys, [N]."""
    occupied = np.flatnonzero(np.asarray(whole.occupied))
    return occupied[np.lexsort(np.asarray(whole.key)[:, occupied])]


def _part(seen: MapState, row_of: np.ndarray) -> tuple[np.ndarray, ...]:
    """Reads the observations of a single frame from its map, in the order of the rows."""
    visited, count = np.asarray(seen.visited), np.asarray(seen.count)
    at = np.flatnonzero(np.bitwise_or.reduce(visited))
    at = at[np.argsort(row_of[at], kind="stable")]
    return (
        row_of[at],
        np.asarray(seen.resolution)[at],
        np.ascontiguousarray(np.asarray(seen.mean)[:, at].T),
        count[at] > 0.0,
    )
