"""Distances to a mesh against boxes worked out on paper, and a brute-force oracle."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.simulators.clearance import SurfaceDistance
from tests.simulators.rooms import box_room

ROOM = box_room()
IN_ROOM = SurfaceDistance(ROOM.vertices, ROOM.faces)

coordinate = st.floats(-2.0, 8.0)


@given(coordinate, coordinate, coordinate)
def test_distance_to_a_box_is_exact(x, y, z):
    point = np.array([x, y, z])
    outside = np.maximum(np.maximum(-point, point - [6, 4, 3]), 0.0)
    inside = min(np.minimum(point, np.array([6, 4, 3]) - point))
    expected = np.linalg.norm(outside) if inside < 0 else inside
    np.testing.assert_allclose(IN_ROOM(point[None])[0], expected, atol=1e-9)


def test_distance_to_random_triangles_matches_dense_sampling():
    rng = np.random.default_rng(3)
    vertices = rng.uniform(-3, 3, (90, 3))
    faces = np.arange(90).reshape(-1, 3)
    points = rng.uniform(-3, 3, (50, 3))
    found = SurfaceDistance(vertices, faces)(points)
    weights = rng.dirichlet([0.7, 0.7, 0.7], 6000)
    samples = np.einsum("wk,fkj->fwj", weights, vertices[faces]).reshape(-1, 3)
    sampled = np.array([np.linalg.norm(samples - p, axis=1).min() for p in points])
    assert (found <= sampled + 1e-9).all()
    np.testing.assert_allclose(found, sampled, atol=0.15)


def test_points_on_the_surface_have_no_clearance():
    rng = np.random.default_rng(4)
    weights = rng.dirichlet([1, 1, 1], len(ROOM.faces))
    on_surface = np.einsum("fk,fkj->fj", weights, ROOM.vertices[ROOM.faces])
    np.testing.assert_allclose(IN_ROOM(on_surface), 0.0, atol=1e-9)


def test_flat_triangles_count_as_their_edges():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    distance = SurfaceDistance(vertices, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(distance(np.array([[1.5, 2.0, 0.0], [4.0, 0, 0]])), [2.0, 2.0])
