"""The map from above: numbers that do not cover each other."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.apps.audit.audit_figures import apart

places = hnp.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(2)), elements=st.floats(-3, 3))


def gaps(points):
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return distance[~np.eye(len(points), dtype=bool)]


@given(places)
def test_no_two_places_are_nearer_than_they_should_be(points):
    moved = apart(points, 0.3)
    assert gaps(moved).min(initial=np.inf) >= 0.3 * 0.95
    np.testing.assert_allclose(moved.mean(axis=0), points.mean(axis=0), atol=1e-9)


def test_what_is_apart_stays_where_it_is():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(apart(points, 0.5), points)
    assert apart(np.zeros((0, 2)), 0.5).shape == (0, 2)


def test_two_on_one_spot_part_by_as_much_as_it_takes():
    np.testing.assert_allclose(apart(np.zeros((2, 2)), 0.4), [[-0.2, 0.0], [0.2, 0.0]])
