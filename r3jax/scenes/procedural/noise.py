"""Tileable random fields, the raw material of every texture.

Shape symbols: h w texels. Fields have mean 0 and standard deviation 1.
"""

import functools

import numpy as np
from scipy import fft


@functools.lru_cache(maxsize=64)
def cloud(
    height: int,
    width: int,
    seed: int,
    slope: float = 1.6,
    stretch_x: float = 1.0,
    lowest: float = 1.0,
) -> np.ndarray:
    """A periodic random field with the amplitude spectrum 1 / f ** slope.

    Args:
        height: rows [texels].
        width: columns [texels].
        seed: which field.
        slope: 0 gives white noise, 1 rough, 2 smooth clouds.
        stretch_x: features are this many times longer along a row than across.
        lowest: frequencies below this many cycles per tile are left out.

    Returns:
        [h, w] float32, read-only, mean 0, standard deviation 1.
    """
    rng = np.random.default_rng(seed)
    spectrum = fft.rfft2(rng.standard_normal((height, width), dtype=np.float32))
    fy = np.fft.fftfreq(height, 1.0 / height)[:, None] * (width / height)
    fx = np.fft.rfftfreq(width, 1.0 / width)[None, :]
    frequency = np.sqrt((fx * stretch_x) ** 2 + fy**2)
    gain = np.where(frequency < lowest, 0.0, np.maximum(frequency, 1.0) ** -slope)
    field = fft.irfft2(spectrum * gain.astype(np.float32), s=(height, width))
    field = (field - field.mean()) / field.std()
    field = field.astype(np.float32)
    field.flags.writeable = False
    return field


def ridge(num: int, seed: int, slope: float = 1.5) -> np.ndarray:
    """A periodic one-dimensional skyline, [num] float32, mean 0, standard deviation 1."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft(rng.standard_normal(num))
    frequency = np.arange(len(spectrum))
    gain = np.where(frequency == 0, 0.0, np.maximum(frequency, 1) ** -slope)
    line = np.fft.irfft(spectrum * gain, n=num)
    return ((line - line.mean()) / line.std()).astype(np.float32)


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, a smooth ramp between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Mixes two colour images (or colours [3]) by a weight [h, w]: 0 gives a, 1 gives b."""
    w = weight[..., None]
    return a * (1.0 - w) + b * w


def texels(image: np.ndarray) -> np.ndarray:
    """Rounds a colour image in [0, 1] to read-only bytes, [h, w, 3] uint8."""
    out = np.clip(np.rint(image * 255.0), 0, 255).astype(np.uint8)
    out.flags.writeable = False
    return out
