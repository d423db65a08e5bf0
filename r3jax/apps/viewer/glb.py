"""A world as a GLB file, for the browser: triangles in their own colors, without light.

glTF 2.0 (Khronos Group): one header, one chunk of JSON, one of numbers and images. Every corner of
every triangle is written by itself, as texture coordinates belong to corners here.

Shape symbols: F faces of the world; f faces of one material.
"""

import io
import json
import math
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r3jax.simulators.world import Material, World

MAX_FACES = 500_000
"""Worlds with more triangles are not sent to a browser: 72 bytes each, and more for colors."""

_FLOAT, _UNSIGNED_BYTE, _TRIANGLES = 5126, 5121, 4
_LARGEST_TEXTURE = 1024
"""Longer side of a texture [px]; larger ones are made smaller."""


@dataclass
class _File:
    """A GLB under construction."""

    parts: list[bytes] = field(default_factory=list[bytes])
    length: int = 0
    content: dict[str, list[dict[str, Any]]] = field(
        default_factory=lambda: {
            name: []
            for name in ("bufferViews", "accessors", "materials", "textures", "images", "meshes")
        }
    )

    def add(self, name: str, entry: dict[str, Any]) -> int:
        """Appends to a list of the JSON; returns the place in it."""
        self.content[name].append(entry)
        return len(self.content[name]) - 1

    def view(self, data: bytes) -> int:
        """Appends bytes, padded to four; returns the number of the view on them."""
        number = self.add(
            "bufferViews", {"buffer": 0, "byteOffset": self.length, "byteLength": len(data)}
        )
        padded = data + b"\0" * (-len(data) % 4)
        self.parts.append(padded)
        self.length += len(padded)
        return number

    def accessor(self, array: np.ndarray, kind: str, **more: Any) -> int:
        """Appends vectors, [n, 2 to 4]; returns the number of their accessor."""
        component = _UNSIGNED_BYTE if array.dtype == np.uint8 else _FLOAT
        entry = {
            "bufferView": self.view(np.ascontiguousarray(array).tobytes()),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        return self.add("accessors", entry | more)


def world_glb(world: World, top: float = math.inf) -> bytes:
    """The triangles of a world with their textures.

    Surfaces are seen from their front only.

    Args:
        world: the world.
        top: triangles that lie above this height as a whole are left out, so that one looks into
            a room from above [m].

    Raises:
        ValueError: more triangles than `MAX_FACES`.
    """
    if len(world.faces) > MAX_FACES:
        raise ValueError(
            f"the mesh has {len(world.faces)} triangles, more than the {MAX_FACES} that a "
            "browser is given"
        )
    file = _File()
    is_low = world.vertices[world.faces, 2].min(axis=1) <= top
    primitives: list[dict[str, Any]] = []
    for number, material in enumerate(world.materials):
        chosen = np.flatnonzero((world.face_material == number) & is_low)
        if len(chosen):
            attributes = _attributes(file, world, chosen)
            primitives.append(
                {
                    "attributes": attributes,
                    "material": _material(file, material),
                    "mode": _TRIANGLES,
                }
            )
    if primitives:  # a mesh without any would be no valid glTF
        file.add("meshes", {"primitives": primitives})
    return _packed(file)


def _attributes(file: _File, world: World, chosen: np.ndarray) -> dict[str, int]:
    """Positions, texture coordinates and colors of the corners of some faces."""
    corners = world.vertices[world.faces[chosen]].reshape(-1, 3).astype("<f4")
    uv = world.face_uv[chosen].reshape(-1, 2).astype("<f4")
    uv[:, 1] = 1.0 - uv[:, 1]  # glTF counts v from the first row
    low, high = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    attributes = {
        "POSITION": file.accessor(corners, "VEC3", min=low, max=high),
        "TEXCOORD_0": file.accessor(uv, "VEC2"),
    }
    if world.face_color is not None:
        rgb = world.face_color[chosen].reshape(-1, 3).astype(np.float64).clip(0.0, 1.0)
        linear = np.concatenate([_linear(rgb), np.ones((len(rgb), 1))], axis=1)
        attributes["COLOR_0"] = file.accessor(
            np.rint(linear * 255.0).astype(np.uint8), "VEC4", normalized=True
        )
    return attributes


def _material(file: _File, material: Material) -> int:
    color = _linear(np.asarray(material.color, dtype=np.float64)).tolist()
    surface: dict[str, Any] = {
        "baseColorFactor": [*color, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0,
    }
    if material.texture is not None:
        image = file.add(
            "images", {"bufferView": file.view(_jpeg(material.texture)), "mimeType": "image/jpeg"}
        )
        surface["baseColorTexture"] = {"index": file.add("textures", {"source": image})}
    unlit = {"KHR_materials_unlit": {}}
    return file.add("materials", {"pbrMetallicRoughness": surface, "extensions": unlit})


def _linear(encoded: np.ndarray) -> np.ndarray:
    """Light of sRGB-encoded colors: glTF's factors are linear, textures are not."""
    low = encoded / 12.92
    return np.where(encoded <= 0.04045, low, ((encoded + 0.055) / 1.055) ** 2.4)


def _jpeg(texture: np.ndarray) -> bytes:
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(texture))
    image.thumbnail((_LARGEST_TEXTURE, _LARGEST_TEXTURE))
    buffer = io.BytesIO()
    image.save(buffer, format="jpeg", quality=88, subsampling=0)
    return buffer.getvalue()


def _packed(file: _File) -> bytes:
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "r3jax"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}] if file.content["meshes"] else [{}],
        "buffers": [{"byteLength": max(file.length, 4)}],
        **{name: entries for name, entries in file.content.items() if entries},
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(file.parts) or b"\0\0\0\0"
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
