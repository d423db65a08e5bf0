"""Colors of ray hits: textures, lamps, highlights; in machine code, on all cores.

The color c of a hit with surface color a (texture x material color x vertex color), normal n
turned towards the viewer, lamps i at distance d_i in direction l_i with half vector h_i
(Blinn, "Models of light reflection", 1977) is

    light_i = color_i / (1 + (d_i / reach_i)^2)
    c = a (e + (1 - e) (ambient + (1 - ambient) sum_i light_i max(0, n l_i)))
        + specular sum_i light_i max(0, n h_i)^shininess

with the emission e. A world without lamps shows a.

Textures: `filtering`.

Shape symbols: n rays; F faces; K materials; T textures; L lamps; S texels.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from pathlib import Path

import numpy as np
from numba import prange

from r3jax.kernels.native.arithmetic import exp2, fused, log2
from r3jax.kernels.native.compiled import (
    called_from_python,
    forget_outdated_code,
    in_wide_vectors,
    inlined,
    inlined_fused,
)
from r3jax.kernels.native.ffi import num_workers, require_threads
from r3jax.simulators.raycast.filtering import (
    BLOCK,
    COLOR,
    DIRECTION,
    FLOATS,
    GRADIENTS,
    MIRROR,
    NORMAL,
    PATH,
    PLACE,
    RAY,
    TEXTURE,
    WHOLES,
    dot,
    filter_block,
    three,
)
from r3jax.simulators.raycast.rays import Hits
from r3jax.simulators.raycast.shading_tables import ShadingTables

forget_outdated_code(Path(__file__).parent)

# Columns of a block's table, one after the other, so that LLVM sees how far apart they are.
_POSITION, _NORMAL, _VIEW = 0 * BLOCK, 3 * BLOCK, 6 * BLOCK
_SPECULAR, _SHININESS, _EMISSION, _DISTANCE = 9 * BLOCK, 10 * BLOCK, 11 * BLOCK, 12 * BLOCK
_DIFFUSE, _HIGHLIGHT = 13 * BLOCK, 16 * BLOCK
_COLUMNS = 19

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LEAST, _TINY = np.float32(1e-6), np.float32(1e-12)


@inlined
def _put(column, begin, i, vector):
    """Writes a vector into three columns that follow each other."""
    for axis in range(3):
        column[begin + axis * BLOCK + i] = vector[axis]


@inlined
def _row(table, i, begin):
    return table[i, begin], table[i, begin + 1], table[i, begin + 2]


@inlined_fused
def _ask_for_texture(floats, wholes, k, row, ray, hit):
    """Writes what the filtered color of a texture depends on."""
    texture, u, v, path, direction, mirror = hit
    wholes[RAY + k], wholes[TEXTURE + k] = ray, texture
    _put(floats, DIRECTION, k, direction)
    _put(floats, NORMAL, k, (row[12], row[13], row[14]))
    _put(floats, MIRROR, k, mirror)
    _put(floats, GRADIENTS, k, (row[6], row[7], row[8]))
    _put(floats, GRADIENTS + 3 * BLOCK, k, (row[9], row[10], row[11]))
    floats[PATH + k] = path
    floats[PLACE + k] = row[0] + u * row[2] + v * row[4]
    floats[PLACE + BLOCK + k] = row[1] + u * row[3] + v * row[5]


@inlined
def _ask_for_light(lit, i, row, look, origin, direction, distance):
    """Writes what the light at a hit depends on; `_turn` makes of it position and view."""
    _put(lit, _POSITION, i, origin)
    _put(lit, _NORMAL, i, (row[12], row[13], row[14]))
    _put(lit, _VIEW, i, direction)
    lit[_DISTANCE + i] = distance
    lit[_SPECULAR + i], lit[_SHININESS + i], lit[_EMISSION + i] = look


@inlined_fused
def _turn(lit, num):
    """Moves from the rays' origins to the hits, looks back along them, turns normals there."""
    in_wide_vectors()
    for i in range(num):
        direction, normal = three(lit, _VIEW, i), three(lit, _NORMAL, i)
        distance = lit[_DISTANCE + i]
        inverse = _ONE / max(math.sqrt(dot(direction, direction)), _LEAST)
        view = -direction[0] * inverse, -direction[1] * inverse, -direction[2] * inverse
        turned = -_ONE if dot(normal, view) < _ZERO else _ONE
        for axis in range(3):
            at = _POSITION + axis * BLOCK + i
            lit[at] = fused(distance, direction[axis], lit[at])
            lit[_NORMAL + axis * BLOCK + i] = turned * normal[axis]
            lit[_VIEW + axis * BLOCK + i] = view[axis]


