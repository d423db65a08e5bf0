"""Summarizes images per block of pixels, and matches blocks that show the same surface.

Frames are compared where they show the same surface, at one working resolution: images of at most
640 pixels, in blocks, 80 of them along the longer side. A block stores its mean color, its depth,
and its fine detail in four directions. That is 150 kB per frame, independent of the camera's
resolution.

A frame is compared with a few neighbors only, however long the capture is: those before and after
it, and those whose cameras were nearest and had the same orientation. A point of one frame is
projected into the other; if the depth there agrees, both show it.

Shape symbols: n frames; H, W image size; h, w blocks of an image; b blocks in a row; m matches.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from r3jax.captures.source import projected
from r3jax.geometry.cameras import Camera

_ACROSS = 80
"""Blocks along the longer side of an image."""

_LEAST_SIDE = 4
"""Smaller blocks hold no detail [px]."""

_FLAT = 0.1
"""Depths of a block that differ by more of their mean belong to several surfaces."""

_DARK, _BRIGHT = 12.0, 243.0
"""Blocks with values beyond these are clipped, or nearly: their brightness says little."""

DIRECTIONS = ("across", "down the diagonal", "down", "up the diagonal")
"""Directions in which detail is measured."""


@dataclass(frozen=True)
class BlockImage:
    """An image in blocks."""

    color: np.ndarray
    """Mean color, [b, 3] float32, 0 to 255; NaN where a pixel is clipped, or nearly."""

    detail: np.ndarray
    """Mean squared second difference of brightness in each of `DIRECTIONS`, [b, 4] float32."""

    contrast: np.ndarray
    """Standard deviation of brightness over the block and those round it, which hardly any blur
    changes, [b] float32."""

    depth: np.ndarray
    """Mean z-depth of the one surface that it shows, [b] float32 [capture units]; NaN: none."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64 [capture units]."""

    camera: Camera
    """Pinhole whose pixels are the blocks."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.camera.height, self.camera.width

    @property
    def median_depth(self) -> float:
        """Median depth [capture units]; NaN if there is none."""
        known = self.depth[np.isfinite(self.depth)]
        return float(np.median(known)) if len(known) else float("nan")

    @property
    def points(self) -> np.ndarray:
        """What the middle of each block shows, [b, 3] float64 in the world; NaN without depth."""
        height, width = self.shape
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x = (column.ravel() - float(self.camera.cx)) / float(self.camera.fx)
        y = (row.ravel() - float(self.camera.cy)) / float(self.camera.fy)
        local = self.depth.astype(np.float64)[:, None] * np.stack([x, y, np.ones_like(x)], 1)
        return local @ self.pose[:3, :3].T + self.pose[:3, 3]


def block_image(rgb: np.ndarray, depth: np.ndarray, camera: Camera, pose: np.ndarray) -> BlockImage:
    """Cuts an image into blocks.

    Args:
        rgb: colors, [H, W, 3] uint8.
        depth: z-depth, [H, W] [capture units]; 0 no measurement, inf nothing within range.
        camera: its pinhole.
        pose: `T_world_camera`, [4, 4].
    """
    side = min(max(_LEAST_SIDE, round(max(depth.shape) / _ACROSS)), *depth.shape)
    blocks = Camera(
        depth.shape[1] // side,
        depth.shape[0] // side,
        *(float(value) / side for value in (camera.fx, camera.fy, camera.cx, camera.cy)),
    )
    pixels = _cut(rgb.astype(np.float32), side)
    is_clipped = (pixels.min(axis=(1, 2)) < _DARK) | (pixels.max(axis=(1, 2)) > _BRIGHT)
    color = np.where(is_clipped[:, None], np.float32(np.nan), pixels.mean(axis=1))
    brightness = rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    detail = _cut(_second_differences(brightness), side).mean(axis=1)
    return BlockImage(
        color=color,
        detail=detail,
        contrast=_contrast(_cut(brightness[..., None], side)[..., 0].mean(axis=1), blocks),
        depth=_one_depth(_cut(depth[..., None], side)),
        pose=pose,
        camera=blocks,
    )


def _cut(image: np.ndarray, side: int) -> np.ndarray:
    """Cuts an image [H, W, c] into the pixels of its blocks, [b, side * side, c]."""
    h, w = image.shape[0] // side, image.shape[1] // side
    parts = image[: h * side, : w * side].reshape(h, side, w, side, -1)
    return parts.swapaxes(1, 2).reshape(h * w, side * side, -1)


def _second_differences(image: np.ndarray) -> np.ndarray:
    """Computes squared second differences in `DIRECTIONS`, [H, W] to [H, W, 4]; 0 at the rim."""
    found = np.zeros((*image.shape, len(DIRECTIONS)), np.float32)
    middle = 2.0 * image[1:-1, 1:-1]
    found[1:-1, 1:-1, 0] = (image[1:-1, :-2] + image[1:-1, 2:] - middle) ** 2
    # Diagonal neighbors are farther by the root of two: the second difference is twice as large.
    found[1:-1, 1:-1, 1] = (0.5 * (image[:-2, :-2] + image[2:, 2:] - middle)) ** 2
    found[1:-1, 1:-1, 2] = (image[:-2, 1:-1] + image[2:, 1:-1] - middle) ** 2
    found[1:-1, 1:-1, 3] = (0.5 * (image[2:, :-2] + image[:-2, 2:] - middle)) ** 2
    return found


def _contrast(mean: np.ndarray, blocks: Camera) -> np.ndarray:
    """Computes the standard deviation of the blocks' brightness [b] over 3x3 blocks, [b]."""
    padded = np.pad(mean.reshape(blocks.height, blocks.width), 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return windows.std(axis=(2, 3)).ravel().astype(np.float32)


def _one_depth(depth: np.ndarray) -> np.ndarray:
    """Computes the mean depth of blocks [b, p, 1] that show one surface, [b], else NaN."""
    known = (depth[..., 0] > 0.0) & np.isfinite(depth[..., 0])
    values = np.where(known, depth[..., 0], 0.0)
    count = known.sum(axis=1)
    mean = values.sum(axis=1) / np.maximum(count, 1)
    low = np.where(known, values, np.inf).min(axis=1)
    is_one = (count > 0) & (values.max(axis=1) - low < _FLAT * mean)
    return np.where(is_one, mean, np.nan).astype(np.float32)


_IN_ORDER = (1, 2)
"""Neighbors in the order of the capture."""

_NEAR_BY = 6
"""Further neighbors, by their poses."""

_TURNED = 60.0
"""Maximum angle between neighbors: beyond it cameras have little in common [deg]."""

_AGREES = 0.05
"""Surfaces closer than this are one, as a share of their distance."""

FEWEST = 40
"""Minimum number of common blocks of a pair of frames."""


_REWEIGHTED = 8
"""Iterations of the reweighting of pairs."""

_SMALLEST_ERROR = 1e-3
"""Differences are bounded below by this: absolute values have no second derivative at 0."""


@dataclass(frozen=True)
class Overlap:
    """Blocks of one frame that another frame shows."""

    first: int
    """Number of the frame whose blocks are looked up."""

    second: int
    """Number of the frame in which they are."""

    own: np.ndarray
    """Blocks of the first that lie within the second, where both have depth, [m]."""

    other: np.ndarray
    """The blocks of the second where they lie, [m]."""

    ratio: np.ndarray
    """Depth of the first's surface over that of the second's, seen by the second, [m]."""

    @property
    def agrees(self) -> np.ndarray:
        """True where both show one surface, [m]."""
        return np.abs(self.ratio - 1.0) < _AGREES


def neighbor_pairs(images: Sequence[BlockImage]) -> np.ndarray:
    """Finds pairs of frames (first < second) that may show the same surface, [k, 2]."""
    count = len(images)
    place = np.stack([image.pose[:3, 3] for image in images])
    axis = np.stack([image.pose[:3, 2] for image in images])
    depths = np.array([image.median_depth for image in images])
    typical = float(np.nanmedian(depths)) if np.isfinite(depths).any() else 1.0
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        angle = np.arccos(np.clip(axis @ axis[i], -1.0, 1.0))
        gap = np.linalg.norm(place - place[i], axis=1) / typical + angle
        gap[angle > np.radians(_TURNED)] = np.inf
        gap[i] = np.inf
        near = np.argsort(gap, kind="stable")[:_NEAR_BY]
        found = [*near[np.isfinite(gap[near])].tolist(), *(i + k for k in _IN_ORDER)]
        pairs |= {(min(i, j), max(i, j)) for j in found if j < count}
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def overlap(
    images: Sequence[BlockImage], first: int, second: int, points: np.ndarray | None = None
) -> Overlap:
    """Projects the blocks of one frame into another one.

    Args:
        images: the frames.
        first: the one frame.
        second: the other one.
        points: `points` of the first, if they are known.
    """
    seen = images[second]
    found = projected(seen.camera, seen.pose, images[first].points if points is None else points)
    own = np.flatnonzero(found.is_in)
    row, column = (side[own].astype(np.int64) for side in (found.row, found.column))
    other = row * seen.camera.width + column
    ratio = found.z[own] / seen.depth[other]
    known = np.isfinite(ratio)
    # As short as they can be: of 5,000 frames there are a hundred million matches.
    own, other = (x[known].astype(np.int32) for x in (own, other))
    return Overlap(first, second, own, other, ratio[known].astype(np.float32))


def overlaps(images: Sequence[BlockImage]) -> list[Overlap]:
    """Lists the pairs of neighbors with enough in common to be compared, each in one order."""
    found: list[Overlap] = []
    points, of = np.zeros((0, 3)), -1
    for first, second in neighbor_pairs(images).tolist():
        if first != of:  # pairs are sorted: the points of one frame are needed at a time
            points, of = images[first].points, first
        pair = overlap(images, first, second, points)
        if len(pair.own) >= FEWEST:
            found.append(pair)
    return found


def levels(count: int, pairs: np.ndarray, difference: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Solves for one number per frame from differences between pairs, by robust least squares.

    Minimizes the sum of w |x_first - x_second - d| (reweighted least squares). Only differences
    between frames that are linked mean anything.

    Args:
        count: frames, n.
        pairs: first and second of each pair, [k, 2].
        difference: of the first from the second, [k].
        weight: [k].

    Returns:
        [n]; a frame without pairs has 0.
    """
    x, every, (i, j) = np.zeros(count), np.arange(count), pairs.T
    for _ in range(_REWEIGHTED):
        error = np.abs(x[i] - x[j] - difference)
        w = weight / np.maximum(error, _SMALLEST_ERROR)
        # Next to nothing on the diagonal: frames without a link stay at 0.
        least = 1e-6 * max(float(w.max(initial=0.0)), 1.0)
        value = np.concatenate([w, w, -w, -w, np.full(count, least)])
        row, column = np.r_[i, j, i, j, every], np.r_[i, j, j, i, every]
        laplacian = sparse.coo_matrix((value, (row, column)), (count, count)).tocsc()
        change = np.bincount(np.r_[i, j], np.r_[w * difference, -w * difference], count)
        x = np.asarray(spsolve(laplacian, change))
    return x


def neighbors_of(count: int, pairs: np.ndarray) -> list[np.ndarray]:
    """Lists the frames that each frame was compared with, n arrays."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return [both[both[:, 0] == i, 1] for i in range(count)]
