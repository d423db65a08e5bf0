"""Frames of a video before anything is known of its geometry: sharp ones, within equal motion.

How far the image moves from one frame to the next is measured by phase correlation (Kuglin and
Hines 1975) of small gray images. The video is cut into stretches of equal motion, so that a camera
that stands still leaves one frame and a fast turn many, and of each stretch the sharpest frame is
kept, by the variance of the Laplacian: within a stretch frames show nearly the same.

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
"""Columns of the images whose motion is measured [px]."""

_STILL = 0.002
"""Motion that counts for nothing, as a share of the width: noise, and a hand that holds still."""

_PEAK = 8.0
"""Standard deviations of the correlation that its peak stands out by: chance reaches five."""

_LOST = 0.35
"""Motion of a pair of frames that have nothing in common, such as a cut."""


@dataclass(frozen=True)
class VideoFrames:
    """Frames of a video."""

    chosen: np.ndarray
    """Numbers of the frames, [k], ascending."""

    motion: np.ndarray
    """How far the image moved since the frame before, [n] [share of its width]."""

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
    # Noise has no peak: what is nowhere near one is another picture.
    is_same = float(peaks.max()) > _PEAK * float(peaks.std())
    return float(np.hypot(down, right)) / first.shape[1] if is_same else _LOST


def choose_from(images: Iterable[np.ndarray], num: int) -> VideoFrames:
    """Chooses frames of a video by their pixels.

    Args:
        images: colors [H, W, 3] uint8, in order.
        num: frames wanted; fewer come of a video that has fewer.

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
    """Cuts a video into stretches of equal motion, and takes the sharpest frame of each.

    Args:
        motion: since the frame before, [n].
        sharpness: [n].
        num: stretches; where the camera hardly moved, fewer.

    Returns:
        Numbers of the frames, ascending.
    """
    num = min(num, len(motion))
    # A little for every frame: of a camera that stands still frames are taken evenly.
    path = np.cumsum(np.where(motion > _STILL, motion, 0.0) + 1e-6)
    stretch = np.minimum(
        (num * (path - path[0]) / (path[-1] - path[0] + 1e-9)).astype(int), num - 1
    )
    chosen = [
        int(own[np.argmax(sharpness[own])])
        for part in range(num)
        if len(own := np.flatnonzero(stretch == part))
    ]
    # A fast turn skips stretches: the largest gaps that are left are halved.
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
    """Writes the chosen frames of a video as pictures, named by their numbers.

    Args:
        path: the video.
        num: frames wanted.
        folder: ours.
        on_progress: for a progress bar.

    Raises:
        FormatError: PyAV is not installed, or the video is damaged.
        OSError: the disk is full, not writable, ...
    """
    video = Video(path, path)
    on_progress("looking at the video", len(video))

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
