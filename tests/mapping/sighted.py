"""Maps and reference maps of sightings, and exact comparison of maps."""

import numpy as np

from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_points
from tests.mapping.reference import ReferenceMap, read_map
from tests.strategies import NUM_POINTS, VOXEL_SIZE, Sighting

CAPACITY, NUM_BINS = 128, 64  # one shape: one compile


def new_map(capacity: int = CAPACITY, voxel_size: float = VOXEL_SIZE) -> MapState:
    return empty_map(capacity, voxel_size, NUM_BINS)


def map_of(seen: list[Sighting], add=integrate_points, capacity: int = CAPACITY) -> MapState:
    state = new_map(capacity)
    for sighting in seen:
        state = add(state, *sighting)
    return state


def reference_of(seen: list[Sighting]) -> ReferenceMap:
    reference = ReferenceMap(VOXEL_SIZE, NUM_BINS)
    for sighting in seen:
        reference.see(*sighting)
    return reference


def random_sighting(seed: int, reach: int = 2) -> Sighting:
    """Like those of the strategy, for examples that are fixed."""
    random = np.random.default_rng(seed)
    voxel = random.integers(-reach, reach, (NUM_POINTS, 3))
    return Sighting(
        ((voxel + random.integers(0, 16, (NUM_POINTS, 3)) / 16) * VOXEL_SIZE).astype(np.float32),
        random.random((NUM_POINTS, 3)).astype(np.float32),
        ((random.integers(-512, 512, 3) + 0.25) / 256).astype(np.float32),
        float(random.choice([1.0, 64.0, 300.0])),
    )


def assert_identical_rows(actual: MapState, expected: MapState) -> None:
    """Same voxels and bit for bit the same statistics, whatever the order of rows."""
    rows, rows_expected = read_map(actual), read_map(expected)
    assert rows.keys() == rows_expected.keys()
    for voxel, row in rows_expected.items():
        np.testing.assert_equal(rows[voxel]._asdict(), row._asdict())
