"""Measures the quality of the pictures, as factors for the formulas.

Blur. The detail of a frame relative to its neighbors (`captures.faults`) is converted to a blur
width. The resolution of the frame's observations is divided by it, and so is the renderability of
views that need not interpolate (`objective`). A blur of b pixels in all directions leaves about
1 / b^2 of the squared second differences. In pictures of two recordings that were blurred on
purpose it left 0.27 and 0.48 (b = 2), 0.10 and 0.21 (3), 0.04 and 0.10 (4). If all frames are
equally blurred, neighbors do not reveal it, but the pictures themselves do: halving the size of an
image with sharp edges multiplies the squared second differences by about two to four, with soft
edges by six to ten (`fineness`, below 0.2 for a blur of 3 px in pictures of eight cameras, and 0.25
and more in the originals).

Exposure. The colors of a frame are divided by a gain for each channel, fitted to the mean colors of
the surfaces. Contradictions that remain lower the consistency.

Shape symbols: n frames; m observations; N rows.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r3jax.apps.select.observations import Observed
from r3jax.captures.faults.appearance import repeats, sharpness
from r3jax.captures.faults.blocks import BlockImage, overlaps
from r3jax.captures.faults.faults import BLURRED

_FEWEST = 40
"""Minimum number of surfaces shared with other frames to fit an exposure."""

_MOST_COMPARED = 10_000_000
"""Maximum number of observations used to fit gains; beyond it surfaces are subsampled."""

_DARK, _BRIGHT = 0.05, 0.95
"""Colors beyond these are clipped or nearly so, and are not used to fit a gain."""

_ROUNDS = 8
"""Iterations that alternate between the means of surfaces and the gains of frames."""

_SOFT = 0.2
"""Fineness below which a picture has no pixel-sized detail."""

_SIDE, _EDGES, _PLAIN = 16, 95.0, 10.0
"""Blocks of pixels, and percentiles of their second differences: edges, and noise."""

_ROUNDING = 0.5
"""Negligible second differences (of 255, squared)."""

_MOST_GAIN = 4.0
"""Maximum plausible gain; larger ones mean that the frame shows something else."""


@dataclass(frozen=True)
class Quality:
    """Quality of the frames' pictures."""

    blur: np.ndarray
    """Width of the blur relative to the neighbors, at least 1, [n] [px]."""

    is_compared: np.ndarray
    """False if no neighbors show the same surface, so that blur is not known, [n]."""

    exposure: np.ndarray
    """Gain of each channel relative to the other frames, [n, 3]."""

    twin_of: np.ndarray
    """Index of the sharper frame that each frame repeats, [n] int64; -1 for none."""

    fineness: np.ndarray
    """Ratio of detail at one pixel to that at two, [n]; see `fineness`."""

    @property
    def is_soft(self) -> bool:
        """True if most pictures have no pixel-sized detail: all are blurred or upscaled."""
        return bool(np.median(self.fineness) < _SOFT)

    @property
    def is_blurred(self) -> np.ndarray:
        """True for frames that are clearly blurred, [n]."""
        return self.blur > 1.0 / np.sqrt(BLURRED)


