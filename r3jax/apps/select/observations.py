"""Extracts the observations of each frame of a capture, on the rows of the map of all frames.

    1. all frames join one map, which gives the surfaces;
    2. each frame joins an empty map with the same rows, which gives its own observations.

Rows are numbered in the order of their keys, so that nothing depends on the order of the frames.

Shape symbols: N rows; n frames; m observations; W words of bins.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.captures.capture_maps import blank, grown
from r3jax.captures.survey import RANGE
from r3jax.frame import Frame
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.join import combine_moments
from r3jax.mapping.state import MapState, empty_map

_CAPACITY = 1 << 15


@dataclass(frozen=True)
class Observed:
    """Observations of all frames, frame by frame."""

    key: np.ndarray
    """Packed voxels of the rows, [2, N] uint32, ascending."""

    voxel_size: float
    """Edge of a voxel."""

    num_bins: int
    """Direction bins of a voxel."""

    first: np.ndarray
    """Index of the first observation of each frame, then their total number, [n + 1] int64."""

    row: np.ndarray
    """[m] int32, ascending within a frame."""

    direction: np.ndarray
    """Direction bin towards the camera, [m] uint8."""

    resolution: np.ndarray
    """[px/m], [m] float32."""

    color: np.ndarray
    """Mean color of the frame's pixels, [m, 3] float32."""

    is_colored: np.ndarray
    """False if the voxel was seen but no pixel fell into it, [m]."""

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

    def map_of(self, frames: Sequence[int]) -> MapState:
        """Merges the maps of some frames, on all rows."""
        num, words = self.num_rows, -(-self.num_bins // 32)
        moments = (jnp.zeros(num), jnp.zeros((3, num)), jnp.zeros(num))
        visited, best = np.zeros((words, num), np.uint32), np.zeros(num, np.float32)
        for frame in frames:
            part = slice(int(self.first[frame]), int(self.first[frame + 1]))
            row = self.row[part]
            count, color = np.zeros(num, np.float32), np.zeros((3, num), np.float32)
            count[row], color[:, row] = self.is_colored[part], self.color[part].T
            own = (jnp.asarray(count), jnp.asarray(color), jnp.zeros(num))
            moments = _combined(moments, own)
            word, bit = np.divmod(self.direction[part], 32)
            visited[word, row] |= np.uint32(1) << bit.astype(np.uint32)
            best[row] = np.maximum(best[row], self.resolution[part])
        count, mean, m2 = moments
        return MapState(
            key=jnp.asarray(self.key),
            visited=jnp.asarray(visited),
            count=count,
            mean=mean,
            m2=m2,
            resolution=jnp.asarray(best),
            voxel_size=jnp.float32(self.voxel_size),
            dropped=jnp.int32(0),
            num_bins=self.num_bins,
        )


_combined = jax.jit(combine_moments)


def map_frames(
    frames: Iterable[Frame], voxel_size: float, *, max_range: float = RANGE, drop_edges: bool = True
) -> MapState:
    """Builds the map of all surfaces.

    Args:
        frames: the frames, one by one.
        voxel_size: edge of a voxel.
        max_range: surfaces farther than this do not count.
        drop_edges: False to include pixels on depth edges.

    Raises:
        ValueError: there are more voxels than with any reasonable voxel size.
    """
    whole = empty_map(_CAPACITY, voxel_size)
    for frame in frames:
        whole = grown(whole, frame, drop_edges, max_range)
    return whole


def observe(
    whole: MapState,
    read: Callable[[int], Frame],
    count: int,
    join: Callable[[MapState, MapState, Frame], MapState],
    on_frame: Callable[[], None] = lambda: None,
) -> Observed:
    """Computes the observations of each frame.

    Args:
        whole: the map of all frames.
        read: reads the frame with an index.
        count: number of frames, n.
        join: adds a frame to a map that has the rows of the map of all frames.
        on_frame: called after each frame.
    """
    key, occupied = np.asarray(whole.key), ordered_rows(whole)
    row_of = np.full(whole.capacity, -1, np.int32)
    row_of[occupied] = np.arange(len(occupied), dtype=np.int32)
    nothing = blank(whole)
    parts: tuple[list[np.ndarray], ...] = tuple([] for _ in range(5))
    for number in range(count):
        for column, own in zip(
            parts, _part(join(nothing, whole, read(number)), row_of), strict=True
        ):
            column.append(own)
        on_frame()
    first = np.cumsum([0, *map(len, parts[0])])
    row, direction, resolution, color, is_colored = map(_joined, parts)
    size = float(whole.voxel_size)
    sharp = np.ones(count, np.float32)
    return Observed(
        key[:, occupied], size, whole.num_bins, first, row, direction, resolution, color,
        is_colored, sharp,
    )  # fmt: skip


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
    at = np.flatnonzero(visited.any(axis=0))
    at = at[np.argsort(row_of[at], kind="stable")]
    words = visited[:, at]
    word = np.argmax(words != 0, axis=0)
    bit = np.log2(words[word, np.arange(len(at))].astype(np.float64))  # one bin, hence one bit
    return (
        row_of[at],
        (32 * word + bit).astype(np.uint8),
        np.asarray(seen.resolution)[at],
        np.ascontiguousarray(np.asarray(seen.mean)[:, at].T),
        count[at] > 0.0,
    )
