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

from r3jax.native.arithmetic import exp2, log2
from r3jax.native.compiled import called_from_python, in_wide_vectors, inlined_fused
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

_POSITION, _NORMAL, _VIEW = 0 * _BLOCK, 3 * _BLOCK, 6 * _BLOCK
_SPECULAR, _SHININESS, _EMISSION = 9 * _BLOCK, 10 * _BLOCK, 11 * _BLOCK
_DIFFUSE, _HIGHLIGHT = 12 * _BLOCK, 15 * _BLOCK
_COLUMNS = 18
"""Columns of a block's table, one after the other, so that LLVM sees how far apart they are."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LEAST, _TINY = np.float32(1e-6), np.float32(1e-12)
_PER_SAMPLE = np.float32(1.0 / (255.0 * PROBES))


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
def _moved(step, mirror, normal, per_along, direction, path, gradients):
    """How far, in texels, a hit moves when the pixel moves by one column or row.

    With the plane's normal n and direction d, a change e of the direction moves the hit by
    t (e - d (n e) / (n d)) (Igehy, "Tracing ray differentials", 1999). A mirror reflects e.
    """
    twice = _TWO * _dot(mirror, step)
    e = step[0] - twice * mirror[0], step[1] - twice * mirror[1], step[2] - twice * mirror[2]
    slide = _dot(normal, e) * per_along
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
    squared_a, squared_b = a[0] * a[0] + a[1] * a[1], b[0] * b[0] + b[1] * b[1]
    axis = a if squared_a >= squared_b else b
    longer, shorter = max(squared_a, squared_b), min(squared_a, squared_b)
    sampled = max(longer * np.float32(1.0 / PROBES**2), shorter, _TINY)
    level = min(max(_HALF * log2(sampled) + LEVEL_BIAS, _ZERO), np.float32(MAX_LEVELS - 1))
    fine = np.int32(level)
    blend = level - np.float32(fine)
    # Probes spread only as far as the footprint is longer than wide.
    spread = _ONE - min(math.sqrt(shorter / max(longer, _TINY)), _ONE)
    per_width, per_height = _ONE / np.float32(width), _ONE / np.float32(height)
    color = (_ZERO, _ZERO, _ZERO)
    # Between two levels; a magnified texture has but one.
    for coarser in range(2 if blend > _ZERO else 1):
        k = min(np.int64(fine) + coarser, MAX_LEVELS - 1)
        columns, rows = np.int32(max(width >> k, 1)), np.int32(max(height >> k, 1))
        start = np.int64(offsets[texture, k])
        scale_x, scale_y = np.float32(columns) * per_width, np.float32(rows) * per_height
        share = (blend if coarser == 1 else _ONE - blend) * _PER_SAMPLE
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
    return color


@inlined_fused
def _surface(world, face, u, v, path, direction, mirror, steps):
    """Color of a surface where a ray meets it, before any light."""
    faces, corner_colors, materials, atlas = world
    material = np.int64(faces[face, 15])
    normal, albedo = _three(faces, face, 12), _three(materials, material, 0)
    texture = np.int64(materials[material, 6])
    if texture >= 0:
        x = faces[face, 0] + u * faces[face, 2] + v * faces[face, 4]
        y = faces[face, 1] + u * faces[face, 3] + v * faces[face, 5]
        along = _dot(normal, direction)
        per_along = _ONE / (_LEAST if abs(along) < _LEAST else along)
        gradients = _three(faces, face, 6), _three(faces, face, 9)
        moves = (
            _moved(_three(steps, 0, 0), mirror, normal, per_along, direction, path, gradients),
            _moved(_three(steps, 1, 0), mirror, normal, per_along, direction, path, gradients),
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
    return albedo


@inlined_fused
def _place(block, i, world, face, origin, direction, distance):
    """Writes what the light at a hit depends on: position, normal, view, and how it shines."""
    faces, materials = world[0], world[2]
    view, normal = _unit((-direction[0], -direction[1], -direction[2])), _three(faces, face, 12)
    turned = -_ONE if _dot(normal, view) < _ZERO else _ONE
    look = _three(materials, np.int64(faces[face, 15]), 3)
    for axis in range(3):
        block[_POSITION + axis * _BLOCK + i] = origin[axis] + distance * direction[axis]
        block[_NORMAL + axis * _BLOCK + i] = turned * normal[axis]
        block[_VIEW + axis * _BLOCK + i] = view[axis]
    block[_SPECULAR + i], block[_SHININESS + i], block[_EMISSION + i] = look


@inlined_fused
def _towards(lamp, block, i):
    """Vector from a hit to a lamp, its squared length, and its part along the normal."""
    x = lamp[0] - block[_POSITION + i]
    y = lamp[1] - block[_POSITION + _BLOCK + i]
    z = lamp[2] - block[_POSITION + 2 * _BLOCK + i]
    n = block[_NORMAL + i], block[_NORMAL + _BLOCK + i], block[_NORMAL + 2 * _BLOCK + i]
    return (x, y, z), x * x + y * y + z * z, x * n[0] + y * n[1] + z * n[2], n


@inlined_fused
def _add_diffuse(lamp, block, num):
    """Adds light_i max(0, n l_i) to the sums of a block."""
    in_wide_vectors()
    reach = lamp[6] * lamp[6]
    for i in range(num):
        _, squared, towards, _ = _towards(lamp, block, i)
        incidence = max(towards, _ZERO) / math.sqrt(max(squared, _TINY))
        light = incidence * reach / (reach + squared)
        block[_DIFFUSE + i] += lamp[3] * light
        block[_DIFFUSE + _BLOCK + i] += lamp[4] * light
        block[_DIFFUSE + 2 * _BLOCK + i] += lamp[5] * light


@inlined_fused
def _add_highlights(lamp, block, num):
    """Adds light_i max(0, n h_i)^shininess to the sums of a block."""
    in_wide_vectors()
    reach = lamp[6] * lamp[6]
    for i in range(num):
        to_lamp, squared, towards, n = _towards(lamp, block, i)
        scale = _ONE / math.sqrt(max(squared, _TINY))
        h = (
            to_lamp[0] * scale + block[_VIEW + i],
            to_lamp[1] * scale + block[_VIEW + _BLOCK + i],
            to_lamp[2] * scale + block[_VIEW + 2 * _BLOCK + i],
        )
        along = _dot(n, h)
        squared_cosine = along * along / max(_dot(h, h), _TINY)
        power = _HALF * block[_SHININESS + i] * log2(max(squared_cosine, _TINY))
        is_lit = (towards > _ZERO) & (along > _ZERO)
        light = exp2(power) * reach / (reach + squared) if is_lit else _ZERO
        block[_HIGHLIGHT + i] += lamp[3] * light
        block[_HIGHLIGHT + _BLOCK + i] += lamp[4] * light
        block[_HIGHLIGHT + 2 * _BLOCK + i] += lamp[5] * light


@inlined_fused
def _light_block(lamps, ambient, block, num, colors):
    """The module's formula for a block of surface colors, in place."""
    sums = block[_DIFFUSE:]
    sums[:] = _ZERO
    shines = (block[_SPECULAR : _SPECULAR + num] > _ZERO).any()
    for i in range(lamps.shape[0]):
        _add_diffuse(lamps[i], block, num)
        if shines:
            _add_highlights(lamps[i], block, num)
    dark = _ONE - ambient
    for i in range(num):
        specular, emission = block[_SPECULAR + i], block[_EMISSION + i]
        for channel in range(3):
            at = channel * _BLOCK + i
            light = ambient + dark * block[_DIFFUSE + at]
            share = emission + (_ONE - emission) * light
            colors[i, channel] = colors[i, channel] * share + specular * block[_HIGHLIGHT + at]


