"""How sharp and how bright each frame is beside its neighbors, and which frames repeat each other.

Sharpness: the variance of the Laplacian tells a blurred frame from a sharp one of the same thing,
and a carpet from a wall otherwise. So detail is compared block by block where two frames show the
same surface from about the same distance; the log-ratios of pairs become a level for each frame.

Motion takes detail along one direction and leaves that across it; a lens out of focus takes all of
it. How fast the camera moved follows from the poses of the frames before and after.

Light: a whole image is bright because it shows a window. So colors, too, are compared block by
block where two frames show the same surface, and nothing is clipped; the median leaves out what
shines. Values are taken as they are stored: a splat has to explain these.

Frames repeat each other if they have nearly the same pose and nearly the same pixels.

Shape symbols: n frames; k pairs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from r3jax.captures.faults.blocks import (
    DIRECTIONS,
    FEWEST,
    BlockImage,
    Overlap,
    levels,
    neighbors_of,
)
from r3jax.geometry.cameras import angle_between

_TEXTURED = 4.0
"""Blocks with less detail than this in both frames are plain walls and noise (of 255, squared)."""

_SCALES = 1.4
"""Frames at a larger ratio of distances are not compared: fine detail is lost."""

_NOISE = 0.5
"""Detail below this is negligible (of 255, squared)."""

_PLAIN = 10.0
"""Percentile of the blocks' detail taken as the noise level: some walls are plain everywhere."""

_WITNESSES = 2
"""Minimum number of neighbors: of two frames alone, the odd one cannot be identified."""

_OBLIQUE = 25.0
"""Frames at larger angles to a surface are not compared: oblique views have finer detail [deg]."""

_SHARP = 75.0
"""Percentile of the neighbors' sharpness with which a frame is compared."""


@dataclass(frozen=True)
class Sharpness:
    """Sharpness of every frame, beside that of its neighbors."""

    share: np.ndarray
    """Detail, as a share of that in its sharper neighbors on the same surface, [n]; NaN if nothing
    can be compared."""

    lost_along: np.ndarray
    """Detail kept along the worst direction over that kept along the best one, [n]."""

    direction: np.ndarray
    """Index into `DIRECTIONS` of the worst direction, [n]."""


def sharpness(images: Sequence[BlockImage], pairs: Sequence[Overlap]) -> Sharpness:
    """Compares the detail of all frames."""
    linked, _, level = _leveled(images, pairs, _detail_ratios, 1 + len(DIRECTIONS))
    relative = np.full(level.shape, np.nan)
    for i, near in enumerate(neighbors_of(len(images), linked)):
        if len(near) >= _WITNESSES:
            relative[i] = level[i] - np.percentile(level[near], _SHARP, axis=0)
    along = relative[:, 1:]
    return Sharpness(
        share=np.exp(relative[:, 0]),
        lost_along=np.exp(along.min(axis=1) - along.max(axis=1)),
        direction=np.argmin(np.nan_to_num(along), axis=1),
    )


_Ratios = Callable[[Sequence[BlockImage], Overlap], tuple[np.ndarray, int]]
"""Median log-ratios of a pair of frames, [c], NaN where too few blocks can be compared; and of how
many blocks."""


