"""Colors of ray hits: textures, lamps, highlights; in machine code, on all cores.

The color c of a hit with surface color a (texture x material color x vertex color), normal n
turned towards the viewer, lamps i at distance d_i in direction l_i with half vector h_i
(Blinn, "Models of light reflection", 1977) is

    light_i = color_i / (1 + (d_i / reach_i)^2)
    c = a (e + (1 - e) (ambient + (1 - ambient) sum_i light_i max(0, n l_i)))
        + specular sum_i light_i max(0, n h_i)^shininess

with the emission e. A world without lamps shows a.

Textures are trilinear, with PROBES samples along the longer axis of the pixel's footprint:
isotropic mip maps would blur floors and walls seen at a low angle. Each step is a loop over a
block's columns, which LLVM turns into vectors; only texels are fetched one by one.

Directions of rays are the pixels' own, turned to where the camera looks, and more inside pixels.
They are not made by a product of matrices in NumPy: the threads of its linear algebra wait for the
next product by spinning, and take one of two cores from everything that follows.

Shape symbols: n rays; m pixels; S rays inside a pixel, or texels; F faces; K materials; T textures;
L lamps.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math
from pathlib import Path

import numpy as np
from numba import prange

from r3jax.kernels.native.arithmetic import exp2, floor, fused, log2, whole
from r3jax.kernels.native.compiled import (
    called_from_python,
    forget_outdated_code,
    in_wide_vectors,
    inlined,
    inlined_fused,
)
from r3jax.kernels.native.ffi import num_workers, require_threads
from r3jax.simulators.raycast.rays import Hits
from r3jax.simulators.raycast.shading_tables import MAX_LEVELS, ShadingTables

_EDGE_CONTRAST = np.float32(12.0 / 255.0)
"""Neighbors that differ by less in every channel get no more rays: with a third of this, half as
many rays again gain 0.2 dB at 40 dB."""


def turned(directions: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Turns `directions` [n, 3] by `rotation` [3, 3], both float32."""
    require_threads()
    there = np.empty_like(directions)
    _turn_all(directions, rotation, num_workers(), there)
    return there