@inlined_fused
def _towards(lamp, block, i):
    """Vector from a hit to a lamp, its squared length, and its part along the normal."""
    x = lamp[0] - block[_POSITION + i]
    y = lamp[1] - block[_POSITION + BLOCK + i]
    z = lamp[2] - block[_POSITION + 2 * BLOCK + i]
    n = block[_NORMAL + i], block[_NORMAL + BLOCK + i], block[_NORMAL + 2 * BLOCK + i]
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
        block[_DIFFUSE + BLOCK + i] += lamp[4] * light
        block[_DIFFUSE + 2 * BLOCK + i] += lamp[5] * light


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
            to_lamp[1] * scale + block[_VIEW + BLOCK + i],
            to_lamp[2] * scale + block[_VIEW + 2 * BLOCK + i],
        )
        along = dot(n, h)
        squared_cosine = along * along / max(dot(h, h), _TINY)
        power = _HALF * block[_SHININESS + i] * log2(max(squared_cosine, _TINY))
        is_lit = (towards > _ZERO) & (along > _ZERO)
        light = exp2(power) * reach / (reach + squared) if is_lit else _ZERO
        block[_HIGHLIGHT + i] += lamp[3] * light
        block[_HIGHLIGHT + BLOCK + i] += lamp[4] * light
        block[_HIGHLIGHT + 2 * BLOCK + i] += lamp[5] * light


@inlined_fused
def _light_block(lamps, ambient, block, num, colors):
    """The module's formula for a block of surface colors, in place; sums of light begin at 0."""
    shines = False
    for i in range(num):
        shines |= block[_SPECULAR + i] > _ZERO
    for i in range(lamps.shape[0]):
        _add_diffuse(lamps[i], block, num)
        if shines:
            _add_highlights(lamps[i], block, num)
    dark = _ONE - ambient
    for i in range(num):
        specular, emission = block[_SPECULAR + i], block[_EMISSION + i]
        for channel in range(3):
            at = channel * BLOCK + i
            light = ambient + dark * block[_DIFFUSE + at]
            share = emission + (_ONE - emission) * light
            colors[i, channel] = colors[i, channel] * share + specular * block[_HIGHLIGHT + at]


@inlined_fused
def _multiply_corner_colors(corner_colors, face, u, v, first, end, colors):
    """Multiplies colors by those of the vertices, in place."""
    for i in range(first, end):
        if face[i] >= 0:
            at, w = corner_colors[face[i]], _ONE - u[i] - v[i]
            for channel in range(3):
                color = w * at[channel] + u[i] * at[3 + channel] + v[i] * at[6 + channel]
                colors[i, channel] *= color


@called_from_python(parallel=True)
def _shade_all(
    faces, corner_colors, materials, texels, sizes, offsets, lamps, ambient,
    face, u, v, distance, directions, origins, mirrors, before, steps, workers, colors,
):  # fmt: skip
    """Colors all hits. Flat arguments: Numba's threads take no nested ones."""
    num, has_lamps = face.shape[0], lamps.shape[0] > 0
    blocks = (num + BLOCK - 1) // BLOCK
    for worker in prange(workers):
        floats, wholes = np.zeros(FLOATS * BLOCK, np.float32), np.zeros(WHOLES * BLOCK, np.int32)
        lit = np.zeros(_COLUMNS * BLOCK, np.float32)
        # Every `workers`-th block, so that each thread gets of all parts of the image.
        for block in range(worker, blocks, workers):
            first, end, textured = block * BLOCK, min((block + 1) * BLOCK, num), 0
            # Element by element, as everywhere here: as arrays they take long to compile.
            for i in range(lit.shape[0]):
                lit[i] = _ZERO
            for i in range(first, end):
                for channel in range(3):
                    colors[i, channel] = _ZERO
                if face[i] >= 0:
                    row, direction = faces[face[i]], _row(directions, i, 0)
                    material = np.int64(row[15])
                    albedo, texture = _row(materials, material, 0), np.int32(materials[material, 6])
                    colors[i, 0], colors[i, 1], colors[i, 2] = albedo
                    if texture >= 0:
                        path = distance[i] + before[min(i, before.shape[0] - 1)]
                        mirror = _row(mirrors, min(i, mirrors.shape[0] - 1), 0)
                        hit = texture, u[i], v[i], path, direction, mirror
                        _ask_for_texture(floats, wholes, textured, row, np.int32(i - first), hit)
                        textured += 1
                    if has_lamps:
                        origin = _row(origins, min(i, origins.shape[0] - 1), 0)
                        look = _row(materials, material, 3)
                        _ask_for_light(lit, i - first, row, look, origin, direction, distance[i])
            filter_block(floats, wholes, (texels, sizes, offsets), steps, textured)
            for k in range(textured):
                ray = first + wholes[RAY + k]
                for channel in range(3):
                    colors[ray, channel] *= floats[COLOR + channel * BLOCK + k]
            if corner_colors.shape[0] > 0:
                _multiply_corner_colors(corner_colors, face, u, v, first, end, colors)
            if has_lamps:
                _turn(lit, BLOCK)
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