def fineness(rgb: np.ndarray) -> float:
    """Measures the squared second differences at edges, as a share of those at half the size.

    Args:
        rgb: colors, [H, W, 3] uint8.
    """
    image = rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    height, width = (side - side % 2 for side in image.shape)
    half = image[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    if min(half.shape) < _SIDE:
        return 1.0
    fine, coarse = (_edges(part, side) for part, side in ((image, _SIDE), (half, _SIDE // 2)))
    return float(np.mean((fine + _ROUNDING) / (coarse + _ROUNDING)))


def _edges(image: np.ndarray, side: int) -> np.ndarray:
    """Computes squared second differences across and down at edges, minus those of noise, [2]."""
    middle = 2.0 * image[1:-1, 1:-1]
    across = (image[1:-1, :-2] + image[1:-1, 2:] - middle) ** 2
    down = (image[:-2, 1:-1] + image[2:, 1:-1] - middle) ** 2
    h, w = across.shape[0] // side, across.shape[1] // side
    blocks = [
        found[: h * side, : w * side].reshape(h, side, w, side).mean(axis=(1, 3))
        for found in (across, down)
    ]
    return np.array([np.subtract(*np.percentile(found, [_EDGES, _PLAIN])) for found in blocks])


def quality_of(
    images: Sequence[BlockImage], fineness: Sequence[float], observed: Observed
) -> Quality:
    """Compares the frames of a capture.

    Args:
        images: block images of the frames, [n].
        fineness: fineness of their pictures, [n].
        observed: observations of the frames.
    """
    share = sharpness(images, overlaps(images)).share
    is_compared = np.isfinite(share)
    blur = 1.0 / np.sqrt(np.clip(np.where(is_compared, share, 1.0), 1e-2, 1.0))
    twin_of = np.full(len(images), -1)
    for group in repeats(images):
        best = min(group, key=lambda i: (blur[i], i))
        twin_of[[i for i in group if i != best]] = best
    return Quality(blur, is_compared, exposures(observed), twin_of, np.asarray(fineness))


def unknown_quality(observed: Observed) -> Quality:
    """Returns the quality of frames without pictures."""
    count = len(observed)
    none = np.zeros(count, dtype=bool)
    ones = np.ones(count)
    return Quality(ones, none, np.ones((count, 3)), np.full(count, -1), ones)


def with_quality(observed: Observed, blur: np.ndarray, exposure: np.ndarray) -> Observed:
    """Applies the frames' blur to their observations, and removes their exposure.

    Args:
        observed: observations of the frames.
        blur: width of each frame's blur, [n] [px].
        exposure: gains of each frame, [n, 3].
    """
    resolution, color = observed.resolution.copy(), observed.color.copy()
    for number, part in enumerate(map(slice, observed.first[:-1], observed.first[1:])):
        resolution[part] /= np.float32(blur[number])
        color[part] /= exposure[number].astype(np.float32)
    sharpness = (observed.sharpness / blur).astype(np.float32)
    return dataclasses.replace(observed, resolution=resolution, sharpness=sharpness, color=color)


def exposures(observed: Observed) -> np.ndarray:
    """Fits a gain of each frame and channel to the mean colors of the surfaces, [n, 3].

    The fit alternates between medians over the surfaces and the surfaces' means. The gains of the
    median frame are 1, and so are those of frames that share few surfaces with others.
    """
    stride = max(1, -(-len(observed.row) // _MOST_COMPARED))
    used = observed.is_colored & (observed.row % stride == 0)
    used &= (observed.color > _DARK).all(axis=1)
    used &= (observed.color < _BRIGHT).all(axis=1)
    used &= np.bincount(observed.row[used], minlength=observed.num_rows)[observed.row] > 1
    row, frame = observed.row[used], observed.frame[used]
    log = np.log(np.maximum(observed.color[used], np.float32(1e-6)))
    gain, num = np.zeros((len(observed), 3), np.float32), observed.num_rows
    ends = np.searchsorted(frame, np.arange(len(observed) + 1))
    count = np.maximum(np.bincount(row, minlength=num), 1)
    for _ in range(_ROUNDS):
        own = log - gain[frame]
        mean = np.stack([np.bincount(row, column, num) / count for column in own.T], axis=1)
        apart = log - mean[row]
        for i, (begin, end) in enumerate(itertools.pairwise(ends)):
            if end - begin >= _FEWEST:
                gain[i] = np.median(apart[begin:end], axis=0)
        fitted = np.diff(ends) >= _FEWEST
        if fitted.any():
            gain[fitted] -= np.median(gain[fitted], axis=0)
    return np.exp(np.clip(gain, -np.log(_MOST_GAIN), np.log(_MOST_GAIN)))
