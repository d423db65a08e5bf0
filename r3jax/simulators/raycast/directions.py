"""Directions of rays: the pixels' own, turned to where the camera looks, and more inside pixels.

Not by a product of matrices in NumPy: the threads of its linear algebra wait for the next product
by spinning, and take one of two cores from everything that follows.

Shape symbols: n rays; m pixels; S rays inside a pixel.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.native.arithmetic import fused
from r3jax.kernels.native.compiled import called_from_python, inlined
from r3jax.kernels.native.ffi import num_workers, require_threads

_EDGE_CONTRAST = np.float32(12.0 / 255.0)
"""Neighbors that differ by less in every channel get no more rays: with a third of this, half as
many rays again gain 0.2 dB at 40 dB."""


def turned(directions: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Turns `directions` [n, 3] by `rotation` [3, 3], both float32."""
    require_threads()
    there = np.empty_like(directions)
    _turn_all(directions, rotation, num_workers(), there)
    return there


@called_from_python(parallel=True)
def _turn_all(directions, rotation, workers, there):
    num = directions.shape[0]
    for worker in prange(workers):
        for i in range(worker * num // workers, (worker + 1) * num // workers):
            for axis in range(3):
                # Fused one by one, as every library's product of matrices does: the same images.
                along = rotation[axis, 0] * directions[i, 0]
                along = fused(rotation[axis, 1], directions[i, 1], along)
                there[i, axis] = fused(rotation[axis, 2], directions[i, 2], along)


def inside(directions: np.ndarray, pixels: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Directions of the rays inside pixels, [m S, 3]: those of a pixel follow each other.

    Args:
        directions: of the rays through the centers of all pixels [n, 3].
        pixels: which of them [m].
        shifts: from a center to the places inside a pixel [S, 3].
    """
    require_threads()
    rays = np.empty((len(pixels) * len(shifts), 3), np.float32)
    _spread_all(directions, pixels, shifts, num_workers(), rays)
    return rays


@called_from_python(parallel=True)
def _spread_all(directions, pixels, shifts, workers, rays):
    num, each = pixels.shape[0], shifts.shape[0]
    for worker in prange(workers):
        for k in range(worker * num // workers, (worker + 1) * num // workers):
            for s in range(each):
                for axis in range(3):
                    rays[k * each + s, axis] = directions[pixels[k], axis] + shifts[s, axis]


def average(image: np.ndarray, pixels: np.ndarray, colors: np.ndarray) -> None:
    """Averages the colors of some pixels over more rays, in place.

    Args:
        image: colors of the centers of all pixels [n, 3].
        pixels: which of them [m].
        colors: of the rays inside them [m S, 3], as `inside` has them.
    """
    require_threads()
    _average_all(image, pixels, colors, num_workers())


@called_from_python(parallel=True)
def _average_all(image, pixels, colors, workers):
    num = pixels.shape[0]
    each = colors.shape[0] // num
    for worker in prange(workers):
        for k in range(worker * num // workers, (worker + 1) * num // workers):
            for channel in range(3):
                total = colors[k * each, channel]
                for s in range(1, each):
                    total += colors[k * each + s, channel]
                whole = image[pixels[k], channel] + total
                image[pixels[k], channel] = whole / np.float32(each + 1)


@inlined
def _differ(image, face, row, column, next_row, next_column):
    """True if two pixels show different faces in different colors."""
    if face[row, column] == face[next_row, next_column]:
        return False
    contrast = np.float32(0.0)
    for channel in range(3):
        step = abs(image[row, column, channel] - image[next_row, next_column, channel])
        contrast = max(contrast, step)
    return contrast > _EDGE_CONTRAST


@called_from_python()
def find_edges(image, face, is_edge):
    """Marks pixels that show another face in another color than a pixel beside them, [H, W]."""
    height, width = face.shape
    for i in range(height):
        for j in range(width):
            if j + 1 < width and _differ(image, face, i, j, i, j + 1):
                is_edge[i, j] = is_edge[i, j + 1] = True
            if i + 1 < height and _differ(image, face, i, j, i + 1, j):
                is_edge[i, j] = is_edge[i + 1, j] = True
