"""Where the pixels of depth buffers lie: all levels of an image pyramid in one flat array.

The levels lie one below the other, rows of all of them `stride_of(side)` apart, where the side is
the least power of two that holds the image. Each has a border of `RING` pixels on all sides, so
that what falls just outside of the image needs no test where it is written or read.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from r3jax.kernels.native.compiled import inlined, kernel

RING = 2
"""Pixels of the border: a voxel just outside covers the first two."""


@inlined
def side_of(shape):
    """Computes the least power of two that holds an image."""
    side = 1
    while side < max(shape[0], shape[1]):
        side *= 2
    return side


@inlined
def num_levels(side):
    """Counts the levels of a pyramid, down to a single pixel."""
    levels = 1
    while side > 1:
        side, levels = side >> 1, levels + 1
    return levels


@inlined
def stride_of(side):
    """Computes the places from a pixel to the one below."""
    return side + 2 * RING


@inlined
def begin_of(level, side):
    """Computes the place of the first pixel of a level; works with floats, too."""
    rows = 2 * (side - (side >> level)) + 2 * RING * level
    return (rows + RING) * stride_of(side) + RING


@inlined
def picture_size(side):
    """Returns the number of places in the finest level."""
    return stride_of(side) * stride_of(side)


@inlined
def pyramid_size(side):
    """Returns the number of places in all levels."""
    return (2 * side + 2 * RING * num_levels(side)) * stride_of(side)


@inlined
def shape_of(shape, level):
    """Computes the height and width of a level.

    Both are rounded up, so that every finer pixel has a parent.
    """
    above = (1 << level) - 1
    return (shape[0] + above) >> level, (shape[1] + above) >> level


@inlined
def wrap_pixel(row, column, shape, wraps):
    """Maps a pixel just outside the image to where it continues (`visibility.views.wrap`).

    On an octahedral map, whose borders are glued to themselves, the one that it is glued to; in
    other images the nearest one.
    """
    height, width = shape
    if wraps:
        crosses_column, crosses_row = (column < 0) | (column >= width), (row < 0) | (row >= height)
        row, column = (
            height - 1 - row if crosses_column else row,
            width - 1 - column if crosses_row else column,
        )
    return min(max(row, 0), height - 1), min(max(column, 0), width - 1)


@inlined
def _ring_pixel(i, shape):
    """Computes the row and column of the i-th pixel one step outside of an image."""
    height, width = shape
    if i < 2 * (width + 2):
        return (height if i & 1 else -1), (i >> 1) - 1
    i -= 2 * (width + 2)
    return i >> 1, (width if i & 1 else -1)


@kernel
def fold_ring(pixels, begin, stride, shape):
    """Takes what was written one step outside of an octahedral map over into it."""
    for i in range(2 * (shape[0] + shape[1] + 2)):
        row, column = _ring_pixel(i, shape)
        to_row, to_column = wrap_pixel(row, column, shape, True)
        at = begin + to_row * stride + to_column
        pixels[at] = min(pixels[at], pixels[begin + row * stride + column])


@kernel
def fill_ring(pixels, begin, stride, shape, wraps):
    """Writes into the pixels one step outside of an image what they stand for."""
    for i in range(2 * (shape[0] + shape[1] + 2)):
        row, column = _ring_pixel(i, shape)
        from_row, from_column = wrap_pixel(row, column, shape, wraps)
        pixels[begin + row * stride + column] = pixels[begin + from_row * stride + from_column]


@kernel
def push_down(pixels, side, shape, wraps):
    """Leaves the least value over all levels at the finest."""
    stride = stride_of(side)
    for level in range(num_levels(side) - 1, -1, -1):
        begin, here = begin_of(level, side), shape_of(shape, level)
        if wraps:
            fold_ring(pixels, begin, stride, here)
        if side >> level > 1:
            above = begin_of(level + 1, side)
            for r in range(here[0]):
                fine, coarse = begin + r * stride, above + (r >> 1) * stride
                _take_over(pixels[fine : fine + here[1]], pixels[coarse : coarse + side])


@inlined
def _take_over(fine, coarse):
    """Takes a row of the coarser level over into two pixels each."""
    width = fine.shape[0]
    for c in range(width >> 1):
        value = coarse[c]
        fine[2 * c], fine[2 * c + 1] = min(fine[2 * c], value), min(fine[2 * c + 1], value)
    if width & 1:
        fine[width - 1] = min(fine[width - 1], coarse[width >> 1])
