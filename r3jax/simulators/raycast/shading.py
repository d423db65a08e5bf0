"""Colors of ray hits: textures, lamps, highlights; in machine code, on all cores.

The color c of a hit with surface color a (texture x material color x vertex color), normal n
turned towards the viewer, lamps i at distance d_i in direction l_i with half vector h_i
(Blinn, "Models of light reflection", 1977) is

    light_i = color_i / (1 + (d_i / reach_i)^2)
    c = a (e + (1 - e) (ambient + (1 - ambient) sum_i light_i max(0, n l_i)))
        + specular sum_i light_i max(0, n h_i)^shininess

with the emission e. A world without lamps shows a.

Textures are filtered trilinearly, with PROBES samples along the longer axis of the pixel's
footprint: isotropic mip maps would blur floors and walls seen at a low angle.

Shape symbols: n rays; F faces; K materials; T textures; L lamps; S texels.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np
from numba import prange

from r3jax.native.compiled import called_from_python, inlined_fused
from r3jax.native.ffi import num_workers, require_threads
from r3jax.simulators.raycast.rays import Hits
from r3jax.simulators.raycast.shading_tables import MAX_LEVELS, ShadingTables

PROBES = 2
"""Trilinear samples along the longer axis of a footprint."""

LEVEL_BIAS = np.float32(-0.5)
"""Added to the mip level. Measured against 64 rays a pixel on a furnished house: with two probes
and this bias the images are nearest (37.8 dB; 37.4 without bias, 36.2 with one probe)."""

_BLOCK = 1 << 10
"""Rays that a thread colors at a time: rays beside each other cost alike, and the image as a whole
does not."""

_FAINTEST = np.float32(-25.0)
"""log2 of a highlight that counts for nothing."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LEAST, _TINY, _BYTE = np.float32(1e-6), np.float32(1e-12), np.float32(255.0)


@inlined_fused
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined_fused
def _unit(a):
    inverse = _ONE / max(math.sqrt(_dot(a, a)), _LEAST)
    return a[0] * inverse, a[1] * inverse, a[2] * inverse


@inlined_fused
def _three(table, i, begin):
    return table[i, begin], table[i, begin + 1], table[i, begin + 2]


@inlined_fused
def _moved(step, mirror, normal, along, direction, path, gradients):
    """How far, in texels, a hit moves when the pixel moves by one column or row.

    With the plane's normal n and direction d, a change e of the direction moves the hit by
    t (e - d (n e) / (n d)) (Igehy, "Tracing ray differentials", 1999). A mirror reflects e.
    """
    twice = _TWO * _dot(mirror, step)
    e = step[0] - twice * mirror[0], step[1] - twice * mirror[1], step[2] - twice * mirror[2]
    slide = _dot(normal, e) / along
    move = (
        path * (e[0] - direction[0] * slide), path * (e[1] - direction[1] * slide),
        path * (e[2] - direction[2] * slide),
    )  # fmt: skip
    return _dot(gradients[0], move), _dot(gradients[1], move)


@inlined_fused
def _wrapped_pair(x, size):
    """The two texels next to x of a texture that repeats, and the second one's weight."""
    first = np.int32(x)
    low = np.float32(first)
    if low > x:  # towards zero is not down
        first, low = np.int32(first - 1), low - _ONE
    # A branch that is foreseen nearly always: a remainder costs more than what is fetched.
    if (first < 0) | (first >= size):
        first = np.int32(first % size)
    second = np.int32(first + 1)
    return first, (second if second < size else np.int32(0)), x - low


@inlined_fused
def _add_texel(texel, weight, color):
    packed = np.int32(texel)  # signed: processors convert that to float in one step
    return (
        color[0] + weight * np.float32(np.int32(packed & 255)),
        color[1] + weight * np.float32(np.int32((packed >> 8) & 255)),
        color[2] + weight * np.float32(np.int32((packed >> 16) & 255)),
    )


