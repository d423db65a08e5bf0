"""A world as the tables that the shading kernel reads.

All textures lie in one flat array of texels, mip levels included: the kernel fetches any texel of
any material by one integer index. Levels are box-filtered on the stored (sRGB-encoded) bytes, as
GL's own mipmaps and Habitat's are.

Shape symbols: F faces; K materials; T textures; L lamps; S texels of all levels of all textures.
"""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt32

from r3jax.errors import InputError
from r3jax.kernels.native.platform import num_cores
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
    shapes = [_level_shapes(*image.shape[:2]) for image in images]
    areas = np.array([[height * width for height, width in own] for own in shapes], dtype=np.int64)
    areas = areas.reshape(len(images), MAX_LEVELS)
    is_repeat = np.diff(areas, axis=1, prepend=0) == 0  # nothing is smaller than one texel
    areas[is_repeat] = 0
    total = int(areas.sum())
    if total >= 2**31:
        raise InputError(
            f"the world's textures hold {total:.3g} texels, more than the 2^31 that can be "
            "indexed: halve the texture sizes"
        )
    ends = np.cumsum(areas).reshape(areas.shape)
    # A level that is repeated begins where the last of its texture does.
    offsets = np.maximum.accumulate(np.where(is_repeat, 0, ends - areas), axis=1)
    texels = np.empty(total, np.uint32)

    def fill(i: int) -> None:
        own = [
            texels[begin : begin + height * width].reshape(height, width)
            for begin, (height, width) in zip(offsets[i], shapes[i], strict=True)
        ]
        _pack(images[i], own[0])
        for k in range(1, MAX_LEVELS - int(is_repeat[i].sum())):
            _halve(own[k - 1], own[k])

    with ThreadPoolExecutor(num_cores()) as pool:
        list(pool.map(fill, range(len(images))))
    sizes = np.array([own[0][::-1] for own in shapes], dtype=np.int32).reshape(-1, 2)
    return TextureAtlas(texels, sizes, offsets.astype(np.int32))


def _level_shapes(height: int, width: int) -> list[tuple[int, int]]:
    """Lists heights and widths of MAX_LEVELS levels, each half of the one before, at least 1."""
    return [(max(height >> k, 1), max(width >> k, 1)) for k in range(MAX_LEVELS)]


def _pack(image: np.ndarray, texels: np.ndarray) -> None:
    """Writes an image [h, w, 3] uint8 as texels [h, w]."""
    quads = texels.view(np.uint8).reshape(*texels.shape, 4)
    quads[..., :3], quads[..., 3] = image, 0


def _halve(texels: np.ndarray, halved: np.ndarray) -> None:
    """Writes the rounded means of 2x2 texels (an odd last row or column is dropped)."""
    height, width = (2 * n for n in halved.shape)
    # Where there is one row, or one column, it stands for both.
    rows = texels[:height] if texels.shape[0] > 1 else np.repeat(texels, 2, axis=0)
    both = rows[:, :width] if texels.shape[1] > 1 else np.repeat(rows, 2, axis=1)
    # Red and blue are summed in one word with eight bits to spare between them, green by itself.
    halved[:] = _mean_of_four(both & 0xFF00FF, 0x20002) & 0xFF00FF
    halved[:] |= (_mean_of_four(both >> 8 & 0xFF, 2) & 0xFF) << 8


def _mean_of_four(texels: np.ndarray, half: int) -> np.ndarray:
    """Sums 2x2 numbers, rounded by `half` of four, and divides by four."""
    rows = texels[0::2] + texels[1::2]
    return (rows[:, 0::2] + rows[:, 1::2] + np.uint32(half)) >> 2


@dataclass(frozen=True)
class ShadingTables:
    """Tables of a world for the kernel."""

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
        shine = (material.specular, material.shininess, material.emission)
        rows[k] = (*material.color, *shine, texture_of[k], 0.0)
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
    """Collects the distinct images, and each material's index into them (-1: none)."""
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
    """Fills `ShadingTables.faces`, [F, 16] float64."""
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
