"""Directions of rays: the pixels' own, turned to where the camera looks.

Not by a product of matrices in NumPy: the threads of its linear algebra wait for the next product
by spinning, and take one of two cores from everything that follows.

Shape symbols: n rays; W workers.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.native.arithmetic import fused
from r3jax.native.compiled import called_from_python
from r3jax.native.ffi import num_workers, require_threads


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
