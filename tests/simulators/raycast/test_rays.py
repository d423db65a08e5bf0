"""Hits on a box, worked out on paper; packets against single rays on triangle soups."""

import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
from hypothesis import given

from r3jax.simulators.raycast import embree
from r3jax.simulators.raycast.rays import TriangleScene
from tests.simulators.rooms import box_quads, box_room, world_of


def single_rays(vertices, faces, monkeypatch):
    """A scene that has no library to trace packets with."""
    with monkeypatch.context() as patch:
        patch.setattr(embree, "library", lambda: None)
        return TriangleScene(vertices, faces)


@pytest.fixture(scope="module", params=["packets", "single"])
def room(request):
    world = box_room()
    if request.param == "packets":
        return TriangleScene(world.vertices, world.faces)
    with pytest.MonkeyPatch.context() as patch:
        return single_rays(world.vertices, world.faces, patch)


def rays(*pairs):
    origins, directions = zip(*pairs, strict=True)
    return np.array(origins, np.float32), np.array(directions, np.float32)


def test_distance_is_in_lengths_of_the_direction(room):
    hits = room.cast(*rays(((1, 2, 1), (1, 0, 0)), ((1, 2, 1), (0, 0, 2)), ((1, 2, 1), (5, 0, 5))))
    np.testing.assert_allclose(hits.distance, [5.0, 1.0, 0.4], rtol=1e-6)


def test_barycentric_weights_give_the_point_that_was_hit():
    world = box_room()
    rng = np.random.default_rng(0)
    origins = np.full((200, 3), (2.0, 1.5, 1.2), np.float32)
    directions = rng.normal(size=(200, 3)).astype(np.float32)
    hits = TriangleScene(world.vertices, world.faces).cast(origins, directions)
    corners = world.vertices[world.faces[hits.face]]
    weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=1)
    by_weights = np.einsum("nk,nkj->nj", weights, corners)
    np.testing.assert_allclose(by_weights, origins + hits.distance[:, None] * directions, atol=1e-5)


def test_a_miss_has_no_face_and_infinite_distance(room):
    hits = room.cast(*rays(((-1, 2, 1), (-1, 0, 0))))
    assert hits.face[0] == -1
    assert np.isinf(hits.distance[0])
    assert not hits.is_back[0]


def test_back_faces_are_seen_from_without_only(room):
    hits = room.cast(*rays(((1, 2, 1), (0, 1, 0)), ((-1, 2, 1), (1, 0, 0))))
    assert hits.is_back.tolist() == [False, True]


def test_culling_looks_through_back_faces_to_the_next_front_face(room):
    hits = room.cast(*rays(((-1, 2, 1), (1, 0, 0))), cull_back_faces=True)
    np.testing.assert_allclose(hits.distance, [7.0], rtol=1e-5)
    assert not hits.is_back[0]


def test_culling_a_solid_seen_from_within_leaves_nothing():
    world = world_of(box_quads((0, 0, 0), (1, 1, 1), inward=False))
    scene = TriangleScene(world.vertices, world.faces)
    hits = scene.cast(*rays(((0.5, 0.5, 0.5), (1, 0.1, 0))), cull_back_faces=True)
    assert hits.face[0] == -1
    assert np.isinf(hits.distance[0])


def test_no_ray_slips_through_the_edges_of_a_closed_box(room):
    corners = np.array([[x, y, z] for x in (0, 6) for y in (0, 4) for z in (0, 3)], float)
    ends = [(1 - s) * a + s * b for a in corners for b in corners for s in (0.25, 0.5)]
    origin = np.array([1.7, 2.1, 1.3])
    directions = (np.array(ends) - origin).astype(np.float32)
    hits = room.cast(np.full(directions.shape, origin, np.float32), directions)
    assert np.isfinite(hits.distance).all()


def test_rays_do_not_depend_on_their_batch_and_there_may_be_none(room):
    origins, directions = rays(((1, 2, 1), (1, 0, 0)), ((1, 2, 1), (0, 1, 0)))
    whole = room.cast(origins, directions)
    for k in (0, 1):
        alone = room.cast(origins[k : k + 1], directions[k : k + 1])
        np.testing.assert_array_equal(whole.distance[k : k + 1], alone.distance)
        np.testing.assert_array_equal(whole.face[k : k + 1], alone.face)
    assert len(room.cast(origins[:0], directions[:0]).face) == 0


def test_the_package_brings_the_library_that_packets_need():
    assert embree.library() is not None


@given(
    seed=st.integers(0, 2**32 - 1), num_faces=st.integers(1, 40), num_rays=st.integers(1, 70),
    cull=st.booleans(), neighbors=st.booleans(), same_origin=st.booleans(),
)  # fmt: skip
def test_packets_hit_what_single_rays_hit(seed, num_faces, num_rays, cull, neighbors, same_origin):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(3 * num_faces, 3)).astype(np.float32)
    faces = np.arange(3 * num_faces).reshape(-1, 3)
    origins = 2 * rng.normal(size=(1 if same_origin else num_rays, 3)).astype(np.float32)
    directions = (rng.normal(size=(num_rays, 3)) - origins).astype(np.float32)
    with pytest.MonkeyPatch.context() as patch:
        expected = single_rays(vertices, faces, patch).cast(
            origins, directions, cull_back_faces=cull
        )
    found = TriangleScene(vertices, faces).cast(
        origins, directions, cull_back_faces=cull, neighbors=neighbors
    )
    np.testing.assert_array_equal(found.face, expected.face)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=1e-4)
    np.testing.assert_array_equal(found.is_back, expected.is_back)
    is_hit = found.face >= 0
    np.testing.assert_allclose(found.u[is_hit], expected.u[is_hit], atol=1e-3)
    np.testing.assert_allclose(found.v[is_hit], expected.v[is_hit], atol=1e-3)


@pytest.mark.parametrize("neighbors", [False, True])
def test_neither_kind_of_packet_slips_through_the_edges_of_a_sphere(neighbors):
    sphere = trimesh.creation.icosphere(subdivisions=4)
    scene = TriangleScene(sphere.vertices, sphere.faces)
    # Through every corner, and through the middle of every edge.
    middles = sphere.vertices[sphere.edges_unique].mean(axis=1)
    directions = np.concatenate([sphere.vertices, middles]).astype(np.float32)
    hits = scene.cast(np.full((1, 3), 0.01, np.float32), directions, neighbors=neighbors)
    assert np.isfinite(hits.distance).all()
