"""Mesh files of every kind arrive with their shape, their colors and their upright direction."""

import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from r3jax.simulators.meshes import assumptions, load_world

CORNERS = np.array([[0.0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def texels(height=3, width=5):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def textured(image, uv=UV):
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(image))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(CORNERS, FACES, visual=visual, process=False)


def plain(**colors):
    return trimesh.Trimesh(CORNERS, FACES, process=False, **colors)


def saved(tmp_path, mesh, name):
    path = tmp_path / name
    if path.suffix == ".gltf":  # several files
        for file, content in trimesh.exchange.gltf.export_gltf(mesh.scene()).items():
            (tmp_path / file.replace("model.gltf", name)).write_bytes(content)
    else:
        mesh.export(path)
    return path


def corners_of(world):
    return world.vertices[world.faces]


def test_a_glb_is_turned_upright(tmp_path):
    path = saved(tmp_path, plain(), "a.glb")
    x, y, z = CORNERS[FACES].reshape(-1, 3).T
    expected = np.stack([x, -z, y], axis=1).reshape(-1, 3, 3)
    np.testing.assert_allclose(corners_of(load_world(path)), expected, atol=1e-6)
    np.testing.assert_allclose(corners_of(load_world(path, up="z")), CORNERS[FACES], atol=1e-6)


@pytest.mark.parametrize("name", ["a.ply", "a.obj"])
def test_other_formats_are_upright_unless_told_otherwise(tmp_path, name):
    path = saved(tmp_path, plain(), name)
    np.testing.assert_allclose(corners_of(load_world(path)), CORNERS[FACES], atol=1e-6)
    turned = corners_of(load_world(path, up="y"))
    np.testing.assert_allclose(turned[..., 2], CORNERS[FACES][..., 1], atol=1e-6)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.obj"])
def test_textures_keep_their_size_and_orientation(tmp_path, name):
    image = texels()
    world = load_world(saved(tmp_path, textured(image), name), up="z")
    (material,) = world.materials
    np.testing.assert_array_equal(material.texture, image)
    np.testing.assert_allclose(world.face_uv, UV[FACES], atol=1e-5)
    assert material.color == (1.0, 1.0, 1.0)


def test_texture_coordinates_outside_the_unit_square_survive(tmp_path):
    world = load_world(saved(tmp_path, textured(texels(), UV * 4.0 - 1.5), "a.glb"))
    np.testing.assert_allclose(world.face_uv, (UV * 4.0 - 1.5)[FACES], atol=1e-5)


@pytest.mark.parametrize("name", ["a.glb", "a.ply", "a.obj"])
def test_vertex_colors(tmp_path, name):
    colors = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [51, 102, 153, 255]])
    path = saved(tmp_path, plain(vertex_colors=colors.astype(np.uint8)), name)
    world = load_world(path, up="z")
    np.testing.assert_allclose(world.face_color, colors[FACES][..., :3] / 255, atol=2e-3)


def test_face_colors(tmp_path):
    colors = np.array([[255, 0, 0, 255], [0, 0, 255, 255]], np.uint8)
    world = load_world(saved(tmp_path, plain(face_colors=colors), "a.ply"))
    expected = np.repeat(colors[:, None, :3] / 255, 3, axis=1)
    np.testing.assert_allclose(world.face_color, expected, atol=1e-6)


def test_plain_colors(tmp_path):
    mesh = plain()
    mesh.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[51, 102, 204, 255])
    )
    (material,) = load_world(saved(tmp_path, mesh, "a.glb")).materials
    np.testing.assert_allclose(material.color, [0.2, 0.4, 0.8], atol=1e-6)
    assert material.texture is None


def test_a_mesh_without_any_color_is_gray(tmp_path):
    world = load_world(saved(tmp_path, plain(), "a.obj"))
    assert world.face_color is None
    assert world.materials[0].color == (0.7, 0.7, 0.7)


def test_mixtures_in_one_file(tmp_path):
    red = np.tile(np.array([[255, 0, 0, 255]], np.uint8), (4, 1))
    scene = trimesh.Scene({"painted": textured(texels()), "colored": plain(vertex_colors=red)})
    world = load_world(saved(tmp_path, scene, "a.glb"))
    assert len(world.faces) == 4
    has_texture = np.array([m.texture is not None for m in world.materials])[world.face_material]
    assert has_texture.tolist().count(True) == 2
    np.testing.assert_allclose(world.face_color[has_texture], 1.0)
    np.testing.assert_allclose(world.face_color[~has_texture], [[[1, 0, 0]] * 3] * 2)


