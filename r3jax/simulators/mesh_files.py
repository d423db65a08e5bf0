"""Mesh files through trimesh, with limits: what a file names and claims is checked first.

A mesh may name buffers, materials and images. Only regular files below its own folder are read,
no image is unpacked before its size is known, and archives are not opened at all. Of glTF files
the tree of JSON is read beside trimesh, for what it leaves out: texture transforms, and doubts
about sizes that a file claims.
"""

import math
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular
from r3jax.validation.json_text import check_type, parse_json

_MAX_JSON = 256 << 20
"""Larger trees are cut off, and refused as such [bytes]."""

_EXTENSION = "KHR_texture_transform"

_PACKED = {"EXT_meshopt_compression", "KHR_draco_mesh_compression", "KHR_mesh_quantization"}
"""Extensions without which the numbers of a mesh cannot be read; trimesh passes over the last."""

_NUMBER_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
"""Bytes of a number by glTF's `componentType`."""

_ROW_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Numbers in a row by glTF's `type`."""

_FEW = 1 << 23
"""Files that name no more numbers, repeated ones counted, are never bombs."""

_MAX_REPEATS = 4
"""How often a larger file may name what it stores, on average."""

_MAX_PRIMITIVES = 1 << 15
"""Meshes in a file; trimesh takes a millisecond for each, however small."""

_LINES = (1, 2, 3)
"""The `mode` of lines, loops and strips of them."""

_STRIP = 5
"""The `mode` of triangle strips: nearly every index of them begins a triangle of its own."""


def check_claims(path: Path, tree: dict[str, Any]) -> None:
    """Refuses a glTF file that claims, or repeats, far more than it stores.

    Memory is allocated for what is claimed, for every primitive.

    Args:
        path: the file; its buffers lie in it or beside it.
        tree: its JSON.

    Raises:
        ForeignFileError: an accessor that reaches beyond its buffer view or has none; views,
            accessors or primitives that name the same bytes again and again; fields that are
            missing or of another type.
    """
    stored = _stored(path, tree)
    views = _part(tree, "bufferViews", list[dict[str, Any]], [])
    lengths = [_whole(view, "byteLength") for view in views]
    _check_sum("buffer views", [(length, length) for length in lengths], stored)
    accessors = _part(tree, "accessors", list[dict[str, Any]], [])
    sizes = [_accessor_size(i, a, views, lengths) for i, a in enumerate(accessors)]
    _check_sum("accessors", sizes, stored)
    named: list[tuple[int, int]] = []
    primitives = 0
    for mesh in _part(tree, "meshes", list[dict[str, Any]], []):
        for primitive in _part(mesh, "primitives", list[dict[str, Any]], []):
            primitives += 1
            attributes = _part(primitive, "attributes", dict[str, int], {})
            used = [_at(sizes, i, "accessor") for i in attributes.values()]
            if "indices" in primitive:
                numbers, held = _at(sizes, _whole(primitive, "indices"), "accessor")
                expanded = 3 if primitive.get("mode") == _STRIP else 1
                used.append((expanded * numbers, expanded * held))
            named += used
    if primitives > _MAX_PRIMITIVES:
        raise ForeignFileError(f"it holds {primitives} meshes: join those of one material first")
    _check_sum("meshes", named, stored)


def _stored(path: Path, tree: dict[str, Any]) -> int:
    """Returns bytes of a file and of those beside it that its buffers name, each once."""
    names = {
        _part(buffer, "uri", str, "") for buffer in _part(tree, "buffers", list[dict[str, Any]], [])
    }
    stored = check_regular(path)
    for name in names:
        if name and not name.startswith("data:"):
            try:
                stored += check_regular(path.parent / urllib.parse.unquote(name))
            except (OSError, ForeignFileError):
                continue  # opening it reports what is wrong with it
    return stored


def _accessor_size(
    number: int, accessor: dict[str, Any], views: list[dict[str, Any]], lengths: list[int]
) -> tuple[int, int]:
    """Returns numbers in an accessor, and their bytes."""
    if "bufferView" not in accessor or "sparse" in accessor:
        raise ForeignFileError(
            f"accessor {number} has no buffer view of its own: compressed and sparse meshes are "
            "not read; export it without compression (Draco, meshopt)"
        )
    which, count = _whole(accessor, "bufferView"), _whole(accessor, "count")
    length = _at(lengths, which, "buffer view")
    bytes_each = _NUMBER_BYTES.get(_part(accessor, "componentType", int, 0))
    per_row = _ROW_NUMBERS.get(_part(accessor, "type", str, ""))
    if bytes_each is None or per_row is None:
        raise ForeignFileError(f"accessor {number} is of a type that glTF does not have")
    row = bytes_each * per_row
    stride = _whole(views[which], "byteStride", row)
    needed = _whole(accessor, "byteOffset", 0) + (count - 1) * stride + row
    if count and needed > length:
        raise ForeignFileError(
            f"accessor {number} claims {needed} bytes of a buffer view that has {length}: is the "
            "file cut off?"
        )
    return count * per_row, count * row