@inlined_fused
def _texture_color(atlas, texture, x, y, moves):
    """Filtered color of a texture in [0, 1]."""
    texels, sizes, offsets = atlas
    width, height = sizes[texture, 0], sizes[texture, 1]
    a, b = moves
    length_a = math.sqrt(a[0] * a[0] + a[1] * a[1])
    length_b = math.sqrt(b[0] * b[0] + b[1] * b[1])
    axis = a if length_a >= length_b else b
    longer, shorter = max(length_a, length_b), min(length_a, length_b)
    level = math.log2(max(longer / np.float32(PROBES), shorter, _LEAST)) + LEVEL_BIAS
    level = min(max(level, _ZERO), np.float32(MAX_LEVELS - 1))
    fine = np.float32(math.floor(level))
    blend = level - fine
    # Probes spread only as far as the footprint is longer than wide.
    spread = _ONE - min(shorter / max(longer, _LEAST), _ONE)
    color = (_ZERO, _ZERO, _ZERO)
    # Between two levels; a magnified texture has but one.
    for coarser in range(2 if blend > _ZERO else 1):
        k = min(np.int64(fine) + coarser, MAX_LEVELS - 1)
        columns, rows = np.int32(max(width >> k, 1)), np.int32(max(height >> k, 1))
        start = np.int64(offsets[texture, k])
        scale_x, scale_y = (
            np.float32(columns) / np.float32(width),
            np.float32(rows) / np.float32(height),
        )
        share = (blend if coarser == 1 else _ONE - blend) / np.float32(PROBES)
        for probe in range(PROBES):
            shift = ((np.float32(probe) + _HALF) / np.float32(PROBES) - _HALF) * spread
            i0, i1, fx = _wrapped_pair((x + shift * axis[0]) * scale_x - _HALF, columns)
            j0, j1, fy = _wrapped_pair((y + shift * axis[1]) * scale_y - _HALF, rows)
            top = np.uint64(start + np.int64(j0) * columns)
            bottom = np.uint64(start + np.int64(j1) * columns)
            upper, lower = share * (_ONE - fy), share * fy
            color = _add_texel(texels[top + np.uint64(i0)], upper * (_ONE - fx), color)
            color = _add_texel(texels[top + np.uint64(i1)], upper * fx, color)
            color = _add_texel(texels[bottom + np.uint64(i0)], lower * (_ONE - fx), color)
            color = _add_texel(texels[bottom + np.uint64(i1)], lower * fx, color)
    return color[0] / _BYTE, color[1] / _BYTE, color[2] / _BYTE


@inlined_fused
def _light(lamps, position, normal, view, specular, shininess):
    """Sums over the lamps of the module's formula: diffuse light and highlights, RGB each."""
    diffuse, highlight = (_ZERO, _ZERO, _ZERO), (_ZERO, _ZERO, _ZERO)
    # Farther off the mirror's direction a highlight is less than float32 can add to a color.
    edge = math.exp2(_FAINTEST / max(shininess, _LEAST)) if specular > _ZERO else _TWO
    for i in range(lamps.shape[0]):
        x, y, z = lamps[i, 0] - position[0], lamps[i, 1] - position[1], lamps[i, 2] - position[2]
        squared = x * x + y * y + z * z
        towards = x * normal[0] + y * normal[1] + z * normal[2]
        if towards > _ZERO:
            scale = _ONE / math.sqrt(max(squared, _TINY))
            reach = lamps[i, 6] * lamps[i, 6]
            light = reach / (reach + squared)
            r, g, b = lamps[i, 3] * light, lamps[i, 4] * light, lamps[i, 5] * light
            incidence = towards * scale
            diffuse = (
                diffuse[0] + r * incidence, diffuse[1] + g * incidence, diffuse[2] + b * incidence,
            )  # fmt: skip
            half = x * scale + view[0], y * scale + view[1], z * scale + view[2]
            along, length = _dot(normal, half), max(_dot(half, half), _TINY)
            if (along > _ZERO) & (along * along > edge * edge * length):
                gloss = math.exp2(shininess * math.log2(along / math.sqrt(length)))
                highlight = (
                    highlight[0] + r * gloss, highlight[1] + g * gloss, highlight[2] + b * gloss,
                )  # fmt: skip
    return diffuse, highlight


@inlined_fused
def _lit(lamps, ambient, albedo, look, position, normal, direction):
    """The module's formula for a world with lamps; `look`: specular, shininess, emission."""
    view = _unit((-direction[0], -direction[1], -direction[2]))
    if _dot(normal, view) < _ZERO:
        normal = -normal[0], -normal[1], -normal[2]
    diffuse, highlight = _light(lamps, position, normal, view, look[0], look[1])
    emission, dark = look[2], _ONE - ambient
    shares = (
        emission + (_ONE - emission) * (ambient + dark * diffuse[0]),
        emission + (_ONE - emission) * (ambient + dark * diffuse[1]),
        emission + (_ONE - emission) * (ambient + dark * diffuse[2]),
    )
    return (
        albedo[0] * shares[0] + look[0] * highlight[0],
        albedo[1] * shares[1] + look[0] * highlight[1],
        albedo[2] * shares[2] + look[0] * highlight[2],
    )


