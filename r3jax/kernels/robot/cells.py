"""Lines, floods and windows over the cells of a grid, in machine code.

Shape symbols: X Y Z cells along the axes; n points or cells.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

import numpy as np

from r3jax.kernels.native.platform import compiled_or_plain

BORDER = 1e-3
"""A segment that passes a corner closer than this counts as touching it [cells]."""


@compiled_or_plain
def segment_cells(a, b):
    """Lists the cells that a segment between two points [cells] touches, [n, 3], repeated."""
    num = 2
    for axis in range(3):
        low, high = min(a[axis], b[axis]), max(a[axis], b[axis])
        num += 8 * max(math.ceil(high) - math.floor(low) - 1, 0)
    cells = np.empty((num, 3), np.int64)
    for i in range(3):
        cells[0, i], cells[1, i] = math.floor(a[i]), math.floor(b[i])
    num = 2
    # Only where a segment passes a plane between two layers does it change cells.
    for axis in range(3):
        low, high = min(a[axis], b[axis]), max(a[axis], b[axis])
        for layer in range(math.floor(low) + 1, math.ceil(high)):
            t = (layer - a[axis]) / (b[axis] - a[axis])
            # On both sides of the plane, and of any other plane that is as good as touched.
            for corner in range(8):
                for i in range(3):
                    side = BORDER if corner >> i & 1 else -BORDER
                    cells[num, i] = math.floor(a[i] + t * (b[i] - a[i]) + side)
                num += 1
    return cells


@compiled_or_plain
def segments_are_inside(mask, a, b):
    """Finds which segments from one point to others run through cells of a mask only.

    Args:
        mask: [X, Y, Z] bool; beyond the array nothing is in the mask.
        a: where all begin, in cells (cell (0, 0, 0) spans 0 to 1), [3].
        b: the other ends, [n, 3].

    Returns:
        [n] bool; corners that a segment touches count.
    """
    inside = np.empty(b.shape[0], np.bool_)
    for k in range(b.shape[0]):
        cells = segment_cells(a, b[k])
        inside[k] = True
        for i in range(cells.shape[0]):
            x, y, z = cells[i]
            is_cell = (x >= 0) & (y >= 0) & (z >= 0)
            is_cell &= (x < mask.shape[0]) & (y < mask.shape[1]) & (z < mask.shape[2])
            if not (is_cell and mask[x, y, z]):
                inside[k] = False
                break
    return inside


@compiled_or_plain
def flood(mask, seeds):
    """Finds the regions of a mask, connected over faces, that hold at least one seed.

    Args:
        mask: [X, Y, Z] bool.
        seeds: [X, Y, Z] bool; those outside the mask are ignored.

    Returns:
        [X, Y, Z] bool.
    """
    along_y, along_x = mask.shape[2] + 2, (mask.shape[1] + 2) * (mask.shape[2] + 2)
    steps = (-along_x, along_x, -along_y, along_y, -1, 1)
    # A border that is not in the mask: no step needs to be checked against the edges.
    is_dry = np.zeros((mask.shape[0] + 2) * along_x, np.bool_)
    is_wet = np.zeros(mask.shape, np.bool_)
    stack, num = np.empty(mask.size, np.int64), 0
    for x in range(mask.shape[0]):
        for y in range(mask.shape[1]):
            for z in range(mask.shape[2]):
                here = (x + 1) * along_x + (y + 1) * along_y + z + 1
                is_dry[here] = mask[x, y, z] and not seeds[x, y, z]
                if mask[x, y, z] and seeds[x, y, z]:
                    stack[num] = here
                    num += 1
    while num > 0:
        num -= 1
        here = stack[num]
        x, y = here // along_x - 1, here % along_x // along_y - 1
        is_wet[x, y, here % along_y - 1] = True
        for step in steps:
            # Wet as soon as it is on the stack, so that none is there twice.
            if is_dry[here + step]:
                is_dry[here + step] = False
                stack[num] = here + step
                num += 1
    return is_wet


@compiled_or_plain
def nearest_in_ring(mask, middle, reach, cell_size, closest, farthest, most):
    """Finds the cells of a mask nearest to a cell, and of these those in a range of distances.

    Args:
        mask: [X, Y, Z] bool.
        middle: index of a cell, [3].
        reach: half the edge of the window [cells].
        cell_size: edge of a cell [m].
        closest: least distance between centers [m].
        farthest: greatest distance [m].
        most: how many of the nearest count, in range or not.

    Returns:
        Indices [n, 3], the nearest first; of equals the first in the order of the array.
    """
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        low[axis] = max(middle[axis] - reach, 0)
        high[axis] = min(middle[axis] + reach + 1, mask.shape[axis])
    # Sorted by counting: squares of distances are small integers.
    begins = np.zeros(3 * reach * reach + 2, np.int64)
    found = np.empty((most, 3), np.int64)
    for is_second in range(2):
        for x in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                for z in range(low[2], high[2]):
                    if mask[x, y, z]:
                        dx, dy, dz = x - middle[0], y - middle[1], z - middle[2]
                        square = dx * dx + dy * dy + dz * dz
                        if is_second == 0:
                            begins[square + 1] += 1
                        else:
                            at = begins[square]
                            if at < most:
                                found[at, 0], found[at, 1], found[at, 2] = x, y, z
                            begins[square] += 1
        if is_second == 0:
            for square in range(1, begins.shape[0]):
                begins[square] += begins[square - 1]
    num = 0
    for i in range(min(begins[-1], most)):
        dx, dy, dz = found[i, 0] - middle[0], found[i, 1] - middle[1], found[i, 2] - middle[2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz) * cell_size
        if (distance >= closest) & (distance <= farthest):
            # By its numbers: Numba takes a second to compile an array's assignment to another.
            for axis in range(3):
                found[num, axis] = found[i, axis]
            num += 1
    return found[:num]


@compiled_or_plain
def walk_rays(starts, ends, is_hit, kind, nearest):
    """Marks the cells that rays end in or pass (Amanatides and Woo 1987).

    Args:
        starts: where rays begin [cells], [n, 3].
        ends: where they end [cells], [n, 3].
        is_hit: whether there is something at the end, [n] bool.
        kind: is set to 2 where a ray hits, else to 1 where one passes, [X, Y, Z] int8.
        nearest: is lowered to the least distance from a start to such a cell [cells], [X, Y, Z].
    """
    for i in range(starts.shape[0]):
        length = 0.0
        for axis in range(3):
            length += (ends[i, axis] - starts[i, axis]) ** 2
        length = math.sqrt(length)
        if not (0.0 < length < 1e6):  # NaN, too
            continue
        # What lies within a quarter of a cell before the hit is not passed.
        last = length - 0.25 if is_hit[i] else length
        t = 0.0
        while t < last:
            # Through the middle of the piece up to the next border: its cell, in any rounding.
            piece = last - t
            for axis in range(3):
                d = (ends[i, axis] - starts[i, axis]) / length
                if d != 0.0:
                    here = starts[i, axis] + t * d
                    border = (
                        math.floor(here + 1e-9) + 1.0 if d > 0.0 else math.ceil(here - 1e-9) - 1.0
                    )
                    piece = min(piece, max((border - here) / d, 1e-9))
            middle = t + 0.5 * piece
            x = math.floor(starts[i, 0] + middle * (ends[i, 0] - starts[i, 0]) / length)
            y = math.floor(starts[i, 1] + middle * (ends[i, 1] - starts[i, 1]) / length)
            z = math.floor(starts[i, 2] + middle * (ends[i, 2] - starts[i, 2]) / length)
            is_cell = (x >= 0) & (y >= 0) & (z >= 0)
            is_cell &= (x < kind.shape[0]) & (y < kind.shape[1]) & (z < kind.shape[2])
            if is_cell and piece >= 0.5:
                kind[x, y, z] = max(kind[x, y, z], 1)
                nearest[x, y, z] = min(nearest[x, y, z], middle)
            t += piece
        if is_hit[i]:
            x, y, z = math.floor(ends[i, 0]), math.floor(ends[i, 1]), math.floor(ends[i, 2])
            is_cell = (x >= 0) & (y >= 0) & (z >= 0)
            is_cell &= (x < kind.shape[0]) & (y < kind.shape[1]) & (z < kind.shape[2])
            if is_cell:
                kind[x, y, z] = 2
                nearest[x, y, z] = min(nearest[x, y, z], length)
