"""Scenes to be damaged: GLB, glTF with its buffers and textures, PLY, OBJ with its materials."""

import base64
import io
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from r3jax.geometry.cameras import Camera
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_world
from tests.fuzz.mutations import zipped
from tests.fuzz.tree import Fifo, Files
from tests.simulators.rooms import box_quads, world_of

NAMES = ("scene.glb", "scene.gltf", "scene.ply", "scene.obj", "scene.stl", "scene.off", "scene.zip")


def room(*, textured: bool) -> trimesh.Trimesh:
    """A box from within, plain vertex colors or a texture."""
    box = trimesh.creation.box(extents=(4.0, 4.0, 3.0))
    box.invert()
    rng = np.random.default_rng(0)
    if textured:
        texels = rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)
        material = trimesh.visual.material.PBRMaterial(
            name="paint", baseColorTexture=Image.fromarray(texels)
        )
        uv = rng.random((len(box.vertices), 2))
        box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    else:
        box.visual.vertex_colors = rng.integers(0, 256, (len(box.vertices), 4), dtype=np.uint8)
    return box


def seeds() -> list[Files]:
    # Numba unpickles its own machine code, which the guard would lay at the reader's door.
    walls = world_of(box_quads((-2, -2, -1.5), (2, 2, 1.5), inward=True))
    RaycastSimulator(walls, Camera.from_fov(6, 4, 90.0), supersample=0).render(np.eye(4))
    painted, colored = room(textured=True), room(textured=False)
    pair = trimesh.Scene({"a": painted, "b": colored})
    gltf = trimesh.exchange.gltf.export_gltf(pair)
    text, parts = trimesh.exchange.obj.export_obj(painted, return_texture=True)
    ascii_ply = trimesh.exchange.ply.export_ply(colored, encoding="ascii")
    return [
        {"scene.glb": trimesh.exchange.gltf.export_glb(pair)},
        {"scene.glb": trimesh.exchange.gltf.export_glb(painted.scene(), tree_postprocessor=move)},
        {name.replace("model.gltf", "scene.gltf"): data for name, data in gltf.items()},
        {"scene.ply": trimesh.exchange.ply.export_ply(colored)},
        {"scene.ply": ascii_ply},
        {"scene.obj": text.encode()} | {name: as_bytes(data) for name, data in parts.items()},
        {"scene.obj": trimesh.exchange.obj.export_obj(colored).encode()},
        {"scene.stl": trimesh.exchange.stl.export_stl(colored)},
        {"scene.off": trimesh.exchange.off.export_off(colored).encode()},
    ]


def move(tree: dict[str, Any]) -> None:
    """Adds a texture transform."""
    texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    shift = {"offset": [0.25, 0.5], "scale": [2.0, 3.0], "rotation": 0.3}
    texture["extensions"] = {"KHR_texture_transform": shift}


def as_bytes(part: object) -> bytes:
    """A material or texture as exporters hand it over."""
    if isinstance(part, bytes):
        return part
    if isinstance(part, str):
        return part.encode()
    buffer = io.BytesIO()
    assert isinstance(part, Image.Image)
    part.save(buffer, format="png")
    return buffer.getvalue()


def read(folder: Path) -> None:
    name = next((name for name in NAMES if (folder / name).exists()), NAMES[0])
    world = open_world(f"mesh:{folder / name}")
    num_faces = len(world.faces)
    assert np.isfinite(world.vertices).all()
    assert 0 <= world.faces.min() <= world.faces.max() < len(world.vertices)
    assert 0 <= world.face_material.min() <= world.face_material.max() < len(world.materials)
    assert world.face_uv.shape == (num_faces, 3, 2)
    assert np.isfinite(world.face_uv).all()
    if world.face_color is not None:
        assert world.face_color.shape == (num_faces, 3, 3)
        assert ((world.face_color >= 0.0) & (world.face_color <= 1.0)).all()
    for material in world.materials:
        assert all(0.0 <= x <= 1.0 for x in material.color)
        assert material.texture is None or material.texture.size > 0
    # The ray caster's search tree is native code: what is accepted must not bring it down.
    simulator = RaycastSimulator(world, Camera.from_fov(6, 4, 90.0), supersample=0)
    frame = simulator.render(np.eye(4))
    assert np.isfinite(frame.rgb).all()
    assert not np.isnan(frame.depth).any()


def edited(edit: Callable[[dict[str, Any]], None]) -> bytes:
    """A GLB whose scene graph was edited."""
    return trimesh.exchange.gltf.export_glb(room(textured=True).scene(), tree_postprocessor=edit)