@inlined_fused
def _color_of_hit(world, face, u, v, distance, origin, direction, mirror, before, steps):
    """Color of one hit."""
    faces, corner_colors, materials, atlas, lamps, ambient = world
    material = np.int64(faces[face, 15])
    normal, albedo = _three(faces, face, 12), _three(materials, material, 0)
    texture = np.int64(materials[material, 6])
    if texture >= 0:
        x = faces[face, 0] + u * faces[face, 2] + v * faces[face, 4]
        y = faces[face, 1] + u * faces[face, 3] + v * faces[face, 5]
        along, path = _dot(normal, direction), distance + before
        along = _LEAST if abs(along) < _LEAST else along
        gradients = _three(faces, face, 6), _three(faces, face, 9)
        moves = (
            _moved(_three(steps, 0, 0), mirror, normal, along, direction, path, gradients),
            _moved(_three(steps, 1, 0), mirror, normal, along, direction, path, gradients),
        )
        c = _texture_color(atlas, texture, x, y, moves)
        albedo = albedo[0] * c[0], albedo[1] * c[1], albedo[2] * c[2]
    if corner_colors.shape[0] > 0:
        w, at = _ONE - u - v, corner_colors[face]
        albedo = (
            albedo[0] * (w * at[0] + u * at[3] + v * at[6]),
            albedo[1] * (w * at[1] + u * at[4] + v * at[7]),
            albedo[2] * (w * at[2] + u * at[5] + v * at[8]),
        )
    if lamps.shape[0] == 0:
        return albedo
    position = (
        origin[0] + distance * direction[0], origin[1] + distance * direction[1],
        origin[2] + distance * direction[2],
    )  # fmt: skip
    look = _three(materials, material, 3)
    return _lit(lamps, ambient, albedo, look, position, normal, direction)


@called_from_python(parallel=True)
def _shade_all(
    faces, corner_colors, materials, texels, sizes, offsets, lamps, ambient,
    face, u, v, distance, directions, origins, mirrors, before, steps, workers, colors,
):  # fmt: skip
    """Colors all hits. Flat arguments: Numba's threads take no nested ones."""
    num = face.shape[0]
    blocks = (num + _BLOCK - 1) // _BLOCK
    for worker in prange(workers):
        # Every `workers`-th block, so that each thread gets of all parts of the image.
        for block in range(worker, blocks, workers):
            for i in range(block * _BLOCK, min((block + 1) * _BLOCK, num)):
                if face[i] < 0:
                    colors[i, 0] = colors[i, 1] = colors[i, 2] = _ZERO
                else:
                    color = _color_of_hit(
                        (faces, corner_colors, materials, (texels, sizes, offsets), lamps, ambient),
                        face[i], u[i], v[i], distance[i],
                        _three(origins, min(i, origins.shape[0] - 1), 0), _three(directions, i, 0),
                        _three(mirrors, min(i, mirrors.shape[0] - 1), 0),
                        before[min(i, before.shape[0] - 1)], steps,
                    )  # fmt: skip
                    for channel in range(3):
                        colors[i, channel] = min(max(color[channel], _ZERO), _ONE)


def shade(
    tables: ShadingTables,
    hits: Hits,
    origins: np.ndarray,
    directions: np.ndarray,
    pixel_steps: np.ndarray,
    *,
    path_before: np.ndarray | None = None,
    mirror: np.ndarray | None = None,
) -> np.ndarray:
    """Colors of hits in [0, 1], black where nothing was hit, [n, 3] float32.

    Args:
        tables: the world's tables.
        hits: of n rays.
        origins: where the rays start, [n, 3], or [1, 3] if all start there [m].
        directions: of the rays [n, 3], of any length.
        pixel_steps: by how much the camera's ray direction changes from one column (row 0) and
            from one row (row 1) of pixels to the next [2, 3].
        path_before: length of the path to `origins`, in the same unit as the hits' distances [n].
        mirror: unit normals of the mirrors that the rays come by [n, 3].
    """
    require_threads()
    path_before = np.zeros(1, np.float32) if path_before is None else path_before
    mirror = np.zeros((1, 3), np.float32) if mirror is None else mirror
    columns = (hits.face, hits.u, hits.v, hits.distance, directions, origins, mirror, path_before)
    # One layout and writable, whatever the caller's are: each other one compiles anew.
    per_ray = [np.require(column, requirements=("C", "W")) for column in columns]
    colors = np.empty((len(hits.face), 3), np.float32)
    _shade_all(
        tables.faces, tables.corner_colors, tables.materials, tables.texels, tables.sizes,
        tables.offsets, tables.lamps, tables.ambient,
        *per_ray, pixel_steps, num_workers(), colors,
    )  # fmt: skip
    return colors
