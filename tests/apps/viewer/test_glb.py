"""The GLB of a world, read back by trimesh: the same triangles in the same colors."""

import io

import numpy as np
import pytest
import trimesh

from r3jax.apps.viewer import run_page as pages
from r3jax.apps.viewer.run_page import world_glb
from r3jax.simulators.world import Material, World

TEXTURE = np.zeros((2, 2, 3), np.uint8)
TEXTURE[0] = (250, 0, 0)  # the first row is at v = 1
TEXTURE[1] = (0, 0, 250)


def make_world(**changes) -> World:
    fields = {
        "name": "toy",
        "vertices": np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float64),
        "faces": np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3]], np.int32),
        "materials": (
            Material(color=(0.5, 1.0, 0.0)),
            Material(color=(0.0, 0.0, 1.0)),
            Material(texture=TEXTURE),
        ),
        "face_material": np.array([0, 2, 2], np.int32),
        "face_uv": np.arange(18, dtype=np.float32).reshape(3, 3, 2) / 18.0,
    }
    return World(**fields | changes)


def read(data: bytes) -> list[trimesh.Trimesh]:
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    return list(scene.geometry.values())


def corners(meshes) -> list:
    return sorted(np.concatenate([m.triangles for m in meshes]).round(5).tolist())


def test_every_triangle_is_there_once():
    world = make_world()
    meshes = read(world_glb(world))
    assert len(meshes) == 2  # the material in between has no face
    assert corners(meshes) == sorted(world.vertices[world.faces].tolist())


def test_triangles_above_the_top_are_left_out_and_those_across_it_stay():
    world = make_world(faces=np.array([[0, 1, 2], [0, 1, 3], [3, 3, 3]], np.int32))
    assert corners(read(world_glb(world, 2.0))) == sorted(world.vertices[world.faces[:2]].tolist())
    assert read(world_glb(world, -1.0)) == []


def test_colors_are_linear_factors_and_textures_keep_their_rows():
    plain, textured = read(world_glb(make_world()))
    factor = np.asarray(plain.visual.material.baseColorFactor)[:3] / 255.0
    np.testing.assert_allclose(factor, [0.214, 1.0, 0.0], atol=3e-3)
    image = np.asarray(textured.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert image[0, 0, 0] > image[0, 0, 2]  # red above blue, as in the world
    assert image[1, 0, 2] > image[1, 0, 0]


def test_texture_coordinates_count_from_the_other_side_in_gltf():
    world = make_world()
    textured = read(world_glb(world))[1]
    # trimesh turns v round when it reads glTF: what comes back is the world's own.
    np.testing.assert_allclose(textured.visual.uv, world.face_uv[[1, 2]].reshape(-1, 2), atol=1e-6)


def test_colors_of_corners_come_along():
    color = np.zeros((3, 3, 3), np.float32)
    color[0] = (1.0, 0.0, 0.5)
    mesh = read(world_glb(make_world(face_color=color)))[0]
    attributes = mesh.visual.vertex_attributes if hasattr(mesh.visual, "vertex_attributes") else {}
    colors = attributes.get("color", getattr(mesh.visual, "vertex_colors", None))
    np.testing.assert_allclose(np.asarray(colors)[0, :3], [255, 0, 55], atol=1)


def test_too_many_triangles_are_refused(monkeypatch):
    monkeypatch.setattr(pages, "MAX_FACES", 2)
    with pytest.raises(ValueError, match=r"3.*2"):
        world_glb(make_world())
