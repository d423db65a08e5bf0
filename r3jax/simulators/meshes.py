"""Mesh files as worlds: GLB, glTF, PLY, OBJ, STL and OFF.

glTF is y-up by its standard and is turned to z-up, (x, y, z) -> (x, -z, y); other formats are
taken as z-up unless told otherwise. Colors are used as stored, as Habitat does without lights.
Transparency is ignored: a surface is there or it is not.

Shape symbols: V vertices; F faces.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.errors import InputError
from r3jax.simulators.mesh_files import GLTF_SUFFIXES, MeshFile
from r3jax.simulators.world import Material, World
from r3jax.validation.errors import ForeignFileError

_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_PLAIN = Material(color=(0.7, 0.7, 0.7))
"""What a surface without any color looks like."""

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
    """Returns the rotation [3, 3] from a mesh file's axes to the z-up world.

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
    """Returns `world_from_file` times the scale, [3, 3].

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
    """Says why a scene has nothing to look at."""
    points = sum(len(getattr(g, "vertices", ())) for g in scene.geometry.values())
    if points:
        raise InputError(
            f"{path} has {points} points but no faces: a point cloud cannot be ray cast; "
            "reconstruct a surface first (for example Poisson reconstruction)"
        )
    raise InputError(f"{path} holds an empty mesh: no vertices, no faces; export it again")


def _part_of(file: MeshFile, T: np.ndarray, name: str) -> _Part | None:
    """Returns a mesh in its place, `T_world_node`; None for points, lines and empty meshes.

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
    """Returns the texture coordinates and colors per corner, and the material."""
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
    """Returns a trimesh material as ours. The texture keeps its size."""
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
    """Colors [n, 3 or 4] of any type as float32 [n, 3] in [0, 1]."""
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