def _leveled(
    images: Sequence[BlockImage], pairs: Sequence[Overlap], ratios_of: _Ratios, columns: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels all frames by the ratios between pairs.

    Returns the pairs that could be compared [k, 2], the number of their blocks [k], and the levels
    of every frame [n, c].
    """
    found = [(o.first, o.second, *ratios_of(images, o)) for o in pairs]
    found = [row for row in found if np.isfinite(row[2]).all()]
    linked = np.array([row[:2] for row in found], dtype=np.int64).reshape(-1, 2)
    ratios = np.array([row[2] for row in found]).reshape(-1, columns)
    shared = np.array([row[3] for row in found], dtype=np.float64)
    level = [levels(len(images), linked, column, np.sqrt(shared)) for column in ratios.T]
    return linked, shared, np.stack(level, axis=1)


def _detail_ratios(images: Sequence[BlockImage], pair: Overlap) -> tuple[np.ndarray, int]:
    """Computes the median log-ratios of detail, all directions together and each, [5].

    Also returns the number of blocks. The ratios are NaN where too few blocks can be compared.
    """
    first, second = images[pair.first], images[pair.second]
    own, other = pair.own[pair.agrees], pair.other[pair.agrees]
    ratio = first.depth[own] / second.depth[other]
    rays = [_directions(first, own), _directions(second, other)]
    is_alike = np.einsum("ij,ij->i", *rays) > np.cos(np.radians(_OBLIQUE))
    is_alike &= (ratio < _SCALES) & (ratio > 1.0 / _SCALES)
    noise = [_noise(image) for image in (first, second)]
    a = np.maximum(first.detail[own[is_alike]] - noise[0], 0.0)
    b = np.maximum(second.detail[other[is_alike]] - noise[1], 0.0)
    least = max(_TEXTURED * len(DIRECTIONS), float(np.sum(noise, axis=1).max()))
    is_textured = np.maximum(a.sum(axis=1), b.sum(axis=1)) > least
    a, b = a[is_textured], b[is_textured]
    if len(a) < FEWEST:
        return np.full(1 + len(DIRECTIONS), np.nan), 0
    both = [np.concatenate([x.sum(axis=1, keepdims=True), x], axis=1) for x in (a, b)]
    # Added to both: a logarithm of next to nothing would be all noise.
    added = _NOISE + 0.25 * np.mean(noise)
    change = np.median(np.log(both[0] + added) - np.log(both[1] + added), axis=0)
    # A darker image has less contrast and is no less sharp: detail is a square of contrast.
    contrasts = [x.contrast[n[is_alike][is_textured]] for x, n in ((first, own), (second, other))]
    gain = np.median(np.log(contrasts[0] + 1.0) - np.log(contrasts[1] + 1.0))
    return change - 2.0 * gain, len(a)


def _noise(image: BlockImage) -> np.ndarray:
    """Estimates the sensor's noise: the detail of the plainest blocks in each direction, [4]."""
    return np.percentile(image.detail, _PLAIN, axis=0)


def _directions(image: BlockImage, blocks: np.ndarray) -> np.ndarray:
    """Computes the unit directions in which a frame sees some of its blocks, [m, 3]."""
    offset = image.points[blocks] - image.pose[:3, 3]
    return offset / np.linalg.norm(offset, axis=1, keepdims=True)


FAST = 0.25
"""Image motion between two frames that counts as fast, as a share of the width."""

_LARGEST_TURN = np.radians(60.0)
"""Between frames that follow each other [rad]."""


def image_motion(images: Sequence[BlockImage]) -> np.ndarray:
    """Computes the motion of the image between frames, [n] [share of the image's width].

    A turn by an angle moves it by the focal length times as much; a step by that over the depth.
    Each frame has the larger of the motions before and after it; a single frame has 0. A larger
    turn than a video has is no motion: views of one 360 photo, or pictures of another pass. Nor is
    that between single photos, most of which lie farther apart than frames of a fast video: each
    was taken standing still, maybe in another order.
    """
    speed = np.zeros(len(images))
    for i, (a, b) in enumerate(pairwise(images)):
        turn = np.arccos(np.clip(float(a.pose[:3, 2] @ b.pose[:3, 2]), -1.0, 1.0))
        if turn > _LARGEST_TURN:
            continue
        depth = np.nanmin([a.median_depth, b.median_depth, np.inf])
        step = float(np.linalg.norm(a.pose[:3, 3] - b.pose[:3, 3])) / depth
        moved = float(a.camera.fx) * (turn + step) / a.camera.width
        speed[i], speed[i + 1] = max(speed[i], moved), max(speed[i + 1], moved)
    is_video = len(speed) > 0 and np.median(speed) < FAST
    return speed if is_video else np.zeros(len(images))


@dataclass(frozen=True)
class Light:
    """Brightness and tint of every frame; only differences between neighbors mean anything."""

    pairs: np.ndarray
    """Frames that were compared, [k, 2]."""

    shared: np.ndarray
    """Blocks that each pair has in common, [k]."""

    brightness: np.ndarray
    """Logarithm of the brightness that the frame gives a surface, [n]; NaN: not compared."""

    tint: np.ndarray
    """Logarithms of red and of blue over green, [n, 2]; NaN: not compared."""

    def change(self, values: np.ndarray) -> np.ndarray:
        """Compares each value [n] with the median of its neighbors, [n]; NaN if it has none."""
        change = np.full(len(values), np.nan)
        for i, near in enumerate(neighbors_of(len(values), self.pairs)):
            if len(near):
                change[i] = values[i] - np.median(values[near])
        return change


def light(images: Sequence[BlockImage], pairs: Sequence[Overlap]) -> Light:
    """Compares the colors of all frames."""
    linked, shared, level = _leveled(images, pairs, _light_ratios, 3)
    level[~np.isin(np.arange(len(images)), linked)] = np.nan
    return Light(linked, shared, level[:, 0], level[:, 1:])


def _light_ratios(images: Sequence[BlockImage], pair: Overlap) -> tuple[np.ndarray, int]:
    """Computes the median log-ratios of brightness, red over green and blue over green, [3].

    Also returns the number of blocks that they are computed from.
    """
    own, other = pair.own[pair.agrees], pair.other[pair.agrees]
    a, b = images[pair.first].color[own], images[pair.second].color[other]
    known = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    if known.sum() < FEWEST:
        return np.full(3, np.nan), 0
    change = np.log(a[known] / b[known]).astype(np.float64)
    tint = change[:, [0, 2]] - change[:, [1]]
    every = np.concatenate([change.mean(axis=1, keepdims=True), tint], axis=1)
    return np.median(every, axis=0), int(known.sum())


_MOVED = 0.005
"""Views whose images are shifted by less show the same [share of the width]: 3 of 640 pixels."""

_DIFFERS = 4.0
"""Largest mean difference of the blocks' colors of frames that are alike (of 255)."""


def repeats(images: Sequence[BlockImage]) -> list[list[int]]:
    """Groups frames that repeat each other, each group in order, the largest first."""
    place = np.stack([image.pose[:3, 3] for image in images])
    groups: list[list[int]] = []
    grouped = np.zeros(len(images), dtype=bool)
    for i, image in enumerate(images):
        if grouped[i]:
            continue
        depth = image.median_depth
        reach = _MOVED * image.camera.width / float(image.camera.fx)
        apart = np.linalg.norm(place - place[i], axis=1) / (depth if np.isfinite(depth) else 1.0)
        near: list[int] = np.flatnonzero((apart < reach) & ~grouped).tolist()
        alike = [j for j in near if j == i or (j > i and _is_like(image, images[j], reach))]
        if len(alike) > 1:
            grouped[alike] = True
            groups.append(alike)
    return sorted(groups, key=lambda group: (-len(group), group))


def _is_like(a: BlockImage, b: BlockImage, reach: float) -> bool:
    """Returns True if two frames from one place show the same pixels."""
    if a.shape != b.shape:
        return False
    difference = np.abs(a.color - b.color)
    known = np.isfinite(difference)
    if angle_between(a.pose, b.pose) > reach or not known.any():
        return False
    return float(difference[known].mean()) < _DIFFERS
