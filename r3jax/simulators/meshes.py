"""Mesh files as worlds: GLB, glTF, PLY, OBJ, STL and OFF.

glTF is y-up by its standard and is turned to z-up, (x, y, z) -> (x, -z, y); other formats are
taken as z-up by default. Colors are used as stored, as Habitat does without lights.
Transparency is ignored: a surface is there or it is not.

Shape symbols: V vertices; F faces.
"""

import math
import struct
import urllib.parse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.errors import InputError
from r3jax.simulators.world import Material, World
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

    Memory is allocated for the claimed size, for every primitive.

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
    """Sums the bytes of a file and of the files that its buffers name, each once."""
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
    """Counts the numbers in an accessor, and their bytes."""
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
    """Refuses parts, (numbers, bytes) each, that are together far more than the file stores."""
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
    """Reads an entry that must be a whole number >= 0."""
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
    """Counts the primitives that are lines, in a tree that passed `check_claims`."""
    meshes = _part(tree, "meshes", list[dict[str, Any]], [])
    modes = [primitive.get("mode") for mesh in meshes for primitive in mesh.get("primitives", [])]
    return sum(mode in _LINES for mode in modes)


def texture_transforms(tree: dict[str, Any]) -> dict[str, np.ndarray]:
    """Reads how each material of a glTF file moves the texture coordinates of its base color.

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
    """Reads an optional entry of the tree, and checks its type."""
    value = tree.get(name, default)
    check_type(name, value, kind)
    return value


def _affine(settings: dict[str, Any]) -> np.ndarray:
    """Computes the affine map of one material, [3, 3]."""
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
    """Reads the JSON of a `.glb` or `.gltf` file.

    In a GLB it is the first chunk, after 20 bytes.

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
    """Refuses a GLB whose chunks claim to be longer than the file: memory is allocated for them."""
    size = check_regular(path)
    with open(path, "rb") as file:
        at = 12  # behind the header
        while at + 8 <= size:
            file.seek(at)
            (length,) = struct.unpack("<I", file.read(4))
            at += 8 + length
    if at > size:
        raise ForeignFileError("truncated: a chunk is longer than the rest of the file")


SUFFIXES = (".glb", ".gltf", ".ply", ".obj", ".stl", ".off")
"""Formats that are read."""

GLTF_SUFFIXES = (".glb", ".gltf")
"""Suffixes of glTF."""

_IMAGES = ("PNG", "JPEG", "WEBP", "BMP", "TGA")
"""Formats of textures; Pillow reads others by starting external programs."""

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
        """Unpacks one of its images, [h, w, 3] uint8.

        Each image is unpacked once, and cached.

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
        """Refuses a scene graph that repeats its meshes too often."""
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


_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_PLAIN = Material(color=(0.7, 0.7, 0.7))
"""Material of a surface without any color."""

_HEADER_BYTES = 1 << 14
"""A PLY's header has some hundred bytes."""

_MAX_EXTENT = 1e5
"""Worlds larger than this are not in meters [m]."""

_MAX_UV = 1e6
"""Texture coordinates beyond this have no fraction left that could choose a texel."""


