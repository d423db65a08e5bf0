"""A world as the tables that the shading kernel reads.

All textures lie in one flat array of texels, mip levels included: the kernel fetches any texel of
any material by one integer index. Levels are box-filtered on the stored (sRGB-encoded) bytes, as
GL's own mipmaps and Habitat's are.

Shape symbols: F faces; K materials; T textures; L lamps; S texels of all levels of all textures.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt32

from r3jax.simulators.world import World

MAX_LEVELS = 14
"""Levels kept per texture: enough for 8192 texels a side."""


@dataclass(frozen=True)
class TextureAtlas:
    """Mip pyramids, packed one after the other; row 0 of every level is the image's top row."""

    texels: np.ndarray
    """red + 256 green + 65536 blue, [S] uint32."""

    sizes: np.ndarray
    """Width and height of level 0, [T, 2] int32."""

    offsets: np.ndarray
    """Index of each level's first texel, [T, MAX_LEVELS] int32; the last level repeats."""


def build_atlas(images: list[np.ndarray]) -> TextureAtlas:
    """Packs images and their mip levels.

    Args:
        images: textures [h, w, 3] uint8 of any size.

    Returns:
        The atlas.

    Raises:
        ValueError: the textures together are too large to be indexed with 31 bits.
    """
    pieces: list[np.ndarray] = []
    sizes = np.ones((len(images), 2), dtype=np.int32)
    offsets = np.zeros((len(images), MAX_LEVELS), dtype=np.int64)
    total = 0
    for i, image in enumerate(images):
        sizes[i] = image.shape[1], image.shape[0]
        levels = mip_levels(image)
        for k in range(MAX_LEVELS):
            if k < len(levels):
                offsets[i, k] = total
                pieces.append(_pack(levels[k]))
                total += len(pieces[-1])
            else:
                offsets[i, k] = offsets[i, k - 1]
    if total >= 2**31:
        raise ValueError(
            f"the world's textures hold {total:.3g} texels, more than the 2^31 that can be "
            "indexed: halve the texture sizes"
        )
    texels = np.concatenate(pieces) if pieces else np.zeros(0, np.uint32)
    return TextureAtlas(texels, sizes, offsets.astype(np.int32))


def mip_levels(image: np.ndarray) -> list[np.ndarray]:
    """The image [h, w, 3] uint8 and its halvings down to 1x1, at most MAX_LEVELS in all."""
    levels = [image]
    while len(levels) < MAX_LEVELS and max(levels[-1].shape[:2]) > 1:
        levels.append(_halve(levels[-1]))
    return levels


def _halve(image: np.ndarray) -> np.ndarray:
    """Box filter of 2x2 texels, size floor(n / 2) but at least 1 (an odd last row is dropped)."""
    height, width = image.shape[:2]
    rows = image[: height - height % 2] if height > 1 else np.repeat(image, 2, axis=0)
    both = rows[:, : width - width % 2] if width > 1 else np.repeat(rows, 2, axis=1)
    total = both[0::2, 0::2].astype(np.uint16)
    for row, column in ((0, 1), (1, 0), (1, 1)):
        total += both[row::2, column::2]
    return ((total + 2) >> 2).astype(np.uint8)


def _pack(image: np.ndarray) -> np.ndarray:
    quads = np.zeros((*image.shape[:2], 4), dtype=np.uint8)
    quads[..., :3] = image
    return quads.reshape(-1, 4).view("<u4")[:, 0]


