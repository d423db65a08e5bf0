"""Scores of many views in one call, in machine code for CPUs.

Shape symbols: P views; n voxels; c cells; W words of bins; B bins of the panorama.
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

import r3jax.kernels.visibility as visibility_kernels
from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin_table
from r3jax.kernels import mapping as mapping_kernels
from r3jax.kernels.native.compiled import forget_outdated_code
from r3jax.kernels.native.ffi import num_workers
from r3jax.kernels.scoring.bridge import CHANGES, PIXELS, ROWS, SUMS, SUMS_OF_FEW, register
from r3jax.kernels.scoring.rows import NUM_TERMS
from r3jax.kernels.scoring.sums import FEW
from r3jax.mapping.state import MapState
from r3jax.scoring.backends.views import BufferLayout
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import Forms

forget_outdated_code(
    Path(__file__).parent,
    Path(mapping_kernels.__file__).parent,
    Path(visibility_kernels.__file__).parent,
)


def _shared(voxels: MapState) -> tuple[Array, ...]:
    """The map's arrays, as `sums_of_many` takes them."""
    return (
        voxels.key, voxels.visited, voxels.count, voxels.m2, voxels.resolution,
        voxels.voxel_size[None],
    )  # fmt: skip


def _options(layout: BufferLayout, forms: Forms) -> np.ndarray:
    return np.array([*layout, *_choices(forms), forms.sample, num_workers()], dtype=np.int32)


def _choices(forms: Forms) -> tuple[bool, bool]:
    """Whether kappa is always 1, and whether delta is that of pairs."""
    return forms.kappa == "one", forms.delta == "pairwise"


@functools.cache
def _tables(num_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Candidates of every octahedral cell [S^2, K] and directions of the bins [B, 3]."""
    table = np.ascontiguousarray(nearest_bin_table(num_bins).T, dtype=np.int32)
    return table, fibonacci_lattice(num_bins).astype(np.float32)


def sums_in_views(
    voxels: MapState,
    cells: Cells,
    views: Float[Array, "P 20"],
    layout: BufferLayout,
    forms: Forms,
    num_bins: int,
    *,
    keep: bool = False,
) -> tuple[Array, ...]:
    """`reference.sums_in_view` of many views, on as many cores as the process may use.

    Returns:
        Sums of 1 - R [P, B] and numbers of unexplored cells [P, B]. If `keep`: also which rows
        of the map and which cells each view sees, as bits in bytes [P, p] and [P, q].
    """
    num = views.shape[0]
    name = SUMS if num > FEW else SUMS_OF_FEW
    register(name)
    sums = jax.ShapeDtypeStruct((num, num_bins), jnp.float32)
    sizes = [-(-size // 8) if keep else 0 for size in (voxels.capacity, cells.x.shape[0])]
    bits = [jax.ShapeDtypeStruct((num, size), jnp.uint8) for size in sizes]
    directions = fibonacci_lattice(voxels.num_bins).astype(np.float32)
    space = (cells.x, cells.y, cells.z, cells.unexplored.astype(jnp.uint8))
    results = jax.ffi.ffi_call(name, [sums, sums, *bits])(
        *_shared(voxels), views, _options(layout, forms), directions, *_tables(num_bins), *space
    )
    deficits, *others = results
    deficits = forms.sample * deficits
    return (deficits, *others) if keep else (deficits, others[0])


def changes_of_sums(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    places: tuple[Float[Array, "P 4"], UInt8[Array, "P p"], UInt8[Array, "P q"]],
    forms: Forms,
    num_bins: int,
) -> tuple[Float[Array, "P B"], Float[Array, "P B"]]:
    """`reference.change_of_sums` of many positions, on the core of who asks."""
    register(CHANGES)
    (voxels, cells), (seen, left) = before, after
    points, *kept = places
    sums = jax.ShapeDtypeStruct((points.shape[0], num_bins), jnp.float32)
    explored = (cells.unexplored & ~left.unexplored).astype(jnp.uint8)
    changes, gone = jax.ffi.ffi_call(CHANGES, [sums, sums])(
        *_shared(voxels), seen.visited, seen.count, seen.m2, seen.resolution,
        cells.x, cells.y, cells.z, explored, *kept, points,
        np.array(_choices(forms), dtype=np.int32),
        fibonacci_lattice(voxels.num_bins).astype(np.float32), *_tables(num_bins),
    )  # fmt: skip
    return forms.sample * changes, gone


def means_in_pixels(
    voxels: MapState, views: Float[Array, "P 20"], layout: BufferLayout, forms: Forms
) -> Float[Array, " P"]:
    """`reference.mean_in_pixels` of many views, on as many cores as the process may use."""
    return _look(voxels, views, layout, forms, 0)[0]


def rows_in_pixels(
    voxels: MapState, views: Float[Array, "P 20"], layout: BufferLayout, forms: Forms
) -> Int[Array, "P h w"]:
    """`reference.rows_in_pixels` of many views."""
    rows = _look(voxels, views, layout, forms, layout.height * layout.width)[1]
    return rows.reshape(-1, layout.height, layout.width)


def _look(
    voxels: MapState, views: Float[Array, "P 20"], layout: BufferLayout, forms: Forms, room: int
) -> tuple[Array, Array]:
    register(PIXELS)
    num = views.shape[0]
    shapes = [
        jax.ShapeDtypeStruct((num,), jnp.float32),
        jax.ShapeDtypeStruct((num, room), jnp.int32),
    ]
    directions = fibonacci_lattice(voxels.num_bins).astype(np.float32)
    means, rows = jax.ffi.ffi_call(PIXELS, shapes)(
        *_shared(voxels), views, _options(layout, forms), directions
    )
    return means, rows


def terms_of_rows(
    voxels: MapState, points: Float[Array, "P 4"], forms: Forms
) -> tuple[Float[Array, "P n"], ...]:
    """`reference.terms_of_rows` from many points (position, focal length), field by field."""
    register(ROWS)
    # An array for each field: none is copied out of one for all.
    field = jax.ShapeDtypeStruct((points.shape[0], voxels.capacity), jnp.float32)
    options = np.array([*_choices(forms), num_workers()], dtype=np.int32)
    directions = fibonacci_lattice(voxels.num_bins).astype(np.float32)
    return tuple(
        jax.ffi.ffi_call(ROWS, [field] * NUM_TERMS)(*_shared(voxels), points, options, directions)
    )
