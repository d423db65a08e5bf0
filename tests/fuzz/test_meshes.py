"""Damaged scenes: GLB, glTF with its buffers and textures, PLY, OBJ with its materials.

All 2,000 cases: `pytest -m slow tests/fuzz/test_meshes.py`.
"""

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from r3jax.scenes.registry import open_world
from tests.fuzz.referee import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

CASES = 900
"""In the normal suite."""

NAMES = ("scene.glb", "scene.gltf", "scene.ply", "scene.obj", "scene.stl", "scene.off")


def room(*, textured: bool) -> trimesh.Trimesh:
    """A box from within, plain vertex colours or a texture."""
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
    painted, colored = room(textured=True), room(textured=False)
    pair = trimesh.Scene({"a": painted, "b": colored})
    gltf = trimesh.exchange.gltf.export_gltf(pair)
    text, parts = trimesh.exchange.obj.export_obj(painted, return_texture=True)
    ascii_ply = trimesh.exchange.ply.export_ply(colored, encoding="ascii")
    return [
        {"scene.glb": trimesh.exchange.gltf.export_glb(pair)},
        {"scene.glb": trimesh.exchange.gltf.export_glb(trimesh.Scene(painted))},
        {name.replace("model.gltf", "scene.gltf"): data for name, data in gltf.items()},
        {"scene.ply": trimesh.exchange.ply.export_ply(colored)},
        {"scene.ply": ascii_ply},
        {"scene.obj": text.encode()} | {name: as_bytes(data) for name, data in parts.items()},
        {"scene.obj": trimesh.exchange.obj.export_obj(colored).encode()},
        {"scene.stl": trimesh.exchange.stl.export_stl(colored)},
        {"scene.off": trimesh.exchange.off.export_off(colored).encode()},
    ]


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
    assert b"none of your business" not in b"".join(
        m.texture.tobytes() for m in world.materials if m.texture is not None
    )


READER = Reader(seeds, read, (ValueError,))


def test_damaged_meshes_are_refused_or_read(referee):
    referee.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_meshes(referee):
    """`pytest -m slow tests/fuzz/test_meshes.py`."""
    referee.check(__name__, CASES_SLOW)
