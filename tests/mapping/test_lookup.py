"""From points to rows: each point's own voxel, or nothing."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given

from r3jax.mapping import lookup as real
from r3jax.mapping.join import grow
from r3jax.mapping.lookup import lookup
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_points
from tests.strategies import NUM_POINTS, VOXEL_SIZE, Sighting, sightings

CAPACITY = 64


def map_of(sighting: Sighting, capacity: int = CAPACITY) -> MapState:
    return integrate_points(empty_map(capacity, VOXEL_SIZE), *sighting)


def colors_by_voxel(sighting: Sighting) -> dict[tuple[int, ...], np.ndarray]:
    voxel = np.floor(sighting.points / VOXEL_SIZE).astype(int)
    return {
        tuple(v): sighting.rgb[(voxel == v).all(axis=1)].mean(axis=0)
        for v in np.unique(voxel, axis=0)
    }


def assert_found(lookup, state: MapState, sighting: Sighting, queries: np.ndarray) -> None:
    """A point's row holds the mean color of its voxel; points elsewhere have no row."""
    rows = np.asarray(lookup(state, jnp.asarray(queries)))
    mean, expected = np.asarray(state.mean).T, colors_by_voxel(sighting)
    owners: dict[int, tuple[int, ...]] = {}
    for point, row in zip(queries, rows.tolist(), strict=True):
        voxel = tuple(np.floor(point / VOXEL_SIZE).astype(int).tolist())
        if voxel in expected:
            assert row < state.capacity, f"{voxel} is not found"
            assert owners.setdefault(row, voxel) == voxel, "two voxels share a row"
            np.testing.assert_allclose(mean[row], expected[voxel], atol=1e-6)
        else:
            assert row == state.capacity, f"{voxel} was never seen"


@given(sightings(), sightings(reach=3))
def test_points_find_the_row_of_their_voxel(seen, asked):
    state = map_of(seen)
    assert_found(lookup, state, seen, seen.points)
    assert_found(lookup, state, seen, asked.points)


@given(sightings())
def test_points_find_their_row_in_a_grown_map(seen):
    assert_found(lookup, grow(map_of(seen), 4 * CAPACITY), seen, seen.points)


def fixed_sighting() -> Sighting:
    """Voxels at (i, -2 i, 3 i), far apart colors."""
    number = np.arange(NUM_POINTS)[:, None]
    points = (number * [1, -2, 3] + 0.5) * VOXEL_SIZE
    random = np.random.default_rng(4)
    return Sighting(
        points.astype(np.float32),
        random.random((NUM_POINTS, 3)).astype(np.float32),
        np.array([0.3, 0.2, -1.0], np.float32),
        1.0,
    )


def test_an_empty_map_has_no_rows():
    nothing = lookup(empty_map(CAPACITY, VOXEL_SIZE), jnp.asarray(fixed_sighting().points))
    np.testing.assert_array_equal(nothing, CAPACITY)


def test_points_of_any_leading_shape():
    seen = fixed_sighting()
    state, points = map_of(seen), jnp.asarray(seen.points)
    rows = lookup(state, points)
    np.testing.assert_array_equal(lookup(state, points.reshape(2, -1, 3)), rows.reshape(2, -1))
    assert int(lookup(state, points[5])) == int(rows[5])
    np.testing.assert_array_equal(jax.vmap(lookup, in_axes=(None, 0))(state, points), rows)


# Laws of fixed examples ---------------------------------------------------------------------------


def test_rows() -> None:
    seen = fixed_sighting()
    swapped = np.concatenate([seen.points[:, [1, 0, 2]], seen.points[:, [0, 2, 1]]])
    assert_found(real.lookup, map_of(seen), seen, seen.points)
    assert_found(real.lookup, map_of(seen), seen, swapped)


def test_points_that_are_not_finite_are_in_no_voxel() -> None:
    """Voxel 0 is in the map: what is not finite must not be taken for the origin."""
    state = map_of(fixed_sighting())
    bad = np.full((NUM_POINTS, 3), 0.5 * VOXEL_SIZE, np.float32)
    bad[:, 0] = np.resize([np.nan, np.inf, -np.inf], NUM_POINTS)
    bad[::2, 1:] = np.nan
    np.testing.assert_array_equal(real.lookup(state, jnp.asarray(bad)), CAPACITY)
