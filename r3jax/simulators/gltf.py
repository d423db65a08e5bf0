"""What trimesh leaves out of glTF files: the texture transforms of KHR_texture_transform."""

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.foreign.errors import ForeignFileError
from r3jax.foreign.fields import check_type
from r3jax.foreign.json_text import parse_json

_MAX_JSON = 256 << 20
"""Larger trees are cut off, and refused as such [bytes]."""

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

    Raises:
        ForeignFileError: the JSON of the file is damaged, or a transform has no numbers.
    """
    moves: dict[str, np.ndarray] = {}
    tree = _read_tree(path)
    check_type("glTF", tree, dict[str, Any])
    for material in _part(tree, "materials", list[dict[str, Any]], []):
        surface = _part(material, "pbrMetallicRoughness", dict[str, Any], {})
        texture = _part(surface, "baseColorTexture", dict[str, Any], {})
        settings = _part(texture, "extensions", dict[str, Any], {}).get(_EXTENSION)
        if settings is not None and "name" in material:
            check_type(_EXTENSION, settings, dict[str, Any])
            moves[_part(material, "name", str, "")] = _affine(settings)
    return moves


def _part(tree: dict[str, Any], name: str, kind: Any, default: Any) -> Any:
    """An optional entry of the tree, with its type checked."""
    value = tree.get(name, default)
    check_type(name, value, kind)
    return value


def _affine(settings: dict[str, Any]) -> np.ndarray:
    """The map of one material, [3, 3]."""
    offset = _part(settings, "offset", list[float], [0.0, 0.0])
    scale = _part(settings, "scale", list[float], [1.0, 1.0])
    angle = _part(settings, "rotation", float, 0.0)
    if len(offset) != 2 or len(scale) != 2:
        raise ForeignFileError(f"{_EXTENSION} has an offset or a scale that is not two numbers")
    cos, sin = math.cos(angle), math.sin(angle)
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
    with open(path, "rb") as file:
        head = file.read(20)
        if head[:4] != b"glTF":
            file.seek(0)
            return parse_json(file.read(_MAX_JSON))
        (length,) = struct.unpack("<I", head[12:16])
        return parse_json(file.read(min(length, _MAX_JSON)))
