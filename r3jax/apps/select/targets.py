"""Computes which voxels the target views show, and in which share of their pixels.

Shape symbols: T targets; P pairs of a row and a target that shows it; N rows; h w buffer size.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.apps.select.observations import Observed, ordered_rows
from r3jax.captures.neighborhoods import neighborhoods
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.config import ScoringConfig
from r3jax.visibility.views import pinhole_view

BUFFER = 96
"""Longer side of the images of the targets [px]; weights need not be more precise."""

_AT_ONCE = 32
"""Number of targets drawn at once."""


@dataclass(frozen=True)
class Targets:
    """Views, and the pairs of a row and a view that shows it, sorted by row and then by view."""

    position: np.ndarray
    """Camera centers, [T, 3] float32."""

    focal: np.ndarray
    """Focal lengths of R, [T] float32 [px]."""

    first: np.ndarray
    """Index of the first pair of each row, then the number of pairs, [N + 1] int64."""

    target: np.ndarray
    """Index of the target of each pair, [P] int32."""

    weight: np.ndarray
    """Share of the target's pixels that show the row, [P] float32; other pixels are not known."""

    def __len__(self) -> int:
        """Returns the number of targets."""
        return len(self.focal)

    @property
    def coverage(self) -> np.ndarray:
        """Share of the pixels that show any voxel, [T]."""
        return np.bincount(self.target, self.weight, len(self))


def see_targets(
    whole: MapState,
    observed: Observed,
    cameras: Sequence[Camera],
    poses: np.ndarray,
    max_range: float,
) -> Targets:
    """Draws every target once.

    Args:
        whole: the map of all frames.
        observed: observations of the frames; they number the rows in another order.
        cameras: cameras of the targets, [T].
        poses: `T_world_camera`, [T, 4, 4].
        max_range: surfaces farther than this are not visible.
    """
    config = ScoringConfig(max_range=max_range, zbuffer_size=BUFFER)
    row_of = np.full(whole.capacity + 1, -1, np.int64)
    row_of[ordered_rows(whole)] = np.arange(observed.num_rows)
    pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    T = jnp.asarray(poses, dtype=jnp.float32)
    for near in neighborhoods(whole, poses[:, :3, 3], cameras, max_range, for_lookups=False):
        own = row_of[near.row]
        for some in _batches(cameras, near.numbers):
            padded = np.resize(some, _AT_ONCE)
            images = np.asarray(_draw(near.state, cameras[some[0]], T[padded], config))
            for number, image in zip(some, images, strict=False):
                shown, pixels = np.unique(image[image < near.state.capacity], return_counts=True)
                share = (pixels / image.size).astype(np.float32)
                pairs.append((own[shown], np.full(len(shown), number, np.int32), share))
    row, target, weight = (np.concatenate(column) for column in zip(*pairs, strict=True))
    order = np.lexsort((target, row))
    first = np.searchsorted(row[order], np.arange(observed.num_rows + 1))
    return Targets(
        position=np.ascontiguousarray(poses[:, :3, 3], dtype=np.float32),
        focal=np.array([float(camera.focal) for camera in cameras], np.float32),
        first=first.astype(np.int64),
        target=target[order],
        weight=weight[order],
    )


def _batches(cameras: Sequence[Camera], numbers: np.ndarray) -> Iterator[list[int]]:
    """Yields the numbers of a few views of the same lens at a time: one program draws them."""
    for _, group in groupby(numbers.tolist(), key=lambda number: _as_key(cameras[number])):
        some = list(group)
        yield from (some[i : i + _AT_ONCE] for i in range(0, len(some), _AT_ONCE))


def _as_key(camera: Camera) -> tuple[int | float, ...]:
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    return (camera.width, camera.height, *map(float, lens))


@jax.jit
def _draw(
    whole: MapState, camera: Camera, poses: Float[Array, "T 4 4"], config: ScoringConfig
) -> Int[Array, "T h w"]:
    def draw(pose: Float[Array, "4 4"]) -> Int[Array, "h w"]:
        return rows_in_pixels(whole, pinhole_view(camera, pose, config), config)

    return jax.vmap(draw)(poses)