@dataclass(frozen=True)
class _Part:
    """One mesh of a file, in its place."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray  # [F, 3, 2]
    colors: np.ndarray | None  # [F, 3, 3] in [0, 1]
    material: Material


def load_world(path: str | Path, up: str | None = None, scale: float | int = 1.0) -> World:
    """Reads a mesh file.

    Textures, vertex colors, face colors, plain colors and mixtures of them are kept; the nodes
    of a scene graph are put in their places; polygons become triangles; texture coordinates
    outside [0, 1] repeat the texture.

    Args:
        path: the file.
        up: the file's vertical axis, "y" or "z"; None: y for glTF, z for everything else.
        scale: meters in a unit of the file: 0.001 for one in millimeters.

    Returns:
        The world, z up, in meters, named `mesh:<path>`.

    Raises:
        ValueError: the file is missing or cannot be read, holds no mesh or only points, has
            vertices that are not finite, or has no extent; a scale that is no positive number.
    """
    path = Path(path)
    turn = scaled_turn(path, up, scale)
    if not path.is_file():
        raise InputError(f"no such mesh file: {path} (give a GLB, glTF, PLY or OBJ file)")
    _refuse_splat(path)
    try:
        file = MeshFile(path)
        nodes = [_part_of(file, T, name) for T, name in file.placed]
    except (ForeignFileError, OSError) as error:
        raise InputError(
            f"cannot read the mesh file {path}: {error} (is it damaged, or a format other than "
            "GLB, glTF, PLY, OBJ?)"
        ) from error
    parts = [part for part in nodes if part is not None]
    if not parts:
        _refuse_empty(path, file.scene)
    world = _assemble(path, parts, turn)
    _check(path, world)
    if file.num_lines:
        world.notes["lines"] = str(file.num_lines)
    return world


def assumptions(world: World) -> list[str]:
    """Says what a mesh file does not: which unit it was read in, and that it has no colors.

    Args:
        world: of `load_world`, or any other.

    Returns:
        A sentence each; none of a world that is no mesh file.
    """
    if not world.name.startswith("mesh:"):
        return []
    size = " x ".join(f"{side:.3g}" for side in world.bounds[1] - world.bounds[0])
    found = [f"the mesh is taken as {size} m large, z up: if it is not, give --scale or --up"]
    is_even = world.face_color is None or not np.ptp(world.face_color, axis=(0, 1)).any()
    looks = {material.color for material in world.materials if material.texture is None}
    if is_even and len(looks) == 1 and all(m.texture is None for m in world.materials):
        found.append(
            "the mesh has no colors but a single one, so that pictures show neither texture nor "
            "edges: export it with vertex colors or textures"
        )
    return found


def world_from_file(path: Path, up: str | None = None) -> np.ndarray:
    """Computes the rotation [3, 3] from a mesh file's axes to the z-up world.

    Args:
        path: the file; it is not read.
        up: its vertical axis, "y" or "z"; None: y for glTF, z for everything else.

    Raises:
        ValueError: `up` is neither.
    """
    if up not in (None, "y", "z"):
        raise InputError(f"up must be 'y' or 'z', got {up!r}")
    is_gltf = path.suffix.lower() in GLTF_SUFFIXES
    return _Z_UP_FROM_Y_UP if up == "y" or (up is None and is_gltf) else np.eye(3)


def scaled_turn(path: Path, up: str | None, scale: Any) -> np.ndarray:
    """Computes `world_from_file` times the scale, [3, 3].

    Raises:
        ValueError: `up` is no axis, or `scale` no positive number.
    """
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0.0 < scale < math.inf:
        raise InputError(f"scale must be a number > 0, the meters in a unit, got {scale!r}")
    return scale * world_from_file(path, up)


def _refuse_splat(path: Path) -> None:
    """Refuses a PLY of Gaussians, which trimesh takes for a cloud of points."""
    if path.suffix.lower() != ".ply":
        return
    with open(path, "rb") as file:
        header = file.read(_HEADER_BYTES).partition(b"end_header")[0]
    if b" f_dc_0" in header or b" packed_position" in header:
        raise InputError(
            f"{path} is a Gaussian splat and no mesh: it has no surfaces to look at; give the mesh "
            "of the place, or export one (2D Gaussian splatting and SuGaR write meshes)"
        )


def _refuse_empty(path: Path, scene: Any) -> None:
    """Refuses a scene without surfaces, with the reason."""
    points = sum(len(getattr(g, "vertices", ())) for g in scene.geometry.values())
    if points:
        raise InputError(
            f"{path} has {points} points but no faces: a point cloud cannot be ray cast; "
            "reconstruct a surface first (for example Poisson reconstruction)"
        )
    raise InputError(f"{path} holds an empty mesh: no vertices, no faces; export it again")


def _part_of(file: MeshFile, T: np.ndarray, name: str) -> _Part | None:
    """Places a mesh by `T_world_node`; None for points, lines and empty meshes.

    Raises:
        ForeignFileError: faces that name no vertex, or a texture that cannot be read.
    """
    mesh = file.scene.geometry[name]
    faces = np.asarray(getattr(mesh, "faces", ()), dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        return None
    if np.shape(mesh.vertices)[1:] != (3,):
        raise ForeignFileError(f"the vertices of {name!r} have the shape {mesh.vertices.shape}")
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise ForeignFileError(
            f"a face of {name!r} names vertex {faces.max()}, but there are only "
            f"{len(mesh.vertices)}"
        )
    vertices = np.asarray(mesh.vertices, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
    uv, colors, material = _appearance(file, mesh, faces)
    material_name = str(getattr(getattr(mesh.visual, "material", None), "name", ""))
    move = file.texture_moves.get(material_name)
    if move is not None:
        uv = uv @ move[:2, :2].T + move[:2, 2]
    if np.linalg.det(T[:3, :3]) < 0.0:  # a mirrored node: keep the front faces in front
        faces, uv = faces[:, ::-1], uv[:, ::-1]
        colors = None if colors is None else colors[:, ::-1]
    return _Part(vertices, faces, uv, colors, material)


def _appearance(
    file: MeshFile, mesh: Any, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, Material]:
    """Reads the texture coordinates and colors per corner, and the material."""
    visual = mesh.visual
    no_uv = np.zeros((len(faces), 3, 2), np.float32)
    kind = getattr(visual, "kind", None)
    if kind == "vertex":
        return no_uv, _as_unit(visual.vertex_colors)[faces], Material()
    if kind == "face":
        per_face = _as_unit(visual.face_colors)
        return no_uv, np.repeat(per_face[:, None], 3, axis=1), Material()
    if kind != "texture" and not hasattr(visual, "material"):
        return no_uv, None, _PLAIN
    uv = getattr(visual, "uv", None)
    has_uv = uv is not None and np.shape(uv) == (len(mesh.vertices), 2)
    material = _material(file, visual.material, has_uv=has_uv)
    colors = getattr(visual, "vertex_attributes", {}).get("color")
    if colors is not None and len(colors) == len(mesh.vertices):
        colors = _as_unit(colors)[faces]
    else:
        colors = None
    corner_uv = np.asarray(uv, dtype=np.float32)[faces] if has_uv else no_uv
    return corner_uv, colors, material


def _material(file: MeshFile, source: Any, *, has_uv: bool) -> Material:
    """Converts a trimesh material to ours. The texture keeps its size."""
    if hasattr(source, "baseColorFactor"):
        image, factor = source.baseColorTexture, source.baseColorFactor
    else:
        image, factor = getattr(source, "image", None), getattr(source, "diffuse", None)
        if image is not None and has_uv:
            # Exporters write any diffuse color beside a texture; viewers show the texture.
            factor = None
    texture = None
    if image is not None and has_uv:
        texture = file.texture(image)
    if factor is None:
        return Material(texture=texture)
    red, green, blue = (float(x) for x in _as_unit(np.asarray(factor).reshape(1, -1))[0])
    return Material(texture=texture, color=(red, green, blue))


def _as_unit(colors: np.ndarray) -> np.ndarray:
    """Converts colors [n, 3 or 4] of any type to float32 [n, 3] in [0, 1]."""
    colors = np.asarray(colors)[:, :3]
    if colors.shape[1] != 3:
        raise ForeignFileError(f"colors of {colors.shape[1]} channels: expected 3 or 4")
    if np.issubdtype(colors.dtype, np.integer):
        return (colors / np.iinfo(colors.dtype).max).astype(np.float32)
    return np.clip(colors, 0.0, 1.0).astype(np.float32)


def _assemble(path: Path, parts: list[_Part], turn: np.ndarray) -> World:
    """Joins the parts into one world."""
    sizes = [len(part.vertices) for part in parts]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    materials: list[Material] = []
    index: dict[int, int] = {}
    face_material: list[np.ndarray] = []
    for part in parts:
        k = index.setdefault(id(part.material), len(materials))
        if k == len(materials):
            materials.append(part.material)
        face_material.append(np.full(len(part.faces), k, dtype=np.int32))
    colors = None
    if any(part.colors is not None for part in parts):

        def white(part: _Part) -> np.ndarray:
            return np.ones((len(part.faces), 3, 3), np.float32)

        colors = np.concatenate([white(p) if p.colors is None else p.colors for p in parts])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return World(
        name=f"mesh:{path}",
        vertices=np.concatenate([part.vertices for part in parts]) @ turn.T,
        faces=np.concatenate(faces).astype(np.int32),
        materials=tuple(materials),
        face_material=np.concatenate(face_material),
        face_uv=np.concatenate([part.uv for part in parts]).astype(np.float32),
        face_color=colors,
        notes={"source": str(path)},
    )


def _check(path: Path, world: World) -> None:
    """Refuses geometry that no ray can meet."""
    bad = np.flatnonzero(~np.isfinite(world.vertices).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} of {len(world.vertices)} vertices are not finite, the first is "
            f"number {bad[0]}: {world.vertices[bad[0]].tolist()}; repair the mesh first"
        )
    if not np.abs(world.face_uv).max() <= _MAX_UV:
        raise InputError(
            f"{path}: texture coordinates are not finite, or beyond {_MAX_UV:g}; repair the mesh "
            "first"
        )
    extent = world.bounds[1] - world.bounds[0]
    corners = world.vertices[world.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not np.linalg.norm(cross, axis=1).max() > 0.0:
        raise InputError(
            f"{path}: every face has zero area (the mesh extends {extent.tolist()} m); "
            "there is no surface to see"
        )
    if extent.max() > _MAX_EXTENT:
        raise InputError(
            f"{path} extends {extent.max():.6g} m; the unit is meters: scale the mesh first, with "
            "--scale 0.001 if it is in millimeters"
        )
