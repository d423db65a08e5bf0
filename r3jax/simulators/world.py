"""A world as the ray caster wants it: triangles, textures, a few lamps. On the host: NumPy.

Shape symbols: V vertices; F faces; K materials; L lamps; h w texels.
"""

import hashlib
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Material:
    """How a surface looks. Colors are what the camera records (sRGB-encoded) in [0, 1]."""

    texture: np.ndarray | None = None
    """Texels [h, w, 3] uint8, row 0 at v = 1 (glTF's images have row 0 at v = 0: flip v once,
    at loading). None: plain `color`."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Multiplies the texture (and the vertex colors)."""

    specular: float = 0.0
    """Strength of the lamps' highlights, 0 matte .. 1: the view-dependent term."""

    shininess: float = 32.0
    """Blinn-Phong exponent of the highlights."""

    mirror: float = 0.0
    """Share of the color that comes from the reflected ray, 0 .. 1."""

    emission: float = 0.0
    """Share of the color that ignores the lamps, 0 .. 1: screens, lamp shades."""

    is_hole: bool = False
    """A surface on which the depth sensor fails (window glass): depth 0, the color is kept."""


@dataclass(frozen=True)
class Lamp:
    """A point light without shadows."""

    position: tuple[float, float, float]
    """[m], world."""

    color: tuple[float, float, float] = (1.0, 0.95, 0.85)
    """Relative strength per channel."""

    reach: float = 4.0
    """Distance at which the light has fallen to a half [m]."""


@dataclass(frozen=True)
class World:
    """A textured triangle mesh with a start pose. z up, meters."""

    name: str
    """How the command line names it."""

    vertices: np.ndarray
    """[V, 3] float64 [m]."""

    faces: np.ndarray
    """[F, 3] int32."""

    materials: tuple[Material, ...]
    """K materials."""

    face_material: np.ndarray
    """Index of each face's material, [F] int32."""

    face_uv: np.ndarray
    """Texture coordinates per corner, [F, 3, 2] float32; v = 0 is the texture's last row."""

    face_color: np.ndarray | None = None
    """Vertex colors per corner in [0, 1], [F, 3, 3] float32; None: white."""

    lamps: tuple[Lamp, ...] = ()
    """Point lights; none: every surface shows its own color (flat shading)."""

    ambient: float = 1.0
    """Share of the surface color that shows without any lamp."""

    start_position: np.ndarray | None = None
    """Camera center at the start, [3] [m]; None: the simulator looks for a free place."""

    start_yaw: float = 0.0
    """Heading at the start: angle of the viewing direction from the world's x axis [rad]."""

    notes: dict[str, str] = field(default_factory=dict[str, str])
    """Where it came from."""

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box, [2, 3] [m]."""
        is_used = np.zeros(len(self.vertices), dtype=bool)
        is_used[self.faces] = True
        used = self.vertices[is_used]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @property
    def content_hash(self) -> str:
        """SHA-256 over geometry, colors and materials: two equal worlds look the same."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.faces, self.face_material, self.face_uv):
            digest.update(np.ascontiguousarray(array).tobytes())
        if self.face_color is not None:
            digest.update(np.ascontiguousarray(self.face_color).tobytes())
        for material in self.materials:
            plain = {k: v for k, v in vars(material).items() if k != "texture"}
            digest.update(repr(sorted(plain.items())).encode())
            if material.texture is not None:
                digest.update(np.ascontiguousarray(material.texture).tobytes())
        digest.update(repr((self.lamps, self.ambient)).encode())
        return digest.hexdigest()
