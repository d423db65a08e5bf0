"""What trimesh leaves out of glTF files: the texture transforms of KHR_texture_transform."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

_EXTENSION = "KHR_texture_transform"


def texture_transforms(path: Path) -> dict[str, np.ndarray]:
    """How each material of a glTF file moves the texture coordinates of its base colour.

    The extension is defined by the Khronos group: uv' = translation * rotation * scale * uv, in
    glTF's own coordinates, where v grows downwards.

    Args:
        path: a `.glb` or `.gltf` file that can be read as such.

    Returns:
        By the material's name: the affine map [3, 3] of (u, v, 1), with v growing upwards. Only
        materials that move anything are listed.
    """
    moves = {}
    for material in _read_tree(path).get("materials", []):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        settings = texture.get("extensions", {}).get(_EXTENSION)
        if settings is not None and "name" in material:
            moves[material["name"]] = _affine(settings)
    return moves


def _affine(settings: dict[str, Any]) -> np.ndarray:
    """The map of one material, [3, 3]."""
    offset, scale = settings.get("offset", (0.0, 0.0)), settings.get("scale", (1.0, 1.0))
    cos, sin = math.cos(settings.get("rotation", 0.0)), math.sin(settings.get("rotation", 0.0))
    downwards = np.array(
        [
            [cos * scale[0], sin * scale[1], offset[0]],
            [-sin * scale[0], cos * scale[1], offset[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    flip = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
    return flip @ downwards @ flip


def _read_tree(path: Path) -> dict[str, Any]:
    """The JSON of a glTF file; of a GLB it is the first chunk, after 20 bytes of header."""
    data = path.read_bytes()
    if data[:4] == b"glTF":
        (length,) = struct.unpack("<I", data[12:16])
        data = data[20 : 20 + length]
    return json.loads(data)