def _check_sum(what: str, sizes: list[tuple[int, int]], stored: int) -> None:
    """Refuses parts, (numbers, bytes) each, that are together far more than what is stored."""
    numbers, held = (sum(column) for column in zip(*sizes, strict=True)) if sizes else (0, 0)
    if numbers > _FEW and held > _MAX_REPEATS * stored:
        raise ForeignFileError(
            f"its {what} name {held} bytes, but only {stored} are stored: it repeats itself, and "
            "is not unpacked"
        )


def _at(items: list[Any], index: int, what: str) -> Any:
    if not 0 <= index < len(items):
        raise ForeignFileError(f"there is no {what} {index}, only {len(items)}")
    return items[index]


def _whole(tree: dict[str, Any], name: str, default: int | None = None) -> int:
    """Returns an entry that is a whole number >= 0."""
    value = tree.get(name, default)
    check_type(name, value, int)
    if value < 0:
        raise ForeignFileError(f"`{name}` is {value}")
    return value


def _check_extensions(tree: dict[str, Any]) -> None:
    """Refuses meshes that are packed, or whose numbers mean something else, by an extension."""
    required = _part(tree, "extensionsRequired", list[str], [])
    found = sorted(_PACKED & set(required))
    if found:
        raise ForeignFileError(
            f"its meshes are stored by {', '.join(found)}, which is not read: export it without "
            "compression and quantization (gltfpack: without -c, with -noq)"
        )


def num_lines(tree: dict[str, Any]) -> int:
    """Returns primitives that are lines: of a tree that `check_claims` let through."""
    meshes = _part(tree, "meshes", list[dict[str, Any]], [])
    modes = [primitive.get("mode") for mesh in meshes for primitive in mesh.get("primitives", [])]
    return sum(mode in _LINES for mode in modes)


