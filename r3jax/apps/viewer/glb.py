"""A world as a GLB file, for the browser: triangles in their own colors, without light.

Every corner of every triangle is written by itself, as texture coordinates belong to corners here.

Shape symbols: F faces of the world; f faces of one material.
"""

import math
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from r3jax.apps.viewer.color_maps import linear_light
from r3jax.errors import InputError
from r3jax.simulators.world import Material, World

MAX_FACES = 500_000
"""Worlds with more triangles are not sent to a browser: 72 bytes each, and more for colors."""

_LARGEST_TEXTURE = 1024
"""Longer side of a texture [px]; larger ones are made smaller."""


def world_glb(world: World, top: float = math.inf) -> bytes:
    """Writes the triangles of a world with their textures.

    Surfaces are seen from their front only.

    Args:
        world: the world.
        top: triangles that lie above this height as a whole are left out, so that one looks into
            a room from above [m].

    Raises:
        ValueError: more triangles than `MAX_FACES`.
    """
    if len(world.faces) > MAX_FACES:
        raise InputError(
            f"the mesh has {len(world.faces)} triangles, more than the {MAX_FACES} that a "
            "browser is given"
        )
    is_low = world.vertices[world.faces, 2].min(axis=1) <= top
    scene = trimesh.Scene()
    for number, material in enumerate(world.materials):
        chosen = np.flatnonzero((world.face_material == number) & is_low)
        if len(chosen):
            scene.add_geometry(_mesh(world, chosen, material))
    return export_glb(scene, include_normals=False, tree_postprocessor=_without_light)


def _mesh(world: World, chosen: np.ndarray, material: Material) -> trimesh.Trimesh:
    """Returns some faces, all of one material."""
    corners = world.vertices[world.faces[chosen]].reshape(-1, 3)
    uv = world.face_uv[chosen].reshape(-1, 2)
    visual = TextureVisuals(uv, material=_pbr(material))
    if world.face_color is not None:
        rgb = world.face_color[chosen].reshape(-1, 3).astype(np.float64).clip(0.0, 1.0)
        linear = np.concatenate([linear_light(rgb), np.ones((len(rgb), 1))], axis=1)
        visual.vertex_attributes["color"] = np.rint(linear * 255.0).astype(np.uint8)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(corners, faces, visual=visual, process=False)


def _pbr(material: Material) -> PBRMaterial:
    color = linear_light(np.asarray(material.color, dtype=np.float64))
    texture = None
    if material.texture is not None:
        texture = _Jpeg.of(material.texture)
    return PBRMaterial(
        baseColorFactor=[*color, 1.0],
        baseColorTexture=texture,
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )


class _Jpeg(Image.Image):
    """A texture that trimesh stores as JPEG: a PNG takes ten times the bytes."""

    format = "JPEG"

    @classmethod
    def of(cls, pixels: np.ndarray) -> "_Jpeg":
        """Makes it of [H, W, 3] uint8."""
        image = Image.fromarray(np.ascontiguousarray(pixels))
        image.thumbnail((_LARGEST_TEXTURE, _LARGEST_TEXTURE))
        texture = cls()
        texture.im, texture._mode, texture._size = image.im, image.mode, image.size
        return texture

    def save(self, fp: Any, format: str | None = None, **params: Any) -> None:
        """Keeps edges of color, which Pillow's own settings for JPEG smear."""
        super().save(fp, format, quality=88, subsampling=0)


def _without_light(tree: dict[str, Any]) -> None:
    """Colors are shown as they are: the world's own pictures hold its light."""
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for material in tree.get("materials", ()):
        material["extensions"] = {"KHR_materials_unlit": {}}
