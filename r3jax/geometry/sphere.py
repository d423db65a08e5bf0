"""Directions on the unit sphere: the Fibonacci lattice, nearest bins, fields of view.

Shape symbols: B directions of a lattice; n query directions; S cells along an octahedral map.
"""

import functools
import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.errors import InputError

GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0


@functools.cache
def _lattice(num: int) -> np.ndarray:
    # In double precision: the azimuth grows with k, and float32 would lose digits of its turn.
    k = np.arange(num, dtype=np.float64)
    # The half step keeps the first and the last point off the poles, where azimuth is undefined.
    z = 1.0 - 2.0 * (k + 0.5) / num
    azimuth = 2.0 * np.pi * k / GOLDEN_RATIO
    radius = np.sqrt(1.0 - z * z)
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    # Cached and shared by all callers: it must stay read-only.
    points.flags.writeable = False
    return points


def fibonacci_lattice(num: int) -> np.ndarray:
    """Computes `num` nearly even unit directions, [num, 3] float64.

    z_k = 1 - 2 (k + 0.5) / num, azimuth 2 pi k / golden ratio, k = 0..num-1 (arXiv 2601.07484,
    whose k = 1..num would leave the sphere).
    """
    if num < 1:
        raise InputError(f"a lattice needs at least one direction, got {num}")
    return _lattice(num)


def octahedral_cell(directions: Float[Array, "3 n"], size: int) -> Int[Array, " n"]:
    """Finds the cell (row * size + column) of each direction on the octahedral map.

    The octahedron |x| + |y| + |z| = 1 is unfolded into a square: the upper half is its middle,
    the lower half its four corners (Cigolle et al. 2014). Directions need not have length 1.
    """
    x, y, z = directions
    # The floor gives the zero vector a cell instead of NaN.
    inverse = 1.0 / jnp.maximum(jnp.abs(x) + jnp.abs(y) + jnp.abs(z), 1e-20)
    u, v = x * inverse, y * inverse
    # Not `jnp.sign`: its 0 at 0 would put the lower pole on the upper one.
    sign: Callable[[Array], Array] = lambda value: jnp.where(value >= 0.0, 1.0, -1.0)
    u_folded = jnp.where(z < 0.0, (1.0 - jnp.abs(v)) * sign(u), u)
    v_folded = jnp.where(z < 0.0, (1.0 - jnp.abs(u)) * sign(v), v)

    def place(value: Array) -> Array:
        # A coordinate of exactly 1 would fall one cell past the last.
        return jnp.clip(((value * 0.5 + 0.5) * size).astype(jnp.int32), 0, size - 1)

    return place(v_folded) * size + place(u_folded)


def octahedral_direction(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Computes unit directions, [..., 3], of points (u, v) in [-1, 1]^2 of the octahedral map."""
    # Negative z is the lower half: its triangles are folded out over the edges.
    z = 1.0 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0.0)
    x = u - np.where(u >= 0.0, fold, -fold)
    y = v - np.where(v >= 0.0, fold, -fold)
    points = np.stack([x, y, z], axis=-1)
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


# A finer map leaves fewer candidates to compare, in a table that is larger and slower to build.
_MAP_SIZE = 128


@functools.cache
def nearest_bin_table(num: int) -> np.ndarray:
    """Lists per octahedral cell the bins that can be nearest somewhere in it, [K, S * S] int32.

    Exact, not sampled: if c is the cell's center, r the angle to its farthest corner and d the
    angle from c to its nearest bin, then no bin farther than d + 2 r from c can be nearest.
    """
    edges = np.linspace(-1.0, 1.0, _MAP_SIZE + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    center = octahedral_direction(*np.meshgrid(middles, middles)).reshape(-1, 3)
    corner = octahedral_direction(*np.meshgrid(edges, edges))
    corners = [
        corner[i:, j:][:_MAP_SIZE, :_MAP_SIZE].reshape(-1, 3) for i in (0, 1) for j in (0, 1)
    ]
    cosines = np.stack([np.sum(center * c, axis=1) for c in corners])
    # The margin covers float32 directions that land in the cell beside their own, and rounding.
    radius = np.arccos(np.clip(cosines.min(axis=0), -1.0, 1.0)) + 1e-4
    cosine = center @ fibonacci_lattice(num).T
    nearest = np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0))
    # Cosines are compared, not angles: of the few million, none is turned into an angle.
    cell, bin = np.nonzero(cosine >= np.cos(np.minimum(nearest + 2.0 * radius, np.pi))[:, None])
    order = np.lexsort((-cosine[cell, bin], cell))  # cell by cell, the nearest first
    cell, bin = cell[order], bin[order]
    first = np.searchsorted(cell, np.arange(len(center)))
    place = np.arange(len(cell)) - first[cell]
    # Padding repeats the nearest, so that every row of the table is valid. Candidates come first:
    # `nearest_bin` reads one row of the table at a time.
    table = np.tile(bin[first].astype(np.int32), (int(place.max()) + 1, 1))
    table[place, cell] = bin
    return table


def nearest_bin(directions: Float[Array, "3 n"], num: int) -> Int[Array, " n"]:
    """Finds the lattice direction nearest to each unit direction; ties go to either.

    A table over the octahedral map leaves a few candidates per direction, so that the cost does
    not grow with `num`.
    """
    # A few candidates per cell are compared exactly, so that no bin is off by rounding of the map.
    table = jnp.asarray(nearest_bin_table(num))
    lattice = jnp.asarray(fibonacci_lattice(num).T, dtype=jnp.float32)
    cell = octahedral_cell(directions, _MAP_SIZE)
    # Below every cosine, rounded or not: the first candidate always wins.
    best = jnp.full(cell.shape, -2.0, dtype=jnp.float32)
    chosen = jnp.zeros(cell.shape, dtype=jnp.int32)
    # Unrolled: XLA fuses the few steps without an array of all candidates.
    for k in range(table.shape[0]):
        candidate = table[k, cell]
        cosine = sum(lattice[axis, candidate] * directions[axis] for axis in range(3))
        is_better = cosine > best
        best = jnp.where(is_better, cosine, best)
        chosen = jnp.where(is_better, candidate, chosen)
    return chosen
