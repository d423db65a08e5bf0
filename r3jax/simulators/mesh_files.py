"""Mesh files through trimesh, with limits: what a file names and claims is checked first.

A mesh may name buffers, materials and images. Only regular files below its own folder are read,
no image is unpacked before its size is known, and archives are not opened at all.
"""

from pathlib import Path
from typing import Any

import numpy as np

from r3jax.formats.validation.errors import ForeignFileError
from r3jax.formats.validation.files import check_regular
from r3jax.simulators.gltf import check_claims, num_lines, read_tree, texture_transforms

SUFFIXES = (".glb", ".gltf", ".ply", ".obj", ".stl", ".off")
"""Formats that are read."""

GLTF_SUFFIXES = (".glb", ".gltf")
"""Those of glTF."""

_IMAGES = ("PNG", "JPEG", "WEBP", "BMP", "TGA")
"""Formats of textures; Pillow knows others that start programs of their own."""

_MAX_TEXELS = 1 << 26
"""Of one texture: 8192 x 8192."""

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
        """The texels of one of its images, [h, w, 3] uint8; unpacked once, however often asked.

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
