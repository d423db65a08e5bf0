"""Damaged scenes: GLB, glTF with its buffers and textures, PLY, OBJ with its materials.

All 2,000 cases: `pytest -m slow tests/fuzz/test_meshes.py`.
"""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from r3jax.geometry.cameras import Camera
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_world
from tests.fuzz.containers import zipped
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Fifo, Files
from tests.fuzz.worker import Reader
from tests.simulators.rooms import box_quads, world_of

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""

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


READER = Reader(seeds, read, (ValueError,))


def test_damaged_meshes_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_meshes(harness):
    """`pytest -m slow tests/fuzz/test_meshes.py`."""
    harness.check(__name__, CASES_SLOW)


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


def crafted() -> dict[str, Files]:
    """Cases that chance does not find."""
    cases: dict[str, Files] = {edit.__name__: {"scene.glb": edited(edit)} for edit in GRAPHS}
    obj = next(files for files in seeds() if "scene.obj" in files and len(files) > 1)
    material = next(name for name in obj if name.endswith(".mtl"))
    for name in NAMES_ELSEWHERE:
        cases[f"texture {name}"] = obj | {
            material: b"newmtl m\nmap_Kd " + name.encode() + b"\n",
            "pipe": Fifo(),
        }
    counts = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n"
    fields = b"".join(b"property float %c\n" % axis for axis in b"xyz")
    lists = b"element face 4000000000\nproperty list uint int vertex_indices\nend_header\n"
    cases["counts"] = {"scene.ply": counts + fields + lists + bytes(64)}
    cases["archive"] = {"scene.zip": zipped({"scene.ply": seeds()[3]["scene.ply"]})}
    return cases


CRAFTED = Reader(lambda: list(crafted().values()), read, (ValueError,))


def test_crafted_meshes_are_refused_or_read(harness):
    harness.check_crafted(f"{__name__}:CRAFTED")
