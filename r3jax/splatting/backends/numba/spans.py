"""Which tiles a Gaussian touches: the exact rows of its ellipse in each column of tiles."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.splatting.backends.numba.compiled import inlined
from r3jax.splatting.backends.numba.records import (
    CENTER_X,
    CENTER_Y,
    INVERSE_XX,
    SLOPE,
    TWO_S,
    VARIANCE,
)
from r3jax.splatting.config import TILE

_SLACK = np.float32(2e-3)
"""Added to every extent [px], so that rounding never cuts off a pixel."""

_HALF = np.float32(0.5)
_ZERO = np.float32(0.0)


@inlined
def pixel_range(low, high, size):
    """First and last pixel whose center lies in [low, high], within an image of so many."""
    first = np.ceil(max(low, _ZERO) - _HALF)
    last = np.floor(min(high, np.float32(size)) - _HALF)
    # Comparisons in floats first: a far-away bound would not fit an integer.
    if not (first <= last):
        return 0, -1
    return max(int(first), 0), min(int(last), size - 1)


@inlined
def tile_columns(record, width):
    """First and last column of tiles that the ellipse touches."""
    reach = np.sqrt(record[TWO_S] / record[INVERSE_XX]) + _SLACK
    first, last = pixel_range(record[CENTER_X] - reach, record[CENTER_X] + reach, width)
    if last < first:
        return 0, -1
    return first // TILE, last // TILE


@inlined
def rows_in_column(record, column, height):
    """First and last pixel row that the ellipse touches within one column of tiles.

    On the ellipse, dy = slope dx +- sqrt(variance (2 s - dx^2 / xx)) (the Gaussian's conditional
    mean and variance). Its highest point in a strip is that of the whole ellipse, or lies on the
    edge of the strip that is nearer to it.
    """
    slope, variance = record[SLOPE], record[VARIANCE]
    inverse, two_s = record[INVERSE_XX], record[TWO_S]
    reach = np.sqrt(two_s / inverse)
    left = np.float32(column * TILE) + _HALF - record[CENTER_X]
    low, high = max(left, -reach), min(left + np.float32(TILE - 1), reach)
    yy = variance + slope * slope / inverse
    at_top = slope / inverse * np.sqrt(two_s / yy)
    x = min(max(at_top, low), high)
    most = slope * x + np.sqrt(variance * max(two_s - x * x * inverse, _ZERO))
    x = min(max(-at_top, low), high)
    least = slope * x - np.sqrt(variance * max(two_s - x * x * inverse, _ZERO))
    y = record[CENTER_Y]
    return pixel_range(y + least - _SLACK, y + most + _SLACK, height)