def in_a_circle(tree: dict[str, Any]) -> None:
    tree["nodes"] = [{"children": [1], "mesh": 0}, {"children": [0], "mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]


def doubling(tree: dict[str, Any]) -> None:
    """Twenty levels, each with its successor twice: a million rooms if it is unpacked."""
    tree["nodes"] = [{"children": [i + 1, i + 1]} for i in range(20)] + [{"mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]


def deep(tree: dict[str, Any]) -> None:
    tree["nodes"] = [{"children": [i + 1]} for i in range(2_000)] + [{"mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]


def repeating(tree: dict[str, Any]) -> None:
    tree["nodes"] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(3_000)]
    tree["scenes"] = [{"nodes": list(range(3_000))}]


def unfinished(tree: dict[str, Any]) -> None:
    tree["nodes"] = [{"mesh": 0, "matrix": [1e308] * 16}]
    tree["scenes"] = [{"nodes": [0]}]


GRAPHS = (in_a_circle, doubling, deep, repeating, unfinished)
NAMES_ELSEWHERE = ("../outside/secret", "/dev/zero", "pipe", "nothing.png", "../../../etc/passwd")


def crafted() -> list[Files]:
    """Cases that chance does not find."""
    cases: list[Files] = [{"scene.glb": edited(edit)} for edit in GRAPHS]
    obj = next(files for files in seeds() if "scene.obj" in files and len(files) > 1)
    material = next(name for name in obj if name.endswith(".mtl"))
    for name in NAMES_ELSEWHERE:
        cases.append(obj | {material: b"newmtl m\nmap_Kd " + name.encode() + b"\n", "pipe": Fifo()})
    counts = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n"
    fields = b"".join(b"property float %c\n" % axis for axis in b"xyz")
    lists = b"element face 4000000000\nproperty list uint int vertex_indices\nend_header\n"
    cases.append({"scene.ply": counts + fields + lists + bytes(64)})
    cases.append({"scene.zip": zipped({"scene.ply": seeds()[3]["scene.ply"]})})
    return cases


def glb(tree: dict[str, Any], stored: bytes = b"") -> bytes:
    """A GLB of a tree and one buffer."""
    text = json.dumps({"asset": {"version": "2.0"}, **tree}).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    if stored:
        stored += bytes(-len(stored) % 4)
        body += struct.pack("<I4s", len(stored), b"BIN\0") + stored
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def one_mesh(accessors: list[dict[str, Any]], primitives: int = 1, nodes: int = 1) -> dict:
    """The tree of a mesh with one position for each primitive."""
    return {
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * primitives}],
        "nodes": [{"mesh": 0}] * nodes,
        "scenes": [{"nodes": list(range(nodes))}],
    }


def points(count: int, **fields: Any) -> dict[str, Any]:
    return {"componentType": 5126, "type": "VEC3", "count": count, **fields}


def bombs() -> list[Files]:
    """Small files that would unpack to gigabytes."""
    return [{f"scene.{kind}": data} for kind, data in _bombs()]


def _bombs() -> Iterator[tuple[str, bytes]]:
    """Files that repeat what they store, or claim what they do not."""
    rng = np.random.default_rng(0)
    million = rng.normal(size=(29_997, 9)).astype("<f4").tobytes()[:1_079_892]
    count, size = len(million) // 36 * 3, len(million)
    buffer: dict[str, Any] = {"buffers": [{"byteLength": size}]}
    view = {"buffer": 0, "byteLength": size}
    one = {**buffer, "bufferViews": [view]}
    named = points(count, bufferView=0)
    yield "glb", glb(one_mesh([points(30_000_000)]) | {"bufferViews": []})
    yield "glb", glb(one_mesh([points(1 << 40)]) | one, million)
    yield "glb", glb(one_mesh([points(1 << 40, bufferView=0)]) | one, million)
    yield "glb", glb(one_mesh([named], primitives=200) | one, million)
    yield "glb", glb(one_mesh([named], primitives=30_000) | one, million)
    yield "glb", glb(one_mesh([named], nodes=2_000) | one, million)
    yield "glb", glb(one_mesh([named] * 3_000) | one, million)
    yield "glb", glb(one_mesh([named]) | buffer | {"bufferViews": [view] * 3_000}, million)
    dense = {**buffer, "bufferViews": [view | {"byteStride": 1}]}
    yield "glb", glb(one_mesh([points(size - 64, bufferView=0, type="MAT4")] * 20) | dense, million)
    indexed = one_mesh([points(3, bufferView=0), {**named, "type": "SCALAR", "count": size}])
    indexed["accessors"][1] |= {"componentType": 5121}
    indexed["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]
    yield "glb", glb(indexed | one, bytes(size))
    sparse = {"count": 1, "indices": {"bufferView": 0}, "values": {"bufferView": 0}}
    yield "glb", glb(one_mesh([points(1 << 30, sparse=sparse)]) | one, million)
    yield "glb", glb(one_mesh([points(3, bufferView=0)], primitives=33_000) | one, million)
    uri = "data:application/octet-stream;base64," + base64.b64encode(million).decode()
    inline = {"buffers": [{"byteLength": size, "uri": uri}], "bufferViews": [view] * 3_000}
    yield "gltf", json.dumps({**one_mesh([named]), **inline}).encode()
    itself = {"buffers": [{"byteLength": size, "uri": "scene.gltf"}] * 2_000}
    padding = {"extras": "x" * size}
    yield (
        "gltf",
        json.dumps({**one_mesh([named]), "bufferViews": [view], **itself, **padding}).encode(),
    )
    corners = b"".join(b"v %d %d 0\n" % (i % 100, i // 100) for i in range(30_000))
    groups = b"".join(b"usemtl m%d\nf 1 2 %d\n" % (i, i + 3) for i in range(200))
    yield "obj", corners + groups
    yield "obj", corners + b"f" + b"".join(b" %d" % (i + 1) for i in range(30_000)) + b"\n"
    text = b"ply\nformat ascii 1.0\nelement vertex 3000000000\nproperty float x\nproperty float y\n"
    faces = b"element face 3000000000\nproperty list uchar int vertex_indices\nend_header\n"
    yield "ply", text + b"property float z\n" + faces + b"0 0 0\n" * 300_000
    yield "off", b"OFF\n3000000000 3000000000 0\n" + b"0 0 0\n" * 300_000
    yield "stl", bytes(80) + struct.pack("<I", 0xFFFFFFFF) + bytes(1_000_000)
    yield "stl", b"solid a\n" + b"vertex 0 0 0\n" * 150_000 + b"endsolid a\n"