def test_instances_stand_where_the_scene_graph_puts_them(tmp_path):
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.5 * np.pi, [0, 0, 1])
    turn[:3, 3] = 10, 0, 0
    image = texels()
    scene.add_geometry(textured(image), geom_name="quad", node_name="first")
    scene.add_geometry(
        textured(image), geom_name="quad", node_name="second", parent_node_name="first"
    )
    scene.graph.update(frame_from="world", frame_to="second", matrix=turn, geometry="quad")
    world = load_world(saved(tmp_path, scene, "a.glb"), up="z")
    triangles = corners_of(world)
    assert len(triangles) == 4
    moved = CORNERS[FACES] @ turn[:3, :3].T + turn[:3, 3]
    expected = np.concatenate([CORNERS[FACES], moved])
    order = lambda t: t[np.lexsort(t.reshape(len(t), -1).round(4).T)]
    np.testing.assert_allclose(order(triangles), order(expected), atol=1e-5)


def test_a_mirrored_node_keeps_its_front_in_front(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(textured(texels()), transform=np.diag([-1.0, 1, 1, 1]))
    world = load_world(saved(tmp_path, scene, "a.glb"), up="z")
    a, b, c = corners_of(world)[0]
    assert np.cross(b - a, c - a)[2] > 0.0
    at_origin = np.abs(corners_of(world)).max(axis=-1) < 1e-9
    np.testing.assert_allclose(world.face_uv[at_origin], 0.0, atol=1e-6)


QUADS = """ply
format ascii 1.0
element vertex 6
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
1 0 0 0 255 0
1 1 0 0 0 255
0 1 0 255 255 0
2 0 0 10 20 30
2 1 0 40 50 60
"""


def test_quads_become_triangles_that_cover_the_same_area(tmp_path):
    path = tmp_path / "quads.ply"
    path.write_text(QUADS + "4 0 1 2 3\n4 1 4 5 2\n")
    world = load_world(path)
    a, b, c = np.moveaxis(corners_of(world), 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    np.testing.assert_allclose(areas, 0.5)
    assert len(areas) == 4
    at_last = np.abs(corners_of(world) - [2, 1, 0]).max(axis=-1) < 1e-9
    assert at_last.any()
    for color in world.face_color[at_last]:
        np.testing.assert_allclose(color * 255, [40, 50, 60], atol=1e-4)


def test_a_polygon_beside_a_triangle(tmp_path):
    path = tmp_path / "mixed.ply"
    path.write_text(QUADS + "5 0 1 5 2 3\n3 1 4 5\n")
    assert len(load_world(path).faces) == 4


def glb_with(path, edit):
    """Rewrites the JSON of a GLB."""
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    tree = json.loads(data[20 : 20 + length])
    edit(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + length :]
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def test_the_texture_transform_extension_moves_texture_coordinates(tmp_path):
    def edit(tree):
        tree["materials"][0]["name"] = "moved"
        texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        shift = {"offset": [0.25, 0.5], "scale": [2.0, 3.0], "rotation": 0.3}
        texture["extensions"] = {"KHR_texture_transform": shift}
        tree["extensionsUsed"] = ["KHR_texture_transform"]

    path = glb_with(saved(tmp_path, textured(texels()), "a.glb"), edit)
    # The standard's own formula: translation * rotation * scale, v growing downwards.
    cos, sin = np.cos(0.3), np.sin(0.3)
    down = np.stack([UV[:, 0], 1.0 - UV[:, 1]], axis=1) * [2.0, 3.0]
    u = cos * down[:, 0] + sin * down[:, 1] + 0.25
    v = -sin * down[:, 0] + cos * down[:, 1] + 0.5
    expected = np.stack([u, 1.0 - v], axis=1)[FACES]
    np.testing.assert_allclose(load_world(path).face_uv, expected, atol=1e-5)


BAD = {
    "nothing.glb": (None, ""),
    **dict.fromkeys(("a.glb", "a.ply", "a.obj", "a.off"), (b"\x00\x01this is no mesh\xff" * 9, "")),
    "empty.ply": (b"", ""),
    "none.obj": (b"# nothing\n", ""),
    "infinite.ply": (
        QUADS.replace("1 1 0 0 0 255", "nan 1 0 0 0 255") + "4 0 1 2 3\n4 1 4 5 2\n", "1 of 6 ",
    ),
    "flat.ply": (QUADS + "3 0 1 4\n3 0 0 1\n", "zero area"),
    "beyond.ply": (QUADS + "3 0 1 2\n3 0 1 9\n", ""),
    "points.ply": (trimesh.PointCloud(CORNERS).export(file_type="ply"), "4 points"),
    "points.glb": (trimesh.PointCloud(CORNERS).export(file_type="glb"), "4 points"),
    "city.ply": (trimesh.Trimesh(CORNERS * 1e6, FACES).export(file_type="ply"), "meters"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_mesh_is_named(tmp_path, name):
    data, fact = BAD[name]
    if data is not None:
        (tmp_path / name).write_bytes(data.encode() if isinstance(data, str) else data)
    with pytest.raises(ValueError, match=f"{name}.*{fact}"):
        load_world(tmp_path / name)


def test_up_must_be_an_axis(tmp_path):
    with pytest.raises(ValueError, match="up"):
        load_world(saved(tmp_path, plain(), "a.ply"), up="x")


def test_many_meshes_of_one_picture_unpack_it_once(tmp_path):
    """So that a large scene is not taken for a bomb."""
    image = Image.new("RGB", (4096, 4096))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    scene = trimesh.Scene()
    for _ in range(12):
        visual = trimesh.visual.TextureVisuals(uv=UV, material=material)
        scene.add_geometry(trimesh.Trimesh(CORNERS, FACES, visual=visual, process=False))
    world = load_world(saved(tmp_path, scene, "a.glb"))
    assert len({id(material.texture) for material in world.materials}) == 1


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda tree: tree["accessors"][0].pop("bufferView"), "buffer view"),
        (lambda tree: tree["accessors"][0].update(count=10**12), "bytes"),
        (lambda tree: tree["accessors"][0].update(bufferView=99), "99"),
        (lambda tree: tree["accessors"][0].update(count=-1), "`count` is -1"),
        (
            lambda tree: tree["meshes"][0]["primitives"][0].update(indices=99),
            "99",
        ),
    ],
)
def test_claims_of_a_glb_that_it_does_not_keep(tmp_path, edit, reason):
    path = glb_with(saved(tmp_path, plain(), "a.glb"), edit)
    with pytest.raises(ValueError, match=rf"a\.glb: .*{reason}"):
        load_world(path)


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_mesh_quantization"])
def test_meshes_packed_by_an_extension_are_named(tmp_path, name):
    corners = np.array([[0, 0, 0, 0], [32767, 0, 0, 0], [0, 32767, 0, 0]], np.int16)
    view = {"buffer": 0, "byteLength": 24, "byteStride": 8}
    if "meshopt" in name:
        view |= {"buffer": 1, "extensions": {name: {"buffer": 0, "byteLength": 24, "count": 3}}}
    tree = {
        "asset": {"version": "2.0"}, "extensionsUsed": [name], "extensionsRequired": [name],
        "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5122, "normalized": True, "count": 3,
                       "type": "VEC3"}],
        "bufferViews": [view], "buffers": [{"byteLength": 24}, {"byteLength": 24}],
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", 24, b"BIN\0") + corners.tobytes()
    path = tmp_path / "room.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    with pytest.raises(ValueError, match=rf"room\.glb.*{name}.*export"):
        load_world(path)


def test_a_splat_is_no_mesh(tmp_path):
    path = tmp_path / "point_cloud.ply"
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
        b"property float y\nproperty float z\nproperty float f_dc_0\nend_header\n" + bytes(16)
    )
    with pytest.raises(ValueError, match=r"point_cloud\.ply.*splat"):
        load_world(path)


def test_a_pointer_of_git_lfs_is_no_mesh(tmp_path):
    path = tmp_path / "room.glb"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n")
    with pytest.raises(ValueError, match="git lfs pull"):
        load_world(path)


def test_what_is_assumed_of_a_mesh_is_said(tmp_path):
    box = trimesh.creation.box(extents=[4.0, 3.0, 2.5])
    box.export(tmp_path / "gray.stl")
    size, colors = assumptions(load_world(tmp_path / "gray.stl"))
    assert "4 x 3 x 2.5 m" in size
    assert "--scale" in size
    assert "no colors" in colors
    box.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (8, 4))
    box.export(tmp_path / "colored.ply")
    assert len(assumptions(load_world(tmp_path / "colored.ply"))) == 1
