"""Extracts sharp frames from a video at intervals of equal image motion, without known geometry.

Image motion between frames is measured by phase correlation (Kuglin and Hines 1975) of small gray
images. The video is cut into segments of equal motion, so that a camera at rest yields one frame
and a fast turn many. The sharpest frame of each segment is kept, by the variance of the Laplacian,
as frames within a segment show nearly the same.

Shape symbols: n frames; k chosen; h w of the small images.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from r3jax.errors import InputError
from r3jax.files import make_folder, write_atomic
from r3jax.formats.video import Video
from r3jax.plots.pictures import png

_ACROSS = 160
"""Width of the images used to measure motion [px]."""

_STILL = 0.002
"""Motion below this share of the width is ignored: noise, and the tremor of a hand at rest."""

_PEAK = 8.0
"""Minimum height of the correlation peak in standard deviations; noise reaches five."""

_LOST = 0.35
"""Motion assigned to two frames without common content, as at a cut."""


@dataclass(frozen=True)
class VideoFrames:
    """Frames of a video."""

    chosen: np.ndarray
    """Indices of the frames, [k], ascending."""

    motion: np.ndarray
    """Image motion since the previous frame, [n] [share of the width]."""

    sharpness: np.ndarray
    """Variance of the Laplacian, [n]."""


def small_gray(rgb: np.ndarray) -> np.ndarray:
    """Returns a gray image [h, w] float32 of an image [H, W, 3], averaged over blocks of pixels."""
    side = max(1, rgb.shape[1] // _ACROSS)
    h, w = rgb.shape[0] // side, rgb.shape[1] // side
    gray = rgb[: h * side, : w * side].mean(axis=2, dtype=np.float32)
    return gray.reshape(h, side, w, side).mean(axis=(1, 3))


def shift_between(first: np.ndarray, second: np.ndarray) -> float:
    """Estimates the motion of an image [h, w] as a share of its width, by phase correlation."""
    window = np.outer(np.hanning(first.shape[0]), np.hanning(first.shape[1]))
    spectra = [np.fft.rfft2((image - image.mean()) * window) for image in (first, second)]
    cross = spectra[0] * np.conj(spectra[1])
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-6), s=first.shape)
    row, column = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
    down = row if row <= first.shape[0] // 2 else row - first.shape[0]
    right = column if column <= first.shape[1] // 2 else column - first.shape[1]
    # Noise has no peak: without a clear one the images have nothing in common.
    is_same = float(peaks.max()) > _PEAK * float(peaks.std())
    return float(np.hypot(down, right)) / first.shape[1] if is_same else _LOST


def choose_from(images: Iterable[np.ndarray], num: int) -> VideoFrames:
    """Chooses frames of a video by their pixels.

    Args:
        images: colors [H, W, 3] uint8, in order.
        num: number of frames; fewer if the video has fewer.

    Raises:
        ValueError: there is no frame.
    """
    motion, sharpness, before = list[float](), list[float](), None
    for rgb in images:
        gray = small_gray(rgb)
        motion.append(0.0 if before is None else shift_between(before, gray))
        sharpness.append(float(ndimage.laplace(rgb[::2, ::2].mean(axis=2, dtype=np.float32)).var()))
        before = gray
    if not motion:
        raise InputError("the video has no frames")
    moved, sharp = np.array(motion), np.array(sharpness)
    return VideoFrames(sharpest_of_equal_motion(moved, sharp, num), moved, sharp)


def sharpest_of_equal_motion(motion: np.ndarray, sharpness: np.ndarray, num: int) -> np.ndarray:
    """Cuts a video into segments of equal motion, and selects the sharpest frame of each.

    Args:
        motion: motion since the previous frame, [n].
        sharpness: sharpness of each frame, [n].
        num: number of segments; fewer if the camera hardly moved.

    Returns:
        Indices of the frames, ascending.
    """
    num = min(num, len(motion))
    # Add a little to every frame, so that a camera at rest is sampled evenly.
    path = np.cumsum(np.where(motion > _STILL, motion, 0.0) + 1e-6)
    stretch = np.minimum(
        (num * (path - path[0]) / (path[-1] - path[0] + 1e-9)).astype(int), num - 1
    )
    chosen = [
        int(own[np.argmax(sharpness[own])])
        for part in range(num)
        if len(own := np.flatnonzero(stretch == part))
    ]
    # A fast turn skips segments: the largest remaining gaps are halved.
    while len(chosen) < num:
        rest = np.setdiff1d(np.arange(len(motion)), chosen)
        apart = np.abs(path[rest][:, None] - path[chosen][None]).min(axis=1)
        chosen.append(int(rest[np.argmax(apart)]))
    return np.sort(chosen)


def select_video(
    path: Path,
    num: int,
    folder: Path,
    on_progress: Callable[[str, int], None] = lambda stage, steps: None,
) -> VideoFrames:
    """Writes selected frames of a video as pictures, named by their numbers.

    Args:
        path: the video.
        num: number of frames.
        folder: output folder, made by r3jax.
        on_progress: progress callback.

    Raises:
        FormatError: PyAV is not installed, or the video is damaged.
        OSError: for example, the disk is full or not writable.
    """
    video = Video(path, path)
    on_progress("analyzing the video", len(video))

    def images() -> Iterable[np.ndarray]:
        for number in range(len(video)):
            yield video.frame(number)
            on_progress("", 1)

    found = choose_from(images(), num)
    make_folder(folder / "images")
    on_progress("writing frames", len(found.chosen))
    for number in found.chosen.tolist():
        write_atomic(folder / "images" / f"{number:06d}.png", png(video.frame(number)))
        on_progress("", 1)
    return found
