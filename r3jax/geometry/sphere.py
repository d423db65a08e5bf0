"""Directions on the unit sphere: the Fibonacci lattice and what lies inside a field of view.

Shape symbols: B directions of a lattice; n query directions.
"""

import functools
import math

import numpy as np


@functools.cache
def _lattice(num: int) -> np.ndarray:
    k = np.arange(num, dtype=np.float64)
    z = 1.0 - 2.0 * (k + 0.5) / num
    azimuth = 2.0 * np.pi * k / ((1.0 + math.sqrt(5.0)) / 2.0)
    radius = np.sqrt(1.0 - z * z)
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    points.flags.writeable = False
    return points


def fibonacci_lattice(num: int) -> np.ndarray:
    """`num` nearly even unit directions, [num, 3] float64.

    z_k = 1 - 2 (k + 0.5) / num, azimuth 2 pi k / golden ratio, k = 0..num-1 (arXiv 2601.07484,
    whose k = 1..num would leave the sphere).
    """
    if num < 1:
        raise ValueError(f"a lattice needs at least one direction, got {num}")
    return _lattice(num)


def bins_for_angle(angle_deg: float) -> int:
    """Number of bins so that each covers a cap of the full opening `angle_deg` [deg].

    A = 2 pi (1 - cos(angle / 2)), num = ceil(4 pi / A); 10 degrees give 526.
    """
    cap = 2.0 * math.pi * (1.0 - math.cos(0.5 * math.radians(angle_deg)))
    return math.ceil(4.0 * math.pi / cap)
