"""Tileable random fields, the raw material of every texture.

Shape symbols: h w texels. Fields have mean 0 and standard deviation 1.
"""

import functools

import numpy as np

Real = float | int
"""A number as people write it: 2 as well as 2.0."""


@functools.lru_cache(maxsize=8)
def _spectrum(height: int, width: int, seed: int) -> np.ndarray:
    """Fourier transform of white noise, [h, w // 2 + 1]: many fields are shaped from one."""
    noise = np.random.default_rng(seed).standard_normal((height, width), dtype=np.float32)
    return np.fft.rfft2(noise)


@functools.lru_cache(maxsize=64)
def _field(
    height: int, width: int, seed: int, slope: Real, stretch_x: Real, lowest: Real
) -> np.ndarray:
    fy = np.fft.fftfreq(height, 1.0 / height)[:, None] * (width / height)
    fx = np.fft.rfftfreq(width, 1.0 / width)[None, :]
    squared = ((fx * stretch_x) ** 2 + fy**2).astype(np.float32)
    gain = np.maximum(squared, 1.0) ** np.float32(-0.5 * slope)
    gain[squared < lowest**2] = 0.0
    field = np.fft.irfft2(_spectrum(height, width, seed) * gain, s=(height, width))
    field = (field - field.mean()) / field.std()
    field.flags.writeable = False
    return field


def cloud(
    height: int,
    width: int,
    seed: int,
    slope: Real = 1.6,
    stretch_x: Real = 1.0,
    lowest: Real = 1.0,
) -> np.ndarray:
    """A periodic random field with the amplitude spectrum 1 / f ** slope.

    Fields are drawn from a small pool and shifted by the seed: a Fourier transform per field
    would make a scene take seconds, and a shifted field under another color looks new.

    Args:
        height: rows [texels].
        width: columns [texels].
        seed: which field.
        slope: 0 gives white noise, 1 rough, 2 smooth clouds.
        stretch_x: features are this many times longer along a row than across.
        lowest: frequencies below this many cycles per tile are left out.

    Returns:
        [h, w] float32, mean 0, standard deviation 1.
    """
    field = _field(height, width, seed % 2, slope, stretch_x, lowest)
    if seed < 2:
        return field
    shift = np.random.default_rng(seed).integers(0, (height, width))
    return np.roll(field, tuple(int(n) for n in shift), axis=(0, 1))


def ridge(num: int, seed: int, slope: Real = 1.5) -> np.ndarray:
    """A periodic one-dimensional skyline, [num] float32, mean 0, standard deviation 1."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft(rng.standard_normal(num))
    frequency = np.arange(len(spectrum))
    gain = np.where(frequency == 0, 0.0, np.maximum(frequency, 1) ** -slope)
    line = np.fft.irfft(spectrum * gain, n=num)
    return ((line - line.mean()) / line.std()).astype(np.float32)


def smoothstep(low: Real, high: Real, x: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, a smooth ramp between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Mixes two color images (or colors [3]) by a weight [h, w]: 0 gives a, 1 gives b."""
    return a + (b - a) * weight[..., None].astype(np.float32)


def texels(image: np.ndarray) -> np.ndarray:
    """Rounds a color image in [0, 1] to read-only bytes, [h, w, 3] uint8."""
    out = np.clip(image * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    out.flags.writeable = False
    return out