@dataclass(frozen=True)
class ShadingTables:
    """What the kernel needs to know of a world, as tables."""

    faces: Float[np.ndarray, "F 16"]
    """Texel coordinates of corner 0 and of the edges to corners 1 and 2 (6 numbers); gradients
    of the texel coordinates [1/m] (6); unit normal (3); index of the material (1)."""

    corner_colors: Float[np.ndarray, "F_or_0 9"]
    """Vertex colors; no row where the world has none."""

    materials: Float[np.ndarray, "K 8"]
    """Color (3), specular, shininess, emission, index of the texture (-1: none), 0."""

    texels: UInt32[np.ndarray, " S"]
    """See `TextureAtlas`."""

    sizes: Int[np.ndarray, "T 2"]
    """Width and height of the textures."""

    offsets: Int[np.ndarray, "T levels"]
    """First texel of each level."""

    lamps: Float[np.ndarray, "L 7"]
    """Position (3), color (3), reach."""

    ambient: np.float32
    """Share of the surface color that shows without any lamp."""


def build_shading_tables(world: World, *, lighting: bool) -> ShadingTables:
    """Turns a world into the kernel's tables.

    Args:
        world: triangles and materials.
        lighting: False leaves out lamps, highlights and emission: every surface shows its color.
    """
    images, texture_of = _unique_textures(world)
    atlas = build_atlas(images)
    material_size = np.ones((len(world.materials), 2))
    rows = np.zeros((len(world.materials), 8), np.float32)
    for k, material in enumerate(world.materials):
        if texture_of[k] >= 0:
            material_size[k] = atlas.sizes[texture_of[k]]
        look = (material.specular, material.shininess, material.emission)
        rows[k] = (*material.color, *look, texture_of[k], 0.0)
    faces = _face_table(world, material_size)
    colors = world.face_color
    colors = np.zeros((0, 9)) if colors is None else colors.reshape(-1, 9)
    lamps = [(*lamp.position, *lamp.color, lamp.reach) for lamp in world.lamps if lighting]
    return ShadingTables(
        faces=faces.astype(np.float32),
        corner_colors=colors.astype(np.float32),
        materials=rows,
        texels=atlas.texels,
        sizes=atlas.sizes,
        offsets=atlas.offsets,
        lamps=np.reshape(lamps, (-1, 7)).astype(np.float32),
        ambient=np.float32(world.ambient),
    )


def _unique_textures(world: World) -> tuple[list[np.ndarray], list[int]]:
    """Distinct images, and each material's index into them (-1: none)."""
    images: list[np.ndarray] = []
    index: dict[bytes, int] = {}
    texture_of: list[int] = []
    for material in world.materials:
        if material.texture is None:
            texture_of.append(-1)
            continue
        texels = np.ascontiguousarray(material.texture)
        key = hashlib.sha256(texels.data).digest() + repr(texels.shape).encode()
        if key not in index:
            index[key] = len(images)
            images.append(material.texture)
        texture_of.append(index[key])
    return images, texture_of


def _face_table(world: World, material_size: np.ndarray) -> np.ndarray:
    """`ShadingTables.faces`, [F, 16] float64."""
    corners = world.vertices[world.faces]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(edge1, edge2)
    area2 = np.linalg.norm(cross, axis=1)
    is_flat = area2 < 1e-14  # no ray meets such a face with a footprint that matters
    area2 = np.where(is_flat, 1.0, area2)
    normal = cross / area2[:, None]

    uv = world.face_uv.astype(np.float64)
    uv = uv - np.floor(uv.min(axis=1, keepdims=True))  # textures repeat; small numbers are exact
    size = material_size[world.face_material][:, None, :]
    texel = np.stack([uv[..., 0], -uv[..., 1]], axis=-1) * size
    texel0, texel1, texel2 = texel[:, 0], texel[:, 1] - texel[:, 0], texel[:, 2] - texel[:, 0]
    # Gradients of the barycentric weights over the plane of the face.
    gradient_u = np.cross(edge2, normal) / area2[:, None]
    gradient_v = np.cross(normal, edge1) / area2[:, None]
    gradient = texel1[:, :, None] * gradient_u[:, None] + texel2[:, :, None] * gradient_v[:, None]
    gradient[is_flat] = 0.0
    return np.concatenate(
        [texel0, texel1, texel2, gradient.reshape(-1, 6), normal, world.face_material[:, None]],
        axis=1,
    )
