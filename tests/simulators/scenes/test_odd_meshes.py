"""Meshes that other programs write in their own way are named as what they are."""

import json
import struct

import numpy as np
import pytest
import trimesh

from r3jax.simulators.meshes import assumptions, load_world


def glb(tree: dict, data: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


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
    path = tmp_path / "room.glb"
    path.write_bytes(glb(tree, corners.tobytes()))
    with pytest.raises(ValueError, match=rf"room\.glb.*{name}.*export"):
        load_world(path)


def test_a_splat_is_no_mesh(tmp_path):
    path = tmp_path / "point_cloud.ply"
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
        b"property float y\nproperty float z\nproperty float f_dc_0\nend_header\n" + bytes(16)
    )
    with pytest.raises(ValueError, match=r"point_cloud\.ply is a Gaussian splat.*mesh"):
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