@called_from_python(parallel=True)
def _shade_all(
    faces, corner_colors, materials, texels, sizes, offsets, lamps, ambient,
    face, u, v, distance, directions, origins, mirrors, before, steps, workers, colors,
):  # fmt: skip
    """Colors all hits. Flat arguments: Numba's threads take no nested ones."""
    num = face.shape[0]
    blocks = (num + _BLOCK - 1) // _BLOCK
    for worker in prange(workers):
        world = faces, corner_colors, materials, (texels, sizes, offsets)
        lit = np.empty(_COLUMNS * _BLOCK, np.float32)
        # Every `workers`-th block, so that each thread gets of all parts of the image.
        for block in range(worker, blocks, workers):
            first, end = block * _BLOCK, min((block + 1) * _BLOCK, num)
            lit[:] = _ZERO
            for i in range(first, end):
                if face[i] < 0:
                    colors[i, 0] = colors[i, 1] = colors[i, 2] = _ZERO
                else:
                    direction = _three(directions, i, 0)
                    path = distance[i] + before[min(i, before.shape[0] - 1)]
                    mirror = _three(mirrors, min(i, mirrors.shape[0] - 1), 0)
                    color = _surface(world, face[i], u[i], v[i], path, direction, mirror, steps)
                    colors[i, 0], colors[i, 1], colors[i, 2] = color
                    if lamps.shape[0] > 0:
                        origin = _three(origins, min(i, origins.shape[0] - 1), 0)
                        _place(lit, i - first, world, face[i], origin, direction, distance[i])
            if lamps.shape[0] > 0:
                _light_block(lamps, ambient, lit, end - first, colors[first:end])
            for i in range(first, end):
                for channel in range(3):
                    colors[i, channel] = min(max(colors[i, channel], _ZERO), _ONE)


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
