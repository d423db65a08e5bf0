"""A world as the tables that the shading kernel reads.

Sizes are rounded up, so that worlds share compiled kernels.

Shape symbols: F faces; K materials; T textures; L lamps; S texels.
"""

import hashlib
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from r3jax.simulators.textures import build_atlas, round_up
from r3jax.simulators.world import World


class Surface(eqx.Module):
    """What the kernel needs to know of a world, as tables."""

    faces: Float[Array, "F 16"]
    """Texel coordinates of corner 0 and of the edges to corners 1 and 2 (6 numbers); gradients
    of the texel coordinates [1/m] (6); unit normal (3); index of the material (1)."""

    corner_colors: Float[Array, "F_or_1 9"]
    """Vertex colors; one row of ones where the world has none."""

    materials: Float[Array, "K 8"]
    """Color (3), specular, shininess, emission, index of the texture (-1: none), 0."""

    texels: UInt32[Array, " S"]
    """See `TextureAtlas`."""

    sizes: Int[Array, "T 2"]
    """Width and height of the textures."""

    offsets: Int[Array, "T levels"]
    """First texel of each level."""

    lamps: Float[Array, "L 7"]
    """Position (3), color (3), reach; black ones fill up to a multiple of 8."""

    ambient: Float[Array, ""]
    """Share of the surface color that shows without any lamp."""


def build_surface(world: World, *, lighting: bool) -> Surface:
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
    corner_colors = np.ones((1, 9)) if colors is None else _padded(colors.reshape(-1, 9))
    lamps = [(*lamp.position, *lamp.color, lamp.reach) for lamp in world.lamps if lighting]
    # Dark lamps fill up the table, so that worlds share compiled kernels.
    lamps += [(0.0,) * 6 + (1.0,)] * (-len(lamps) % 8)
    as_float: Callable[[np.ndarray | float], Array] = lambda x: jnp.asarray(
        np.asarray(x, dtype=np.float32)
    )
    return Surface(
        faces=as_float(_padded(faces)),
        corner_colors=as_float(corner_colors),
        materials=as_float(_padded(rows, least=16)),
        texels=jnp.asarray(atlas.texels),
        sizes=jnp.asarray(atlas.sizes),
        offsets=jnp.asarray(atlas.offsets),
        lamps=as_float(np.reshape(lamps, (-1, 7))),
        ambient=as_float(world.ambient),
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


def _padded(table: np.ndarray, least: int = 1024) -> np.ndarray:
    """Adds rows of zeros up to `round_up`, so that worlds share compiled kernels."""
    extra = round_up(len(table), least) - len(table)
    return np.concatenate([table, np.zeros((extra, table.shape[1]), table.dtype)])


def _face_table(world: World, material_size: np.ndarray) -> np.ndarray:
    """`Surface.faces`, [F, 16] float64."""
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
