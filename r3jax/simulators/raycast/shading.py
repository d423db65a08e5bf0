"""Colors of ray hits: textures, lamps, highlights. One jitted kernel over chunks of rays.

The color c of a hit with surface color a (texture x material color x vertex color), normal n
turned towards the viewer, lamps i at distance d_i in direction l_i with half vector h_i
(Blinn, "Models of light reflection", 1977) is

    light_i = color_i / (1 + (d_i / reach_i)^2)
    c = a (e + (1 - e) (ambient + (1 - ambient) sum_i light_i max(0, n l_i)))
        + specular sum_i light_i max(0, n h_i)^shininess

with the emission e. A world without lamps shows a.

Textures are filtered trilinearly, with PROBES samples along the longer axis of the pixel's
footprint: isotropic mip maps would blur floors and walls seen at a low angle.

Shape symbols: n rays of a chunk; L lamps.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.simulators.raycast.rays import Hits
from r3jax.simulators.raycast.shading_tables import MAX_LEVELS, ShadingTables

CHUNK = 1 << 15
"""Rays per call of the kernel."""

PROBES = 2
"""Trilinear samples along the longer axis of a footprint."""

LEVEL_BIAS = -0.5
"""Added to the mip level. Measured against 64 rays a pixel on a furnished house: with two probes
and this bias the images are nearest (37.8 dB; 37.4 without bias, 36.2 with one probe)."""


class Rays(eqx.Module):
    """A chunk of ray hits."""

    face: Int[Array, " n"]
    """Index of the face, -1: nothing was hit."""

    u: Float[Array, " n"]
    """Barycentric weight of corner 1."""

    v: Float[Array, " n"]
    """Barycentric weight of corner 2."""

    distance: Float[Array, " n"]
    """Ray parameter of the hit, in lengths of the direction; anything where nothing was hit."""

    direction: Float[Array, "n 3"]
    """Direction of the (last) ray; not of unit length."""

    origin: Float[Array, "n_or_1 3"]
    """Where the ray starts [m]."""

    mirror: Float[Array, "n_or_1 3"]
    """Unit normal of the mirror that the ray came by, 0 for rays straight from the camera."""

    path_before: Float[Array, " n_or_1"]
    """Length of the path from the camera to `origin`, in the unit of `distance`."""


def _dot(a: Array | list[Array], b: Array | list[Array]) -> Array:
    """Scalar products of vectors whose three components are the rows of `a` and `b`."""
    # Written out: XLA's reductions over such a short axis are many times slower on a CPU.
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _footprint(
    gradient: Float[Array, "6 n"],
    normal: Float[Array, "3 n"],
    rays: Rays,
    distance: Float[Array, " n"],
    pixel_steps: Float[Array, "2 3"],
) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"]]:
    """How far, in texels, the hit moves when the pixel moves by one column and by one row.

    With the plane's normal n and direction d, a change e of the direction moves the hit by
    t (e - d (n e) / (n d)) (Igehy, "Tracing ray differentials", 1999). A mirror reflects e.
    """
    direction, mirror = rays.direction.T, rays.mirror.T
    path = distance + rays.path_before
    along = _dot(normal, direction)
    along = jnp.where(jnp.abs(along) < 1e-6, 1e-6, along)

    def moved(step: Float[Array, " 3"]) -> Float[Array, "2 n"]:
        reflected = step[:, None] - 2.0 * mirror * _dot(mirror, step)[None, :]
        reflected = jnp.broadcast_to(reflected, direction.shape)
        slide = _dot(normal, reflected) / along
        move = path[None, :] * (reflected - direction * slide[None, :])
        return jnp.stack([_dot(gradient[:3], move), _dot(gradient[3:], move)])

    return moved(pixel_steps[0]), moved(pixel_steps[1])


def _texture_color(
    tables: ShadingTables,
    texture: Int[Array, " n"],
    texel: Float[Array, "2 n"],
    moves: tuple[Float[Array, "2 n"], Float[Array, "2 n"]],
) -> Float[Array, "3 n"]:
    """Filtered texture colors in [0, 1]."""
    size = _rows(tables.sizes, texture).T  # [2, n]
    lengths = [jnp.sqrt(move[0] ** 2 + move[1] ** 2) for move in moves]
    is_first_longer = lengths[0] >= lengths[1]
    long_axis = jnp.where(is_first_longer[None, :], moves[0], moves[1])
    longer, shorter = jnp.maximum(*lengths), jnp.minimum(*lengths)
    width = jnp.maximum(longer / PROBES, shorter)
    level = jnp.clip(jnp.log2(jnp.maximum(width, 1e-6)) + LEVEL_BIAS, 0.0, MAX_LEVELS - 1.0)
    fine = jnp.floor(level)
    blend = level - fine
    # Probes spread only as far as the footprint is longer than wide.
    spread = 1.0 - jnp.minimum(shorter / jnp.maximum(longer, 1e-6), 1.0)

    indices: list[Array] = []
    weights: list[Array] = []
    for coarser in range(2):
        k = jnp.minimum(fine.astype(jnp.int32) + coarser, MAX_LEVELS - 1)
        size_k = jnp.maximum(size >> k[None, :], 1)
        start = _rows(tables.offsets.reshape(-1), texture * MAX_LEVELS + k)
        scale = size_k.astype(jnp.float32) / size.astype(jnp.float32)
        share = (blend if coarser else 1.0 - blend) / PROBES
        for probe in range(PROBES):
            shift = ((probe + 0.5) / PROBES - 0.5) * spread
            x, y = (texel + shift[None, :] * long_axis) * scale - 0.5
            columns, fx = _wrapped_pair(x, size_k[0])
            rows, fy = _wrapped_pair(y, size_k[1])
            for i, wy in enumerate((1.0 - fy, fy)):
                for j, wx in enumerate((1.0 - fx, fx)):
                    indices.append(start + rows[i] * size_k[0] + columns[j])
                    weights.append(share * wx * wy)
    index = jnp.clip(jnp.stack(indices), 0, tables.texels.shape[0] - 1)
    # One gather of whole texels, kept apart from what follows: fused, XLA would fetch every
    # texel once per channel.
    packed = jax.lax.optimization_barrier(_rows(tables.texels, index))
    channels: list[Array] = []
    for shift in (0, 8, 16):
        values = [((texels >> shift) & jnp.uint32(255)).astype(jnp.float32) for texels in packed]
        total = sum(w * value for w, value in zip(weights, values, strict=True))
        channels.append(jnp.asarray(total))
    return jnp.stack(channels) / 255.0


def _rows(table: Array, index: Int[Array, "..."]) -> Array:
    """`table[index]` for indices known to be inside: the check would cost more than the fetch."""
    return table.at[index].get(mode="promise_in_bounds")


def _wrapped_pair(
    x: Float[Array, " n"], size: Int[Array, " n"]
) -> tuple[list[Int[Array, " n"]], Float[Array, " n"]]:
    """The two texels next to x of a texture that repeats, and the second one's weight."""
    # In floating point: integer remainders do not vectorize, and cost more than the fetches.
    limit = size.astype(jnp.float32)
    low = jnp.floor(x)
    first = low - limit * jnp.floor(low / limit)
    first = jnp.where(first >= limit, 0.0, first)
    second = jnp.where(first + 1.0 >= limit, 0.0, first + 1.0)
    return [first.astype(jnp.int32), second.astype(jnp.int32)], x - low