@called_from_python(parallel=True)
def _turn_all(directions, rotation, workers, there):
    num = directions.shape[0]
    for worker in prange(workers):
        for i in range(worker * num // workers, (worker + 1) * num // workers):
            for axis in range(3):
                # Fused one by one, as every library's product of matrices does: the same images.
                along = rotation[axis, 0] * directions[i, 0]
                along = fused(rotation[axis, 1], directions[i, 1], along)
                there[i, axis] = fused(rotation[axis, 2], directions[i, 2], along)


def inside(directions: np.ndarray, pixels: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Computes directions of the rays inside pixels, [m S, 3], those of a pixel together.

    Args:
        directions: of the rays through the centers of all pixels [n, 3].
        pixels: which of them [m].
        shifts: from a center to the places inside a pixel [S, 3].
    """
    require_threads()
    rays = np.empty((len(pixels) * len(shifts), 3), np.float32)
    _spread_all(directions, pixels, shifts, num_workers(), rays)
    return rays


@called_from_python(parallel=True)
def _spread_all(directions, pixels, shifts, workers, rays):
    num, each = pixels.shape[0], shifts.shape[0]
    for worker in prange(workers):
        for k in range(worker * num // workers, (worker + 1) * num // workers):
            for s in range(each):
                for axis in range(3):
                    rays[k * each + s, axis] = directions[pixels[k], axis] + shifts[s, axis]


def average(image: np.ndarray, pixels: np.ndarray, colors: np.ndarray) -> None:
    """Averages the colors of some pixels over more rays, in place.

    Args:
        image: colors of the centers of all pixels [n, 3].
        pixels: which of them [m].
        colors: of the rays inside them [m S, 3], as `inside` has them.
    """
    require_threads()
    _average_all(image, pixels, colors, num_workers())


@called_from_python(parallel=True)
def _average_all(image, pixels, colors, workers):
    num = pixels.shape[0]
    each = colors.shape[0] // num
    for worker in prange(workers):
        for k in range(worker * num // workers, (worker + 1) * num // workers):
            for channel in range(3):
                total = colors[k * each, channel]
                for s in range(1, each):
                    total += colors[k * each + s, channel]
                whole = image[pixels[k], channel] + total
                image[pixels[k], channel] = whole / np.float32(each + 1)


@inlined
def _differ(image, face, row, column, next_row, next_column):
    """Checks whether two pixels show different faces in different colors."""
    if face[row, column] == face[next_row, next_column]:
        return False
    contrast = np.float32(0.0)
    for channel in range(3):
        step = abs(image[row, column, channel] - image[next_row, next_column, channel])
        contrast = max(contrast, step)
    return contrast > _EDGE_CONTRAST


@called_from_python()
def find_edges(image, face, is_edge):
    """Marks pixels that show another face in another color than a pixel beside them, [H, W]."""
    height, width = face.shape
    for i in range(height):
        for j in range(width):
            if j + 1 < width and _differ(image, face, i, j, i, j + 1):
                is_edge[i, j] = is_edge[i, j + 1] = True
            if i + 1 < height and _differ(image, face, i, j, i + 1, j):
                is_edge[i, j] = is_edge[i + 1, j] = True


PROBES = 2
"""Trilinear samples along the longer axis of a footprint."""

LEVEL_BIAS = np.float32(-0.5)
"""Added to the mip level. Measured against 64 rays a pixel on a furnished house: with two probes
and this bias the images are nearest (37.8 dB; 37.4 without bias, 36.2 with one probe)."""

BLOCK = 1 << 7
"""Rays that go through the steps together: their columns fit into the nearest cache."""

# Columns of a block's table, one after the other, so that LLVM sees how far apart they are.
DIRECTION, NORMAL, MIRROR, GRADIENTS = 0 * BLOCK, 3 * BLOCK, 6 * BLOCK, 9 * BLOCK
PATH, PLACE, COLOR = 15 * BLOCK, 16 * BLOCK, 18 * BLOCK
_AXIS, _SPREAD, _FINE, _BLEND = 21 * BLOCK, 23 * BLOCK, 24 * BLOCK, 25 * BLOCK
_RIGHT, _BELOW, _SHARE = 26 * BLOCK, 27 * BLOCK, 28 * BLOCK
FLOATS = 29
"""Columns of floats."""

RAY, TEXTURE, _SIZE, _START, _TEXEL = 0 * BLOCK, 1 * BLOCK, 2 * BLOCK, 4 * BLOCK, 5 * BLOCK
WHOLES = 9
"""Columns of whole numbers."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_LEAST, _TINY = np.float32(1e-6), np.float32(1e-12)
_PER_SAMPLE = np.float32(1.0 / (255.0 * PROBES))
_LANES = 16


@inlined_fused
def dot(a, b):
    """Computes the scalar product of two vectors, fused in one order.

    The bits are the same wherever it is inlined.
    """
    return fused(a[2], b[2], fused(a[0], b[0], a[1] * b[1]))


@inlined_fused
def dot_in_turn(a, b):
    """Computes `dot` from the first coordinate on, the order that images have always had."""
    return fused(a[2], b[2], fused(a[1], b[1], a[0] * b[0]))


@inlined_fused
def three(column, begin, i):
    """Reads a vector from three columns that follow each other."""
    return column[begin + i], column[begin + BLOCK + i], column[begin + 2 * BLOCK + i]


@inlined_fused
def _moved(step, mirror, normal, per_along, direction, path, gradients):
    """Computes by how many texels a hit moves when the pixel moves by one column or row.

    With the plane's normal n and direction d, a change e of the direction moves the hit by
    t (e - d (n e) / (n d)) (Igehy, "Tracing ray differentials", 1999). A mirror reflects e.
    """
    twice = _TWO * dot(mirror, step)
    e = step[0] - twice * mirror[0], step[1] - twice * mirror[1], step[2] - twice * mirror[2]
    slide = dot(normal, e) * per_along
    move = (
        path * (e[0] - direction[0] * slide), path * (e[1] - direction[1] * slide),
        path * (e[2] - direction[2] * slide),
    )  # fmt: skip
    return dot(gradients[0], move), dot(gradients[1], move)


@inlined_fused
def _measure(floats, steps, num):
    """Measures each pixel's footprint: longer axis in texels, mip levels, how far to probe."""
    in_wide_vectors()
    right = steps[0, 0], steps[0, 1], steps[0, 2]
    down = steps[1, 0], steps[1, 1], steps[1, 2]
    for i in range(num):
        direction, normal = three(floats, DIRECTION, i), three(floats, NORMAL, i)
        mirror, path = three(floats, MIRROR, i), floats[PATH + i]
        gradients = three(floats, GRADIENTS, i), three(floats, GRADIENTS + 3 * BLOCK, i)
        along = dot_in_turn(normal, direction)
        per_along = _ONE / (_LEAST if abs(along) < _LEAST else along)
        a = _moved(right, mirror, normal, per_along, direction, path, gradients)
        b = _moved(down, mirror, normal, per_along, direction, path, gradients)
        squared_a, squared_b = a[0] * a[0] + a[1] * a[1], b[0] * b[0] + b[1] * b[1]
        is_first = squared_a >= squared_b
        floats[_AXIS + i] = a[0] if is_first else b[0]
        floats[_AXIS + BLOCK + i] = a[1] if is_first else b[1]
        longer, shorter = max(squared_a, squared_b), min(squared_a, squared_b)
        sampled = max(longer * np.float32(1.0 / PROBES**2), shorter, _TINY)
        level = min(max(_HALF * log2(sampled) + LEVEL_BIAS, _ZERO), np.float32(MAX_LEVELS - 1))
        fine = floor(level)
        floats[_FINE + i], floats[_BLEND + i] = fine, level - fine
        # Probes spread only as far as the footprint is longer than wide.
        floats[_SPREAD + i] = _ONE - min(math.sqrt(shorter / max(longer, _TINY)), _ONE)


@inlined_fused
def _wrapped(first, size):
    """Wraps a whole number to a texel, 0 to size - 1, of a texture that repeats."""
    number, length = np.float32(first), np.float32(size)
    # Remainders of vectors are taken in floats; one step mends what rounding has spoiled.
    at = np.int32(first - np.int32(whole(floor(number / length)) * size))
    at = np.int32(at + size) if at < 0 else at
    at = np.int32(at - size) if at >= size else at
    return min(max(at, np.int32(0)), np.int32(size - 1))


@inlined_fused
def _pair(x, size):
    """Finds the two texels next to x of a texture that repeats, and the second one's weight."""
    low = floor(x)
    first = _wrapped(whole(low), size)
    second = np.int32(first + 1)
    return first, (second if second < size else np.int32(0)), x - low


@inlined
def _find_levels(floats, wholes, atlas, num, coarser):
    """Finds where each ray's mip level begins, and the size of its texture, one by one."""
    sizes, offsets = atlas
    for i in range(num):
        texture = np.uint32(wholes[TEXTURE + i])
        wholes[_SIZE + i], wholes[_SIZE + BLOCK + i] = sizes[texture, 0], sizes[texture, 1]
        k = min(np.int64(floats[_FINE + i]) + coarser, MAX_LEVELS - 1)
        wholes[_START + i] = offsets[texture, np.uint32(k)]


@inlined_fused
def _choose(floats, wholes, num, coarser, probe):
    """Chooses the four texels round one sample of each ray, and their weights."""
    in_wide_vectors()
    for i in range(num):
        width, height = wholes[_SIZE + i], wholes[_SIZE + BLOCK + i]
        k = np.int32(min(floats[_FINE + i] + np.float32(coarser), np.float32(MAX_LEVELS - 1)))
        columns = max(np.int32(width >> k), np.int32(1))
        rows = max(np.int32(height >> k), np.int32(1))
        per_width, per_height = _ONE / np.float32(width), _ONE / np.float32(height)
        scale_x, scale_y = np.float32(columns) * per_width, np.float32(rows) * per_height
        blend = floats[_BLEND + i]
        floats[_SHARE + i] = (blend if coarser == 1 else _ONE - blend) * _PER_SAMPLE
        shift = ((np.float32(probe) + _HALF) / np.float32(PROBES) - _HALF) * floats[_SPREAD + i]
        x = floats[PLACE + i] + shift * floats[_AXIS + i]
        y = floats[PLACE + BLOCK + i] + shift * floats[_AXIS + BLOCK + i]
        i0, i1, floats[_RIGHT + i] = _pair(x * scale_x - _HALF, columns)
        j0, j1, floats[_BELOW + i] = _pair(y * scale_y - _HALF, rows)
        top = np.int32(wholes[_START + i] + np.int32(j0 * columns))
        bottom = np.int32(wholes[_START + i] + np.int32(j1 * columns))
        wholes[_TEXEL + i], wholes[_TEXEL + BLOCK + i] = top + i0, top + i1
        wholes[_TEXEL + 2 * BLOCK + i], wholes[_TEXEL + 3 * BLOCK + i] = bottom + i0, bottom + i1


@inlined_fused
def _fetch(wholes, texels, num):
    """Puts texels in the place of their numbers."""
    for corner in range(4):
        for i in range(num):
            at = _TEXEL + corner * BLOCK + i
            wholes[at] = np.int32(texels[np.uint32(wholes[at])])


@inlined_fused
def _add_texel(packed, weight, color):
    return (
        color[0] + weight * np.float32(np.int32(packed & 255)),
        color[1] + weight * np.float32(np.int32((packed >> 8) & 255)),
        color[2] + weight * np.float32(np.int32((packed >> 16) & 255)),
    )


@inlined_fused
def _add_sample(floats, wholes, num):
    """Adds the four texels round one sample of each ray."""
    in_wide_vectors()
    for i in range(num):
        share, fx, fy = floats[_SHARE + i], floats[_RIGHT + i], floats[_BELOW + i]
        upper, lower = share * (_ONE - fy), share * fy
        c = three(floats, COLOR, i)
        c = _add_texel(wholes[_TEXEL + i], upper * (_ONE - fx), c)
        c = _add_texel(wholes[_TEXEL + BLOCK + i], upper * fx, c)
        c = _add_texel(wholes[_TEXEL + 2 * BLOCK + i], lower * (_ONE - fx), c)
        c = _add_texel(wholes[_TEXEL + 3 * BLOCK + i], lower * fx, c)
        floats[COLOR + i], floats[COLOR + BLOCK + i], floats[COLOR + 2 * BLOCK + i] = c


@inlined_fused
def filter_block(floats, wholes, atlas, steps, num):
    """Filters the textures that a block of rays meets, to colors in [0, 1].

    Args:
        floats: columns with directions, normals, mirrors, gradients, paths and places;
            written: COLOR.
        wholes: columns with the textures.
        atlas: texels [S], sizes and offsets of the textures.
        steps: change of the camera's ray from one column, and one row, to the next [2, 3].
        num: rays.
    """
    texels, sizes, offsets = atlas
    # Whole vectors: values beyond `num` are left over from the block before, and never read.
    num = (num + _LANES - 1) // _LANES * _LANES
    _measure(floats, steps, num)
    for i in range(3 * BLOCK):
        floats[COLOR + i] = _ZERO
    blends = False
    for i in range(num):
        blends |= floats[_BLEND + i] > _ZERO
    # Between two levels; magnified textures have but one.
    for coarser in range(2 if blends else 1):
        _find_levels(floats, wholes, (sizes, offsets), num, coarser)
        for probe in range(PROBES):
            _choose(floats, wholes, num, coarser, probe)
            _fetch(wholes, texels, num)
            _add_sample(floats, wholes, num)


forget_outdated_code(Path(__file__).parent)

# Columns of a block's table, one after the other, so that LLVM sees how far apart they are.
_POSITION, _NORMAL, _VIEW = 0 * BLOCK, 3 * BLOCK, 6 * BLOCK
_SPECULAR, _SHININESS, _EMISSION, _DISTANCE = 9 * BLOCK, 10 * BLOCK, 11 * BLOCK, 12 * BLOCK
_DIFFUSE, _HIGHLIGHT = 13 * BLOCK, 16 * BLOCK
_COLUMNS = 19


@inlined
def _put(column, begin, i, vector):
    """Writes a vector into three columns that follow each other."""
    for axis in range(3):
        column[begin + axis * BLOCK + i] = vector[axis]


@inlined
def _row(table, i, begin):
    return table[i, begin], table[i, begin + 1], table[i, begin + 2]


@inlined_fused
def _queue_texture(floats, wholes, k, row, ray, hit):
    """Queues a texture lookup: stores its inputs in the table of the block."""
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
def _queue_light(lit, i, row, shine, origin, direction, distance):
    """Queues the light at a hit: stores its inputs, which `_turn` converts to position and view."""
    _put(lit, _POSITION, i, origin)
    _put(lit, _NORMAL, i, (row[12], row[13], row[14]))
    _put(lit, _VIEW, i, direction)
    lit[_DISTANCE + i] = distance
    lit[_SPECULAR + i], lit[_SHININESS + i], lit[_EMISSION + i] = shine


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
    """Computes the vector from a hit to a lamp, its squared length, its part along the normal."""
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
    """Lights a block of surface colors in place by the module's formula; sums begin at 0."""
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
    """Colors all hits. The arguments are flat: Numba's threads take no nested ones."""
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
                        _queue_texture(floats, wholes, textured, row, np.int32(i - first), hit)
                        textured += 1
                    if has_lamps:
                        origin = _row(origins, min(i, origins.shape[0] - 1), 0)
                        shine = _row(materials, material, 3)
                        _queue_light(lit, i - first, row, shine, origin, direction, distance[i])
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
    """Computes the colors of hits in [0, 1], black where nothing was hit, [n, 3] float32.

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
    # One layout and writable, whatever the caller's are: every other one is compiled.
    per_ray = [np.require(column, requirements=("C", "W")) for column in columns]
    colors = np.empty((len(hits.face), 3), np.float32)
    _shade_all(
        tables.faces, tables.corner_colors, tables.materials, tables.texels, tables.sizes,
        tables.offsets, tables.lamps, tables.ambient,
        *per_ray, pixel_steps, num_workers(), colors,
    )  # fmt: skip
    return colors
