"""Machine code over cells against SciPy, and against asking every cell in NumPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from r3jax.kernels.robot.cells import flood, nearest_in_ring

FACES = ndimage.generate_binary_structure(3, 1)


def random_mask(rng):
    return rng.random(rng.integers(1, 9, 3)) < rng.random()


@given(st.integers(0, 2**32 - 1))
def test_a_flood_fills_the_regions_that_hold_a_seed(seed):
    rng = np.random.default_rng(seed)
    mask = random_mask(rng)
    seeds = rng.random(mask.shape) < 0.1
    labels, _ = ndimage.label(mask, FACES)
    held = np.unique(labels[seeds & mask])
    np.testing.assert_array_equal(flood(mask, seeds), np.isin(labels, held) & mask)


@given(st.integers(0, 2**32 - 1))
def test_a_ring_holds_the_nearest_cells_in_range(seed):
    rng = np.random.default_rng(seed)
    mask, most = random_mask(rng), int(rng.integers(1, 40))
    middle = rng.integers(0, mask.shape)
    reach, size = int(rng.integers(1, 6)), 0.2
    closest, farthest = np.sort(rng.integers(0, 10, 2)) * 0.1
    cells = np.argwhere(mask)
    cells = cells[np.all(np.abs(cells - middle) <= reach, axis=1)]
    distance = np.linalg.norm(cells - middle, axis=1) * size
    # The nearest first, of equals the first of the array; then those in range of these.
    nearest = np.argsort(distance, kind="stable")[:most]
    nearest = nearest[(distance[nearest] >= closest) & (distance[nearest] <= farthest)]
    found = nearest_in_ring(mask, middle, reach, size, closest, farthest, most)
    np.testing.assert_array_equal(found, cells[nearest])