def _lit(
    tables: ShadingTables,
    albedo: Float[Array, "3 n"],
    look: Float[Array, "8 n"],
    normal: Float[Array, "3 n"],
    rays: Rays,
    distance: Float[Array, " n"],
) -> Float[Array, "3 n"]:
    """The module's formula for a world with lamps."""
    unit: Callable[[Array], Array] = lambda x: x / jnp.maximum(jnp.sqrt(_dot(x, x)), 1e-6)[None, :]
    view = unit(-rays.direction.T)
    facing = jnp.where((_dot(normal, view) < 0.0)[None, :], -normal, normal)
    position = rays.origin.T + distance[None, :] * rays.direction.T
    # All that is per ray is worked out once, not once per lamp.
    view, facing, position = jax.lax.optimization_barrier((view, facing, position))

    def per_lamp(x: Array) -> list[Array]:
        return [row[None, :] for row in x]  # [1, n] each, against [L, 1]

    view_of, facing_of = per_lamp(view), per_lamp(facing)
    offset = [tables.lamps[:, k, None] - position[None, k] for k in range(3)]
    squared = _dot(offset, offset)
    fall = 1.0 / (1.0 + squared / tables.lamps[:, 6, None] ** 2)
    scale = jax.lax.rsqrt(jnp.maximum(squared, 1e-12))
    to_lamp = [x * scale for x in offset]
    incidence = _dot(facing_of, to_lamp)
    half = [x + y for x, y in zip(to_lamp, view_of, strict=True)]
    cosine = _dot(facing_of, half) * jax.lax.rsqrt(jnp.maximum(_dot(half, half), 1e-12))
    specular, shininess, emission = look[3], look[4], look[5]
    gloss = jnp.exp2(shininess[None, :] * jnp.log2(jnp.maximum(cosine, 1e-6)))
    gloss = jnp.where(incidence > 0.0, gloss, 0.0)
    colors = tables.lamps[:, 3:6].T  # [3, L]
    diffuse = colors @ (fall * jnp.maximum(incidence, 0.0))
    highlight = colors @ (fall * gloss)
    received = tables.ambient + (1.0 - tables.ambient) * diffuse
    lit = emission[None, :] + (1.0 - emission)[None, :] * received
    return albedo * lit + specular[None, :] * highlight