def texture_transforms(tree: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns how each material of a glTF file moves the texture coordinates of its base color.

    The extension is defined by the Khronos group: uv' = translation * rotation * scale * uv, in
    glTF's own coordinates, where v grows downwards.

    Args:
        tree: the JSON of the file.

    Returns:
        By the material's name: the affine map [3, 3] of (u, v, 1), with v growing upwards. Only
        materials that move anything are listed.

    Raises:
        ForeignFileError: fields of another type, or a transform has no numbers.
    """
    moves: dict[str, np.ndarray] = {}
    for material in _part(tree, "materials", list[dict[str, Any]], []):
        surface = _part(material, "pbrMetallicRoughness", dict[str, Any], {})
        texture = _part(surface, "baseColorTexture", dict[str, Any], {})
        settings = _part(texture, "extensions", dict[str, Any], {}).get(_EXTENSION)
        if settings is not None and "name" in material:
            check_type(_EXTENSION, settings, dict[str, Any])
            moves[_part(material, "name", str, "")] = _affine(settings)
    return moves


def _part(tree: dict[str, Any], name: str, kind: Any, default: Any) -> Any:
    """Returns an optional entry of the tree, with its type checked."""
    value = tree.get(name, default)
    check_type(name, value, kind)
    return value


def _affine(settings: dict[str, Any]) -> np.ndarray:
    """Returns the map of one material, [3, 3]."""
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


def read_tree(path: Path) -> dict[str, Any]:
    """Returns the JSON of a `.glb` or `.gltf` file.

    Of a GLB it is the first chunk, behind 20 bytes.

    Raises:
        ForeignFileError: a chunk that is longer than the file; no JSON, or none of a glTF file.
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        head = file.read(20)
        if head[:4] == b"glTF" and len(head) == 20:
            _check_chunks(path)
            (length,) = struct.unpack("<I", head[12:16])
            tree = parse_json(file.read(min(length, _MAX_JSON)))
        else:
            file.seek(0)
            tree = parse_json(file.read(_MAX_JSON))
    check_type("glTF", tree, dict[str, Any])
    return tree


def _check_chunks(path: Path) -> None:
    """Refuses a GLB whose chunks claim to be longer than it: room is made for what is claimed."""
    size = check_regular(path)
    with open(path, "rb") as file:
        at = 12  # behind the header
        while at + 8 <= size:
            file.seek(at)
            (length,) = struct.unpack("<I", file.read(4))
            at += 8 + length
    if at > size:
        raise ForeignFileError("it is cut off: a chunk is longer than what is left of the file")


SUFFIXES = (".glb", ".gltf", ".ply", ".obj", ".stl", ".off")
"""Formats that are read."""

GLTF_SUFFIXES = (".glb", ".gltf")
"""Those of glTF."""

_IMAGES = ("PNG", "JPEG", "WEBP", "BMP", "TGA")
"""Formats of textures; Pillow knows others that start programs of their own."""

_MAX_TEXELS = 1 << 26
"""Most texels of one texture: 8192 x 8192."""

_SMALL = 512 << 20
"""Textures that unpack to no more are never bombs [bytes]."""

_SQUEEZE = 200
"""Larger ones are, if they were packed tighter than this: photographs reach a tenth of it."""

_MANY_ROWS = 1 << 22
"""Meshes with no more faces and vertices, repeated ones counted, are never bombs."""

_REPEATS = 4
"""How often those of a larger mesh may be repeated on average."""


class MeshFile:
    """A mesh file and what belongs to it."""

    def __init__(self, path: Path):
        """Reads the file.

        Raises:
            ForeignFileError: another format, damaged, or it names something that is no file.
            OSError: missing, or not permitted.
        """
        if path.suffix.lower() not in SUFFIXES:
            raise ForeignFileError(
                f"{path.suffix or 'no suffix'}: is no format that is read; give a GLB, glTF, PLY, "
                "OBJ, STL or OFF file"
            )
        self._bytes = check_regular(path)
        self.texture_moves: dict[str, np.ndarray] = {}
        """How materials move their textures, see `texture_transforms`."""

        self.num_lines = 0
        """Meshes that are lines, which no ray meets."""

        if path.suffix.lower() in GLTF_SUFFIXES:
            tree = read_tree(path)
            _check_extensions(tree)
            check_claims(path, tree)
            self.texture_moves = texture_transforms(tree)
            self.num_lines = num_lines(tree)
        self._texels = 0
        self._textures: dict[int, np.ndarray] = {}
        self.scene = self._load(path)
        try:
            nodes = [self.scene.graph[node] for node in self.scene.graph.nodes_geometry]
        except Exception as error:  # a graph that is no tree
            raise ForeignFileError(f"its nodes are not a tree ({error!s:.200})") from None
        self.placed = [(np.asarray(T, dtype=np.float64), name) for T, name in nodes]
        """`T_world_node` [4, 4] and name of each mesh, as often as it occurs."""

        self._check_repeats()

    def texture(self, image: Any) -> np.ndarray:
        """Returns the texels of one of its images, [h, w, 3] uint8.

        Unpacked once, however often asked.

        Raises:
            ForeignFileError: not an image of a usual format, damaged, or far too large.
        """
        if id(image) in self._textures:  # the scene keeps its images alive
            return self._textures[id(image)]
        if image.format not in (None, *_IMAGES):
            raise ForeignFileError(f"a texture is in the format {image.format}, not {_IMAGES}")
        width, height = image.size
        self._texels += width * height
        unpacked = 3 * self._texels
        if width * height > _MAX_TEXELS or unpacked > max(_SMALL, _SQUEEZE * self._bytes):
            raise ForeignFileError(
                f"a texture of {width} x {height} texels makes {unpacked >> 20} MiB of textures "
                "out of a small file: it is not unpacked"
            )
        try:
            texels = np.array(image.convert("RGB"), dtype=np.uint8)
        except Exception as error:  # struct, zlib, syntax, overflow: every decoder has its own
            raise ForeignFileError(f"a texture cannot be read ({error!s:.200})") from None
        self._textures[id(image)] = texels
        return texels

    def _load(self, path: Path) -> Any:
        import trimesh
        from trimesh.resolvers import FilePathResolver

        refused: list[str] = []
        known: dict[str, bytes] = {}
        owner = self

        class Beside(FilePathResolver):
            """Files beside the mesh, each read once; trimesh refuses names that lead elsewhere."""

            def get(self, name: str) -> bytes:
                if name not in known:
                    known[name] = self._read(name)
                return known[name]

            def _read(self, name: str) -> bytes:
                try:
                    owner._bytes += check_regular(self.absolute(name))
                except ForeignFileError as error:  # trimesh goes on without it: we do not
                    refused.append(f"{name[:200]}: {error}")
                    raise
                except (OSError, ValueError):
                    pass  # missing: trimesh looks below other names, and says so
                return super().get(name)

        try:
            # `process=False`: merging vertices would tear texture seams.
            scene = trimesh.load_scene(path, resolver=Beside(str(path)), process=False)
        except Exception as error:  # every reader fails in its own way
            reason = refused[0] if refused else str(error) or type(error).__name__
            raise ForeignFileError(f"{reason:.500}") from error
        if refused:
            raise ForeignFileError(refused[0])
        return scene

    def _check_repeats(self) -> None:
        """A small scene graph can repeat a mesh without end."""
        rows = {name: _num_rows(mesh) for name, mesh in self.scene.geometry.items()}
        stored = sum(rows.values())
        repeated = sum(rows.get(name, 0) for _, name in self.placed)
        if repeated > max(_MANY_ROWS, _REPEATS * stored):
            raise ForeignFileError(
                f"its {stored} faces and vertices are repeated until they are {repeated}: it is "
                "not unpacked"
            )


def _num_rows(mesh: Any) -> int:
    return len(getattr(mesh, "faces", ())) + len(getattr(mesh, "vertices", ()))
