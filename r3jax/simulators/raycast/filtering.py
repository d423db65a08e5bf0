"""Textures where rays meet them, filtered: a block of rays at a time, step by step.

Trilinear, with PROBES samples along the longer axis of the pixel's footprint: isotropic mip maps
would blur floors and walls seen at a low angle. Each step is a loop over a block's columns, which
LLVM turns into vectors; only texels are fetched one by one.

Shape symbols: T textures; S texels.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels.native.arithmetic import floor, fused, log2, whole
from r3jax.kernels.native.compiled import in_wide_vectors, inlined, inlined_fused
from r3jax.simulators.raycast.shading_tables import MAX_LEVELS

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
    """Scalar product of two vectors, fused in one order: the same bits wherever it is inlined."""
    return fused(a[2], b[2], fused(a[0], b[0], a[1] * b[1]))


@inlined_fused
def dot_in_turn(a, b):
    """The same from the first coordinate on: where images have always had it so."""
    return fused(a[2], b[2], fused(a[1], b[1], a[0] * b[0]))


@inlined_fused
def three(column, begin, i):
    """A vector in three columns that follow each other."""
    return column[begin + i], column[begin + BLOCK + i], column[begin + 2 * BLOCK + i]


@inlined_fused
def _moved(step, mirror, normal, per_along, direction, path, gradients):
    """How far, in texels, a hit moves when the pixel moves by one column or row.

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
    """The footprint of each pixel: its longer axis in texels, the mip levels, how far to probe."""
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
    """The texel, 0 to size - 1, that a texture which repeats shows at a whole number."""
    number, length = np.float32(first), np.float32(size)
    # Remainders of vectors are taken in floats; one step mends what rounding has spoiled.
    at = np.int32(first - np.int32(whole(floor(number / length)) * size))
    at = np.int32(at + size) if at < 0 else at
    at = np.int32(at - size) if at >= size else at
    return min(max(at, np.int32(0)), np.int32(size - 1))


@inlined_fused
def _pair(x, size):
    """The two texels next to x of a texture that repeats, and the second one's weight."""
    low = floor(x)
    first = _wrapped(whole(low), size)
    second = np.int32(first + 1)
    return first, (second if second < size else np.int32(0)), x - low


@inlined
def _find_levels(floats, wholes, atlas, num, coarser):
    """Where each ray's mip level begins, and the size of its texture: looked up one by one."""
    sizes, offsets = atlas
    for i in range(num):
        texture = np.uint32(wholes[TEXTURE + i])
        wholes[_SIZE + i], wholes[_SIZE + BLOCK + i] = sizes[texture, 0], sizes[texture, 1]
        k = min(np.int64(floats[_FINE + i]) + coarser, MAX_LEVELS - 1)
        wholes[_START + i] = offsets[texture, np.uint32(k)]


@inlined_fused
def _choose(floats, wholes, num, coarser, probe):
    """The four texels round one sample of each ray, and their weights."""
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
    """Filtered colors in [0, 1] of the textures that a block of rays meets.

    Args:
        floats: columns with directions, normals, mirrors, gradients, paths and places;
            written: COLOR.
        wholes: columns with the textures.
        atlas: texels [S], sizes and offsets of the textures.
        steps: change of the camera's ray from one column, and one row, to the next [2, 3].
        num: rays.
    """
    texels, sizes, offsets = atlas
    # Whole vectors: what lies beyond is of the block before, and nobody asks for it.
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