@jax.jit
def shade(
    tables: ShadingTables, rays: Rays, pixel_steps: Float[Array, "2 3"]
) -> Float[Array, "3 n"]:
    """Colors of a chunk of hits, in [0, 1]; black where nothing was hit.

    Args:
        tables: the world's tables.
        rays: the hits.
        pixel_steps: by how much the camera's ray direction changes from one column (row 0) and
            from one row (row 1) of pixels to the next.
    """
    face = jnp.maximum(rays.face, 0)
    distance = jnp.where(rays.face >= 0, rays.distance, 1.0)
    # One row of 64 bytes per ray; without the barrier each use would fetch it again.
    row = jax.lax.optimization_barrier(_rows(tables.faces, face)).T
    look = jax.lax.optimization_barrier(_rows(tables.materials, row[15].astype(jnp.int32))).T
    normal = row[12:15]
    texel = row[0:2] + rays.u[None, :] * row[2:4] + rays.v[None, :] * row[4:6]
    moves = _footprint(row[6:12], normal, rays, distance, pixel_steps)
    texture = look[6].astype(jnp.int32)
    sampled = _texture_color(tables, jnp.maximum(texture, 0), texel, moves)
    albedo = look[:3] * jnp.where(texture[None, :] >= 0, sampled, 1.0)
    if tables.corner_colors.shape[0] > 1:
        corner = jax.lax.optimization_barrier(_rows(tables.corner_colors, face)).T
        w0 = (1.0 - rays.u - rays.v)[None, :]
        mixed = w0 * corner[:3] + rays.u[None, :] * corner[3:6] + rays.v[None, :] * corner[6:]
        albedo = albedo * mixed
    color = albedo
    if tables.lamps.shape[0] > 0:
        color = _lit(tables, albedo, look, normal, rays, distance)
    return jnp.where(rays.face[None, :] >= 0, jnp.clip(color, 0.0, 1.0), 0.0)


def start_shading(
    tables: ShadingTables,
    hits: Hits,
    origins: np.ndarray,
    directions: np.ndarray,
    pixel_steps: Float[Array, "2 3"],
    *,
    path_before: np.ndarray | None = None,
    mirror: np.ndarray | None = None,
) -> Float[Array, "3 chunk"]:
    """Colors of at most CHUNK hits, of which the first n columns count.

    Returns at once: the kernel runs in the background until the result is read.

    Args:
        tables: the world's tables.
        hits: of n rays.
        origins: where the rays start, [n, 3], or [1, 3] if all start there [m].
        directions: of the rays [n, 3].
        pixel_steps: see `shade`.
        path_before: length of the path to `origins`, in the same unit as the hits' distances [n].
        mirror: normals of the mirrors that the rays come by [n, 3].
    """
    path_before = np.zeros(1, np.float32) if path_before is None else path_before
    mirror = np.zeros((1, 3), np.float32) if mirror is None else mirror
    columns = (hits.face, hits.u, hits.v, hits.distance, directions, origins, mirror, path_before)
    return shade(tables, Rays(*(jnp.asarray(_filled(c)) for c in columns)), pixel_steps)


def _filled(column: np.ndarray) -> np.ndarray:
    """The column extended to CHUNK rows, unless it is a single row that serves all."""
    missing = CHUNK - len(column)
    if missing == 0 or len(column) == 1:
        return column
    return np.concatenate([column, np.zeros((missing, *column.shape[1:]), column.dtype)])
