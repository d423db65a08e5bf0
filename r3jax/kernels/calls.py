"""Kernels as functions of arrays, under the names of their formulas; XLA calls the machine code.

Arguments are named structs. Here their fields are arrays of JAX; in the kernels they are arrays and
numbers of Numba, which `kernels.bridge` reads out of a call in the order of the fields.

Shape symbols: N rows of a map; W words of bins; P views; c cells; B bins of a panorama; h w pixels
of a depth buffer; H W pixels of an image; p q bytes that hold a bit for every row and every cell.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt32

from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin_table


class MapRows(NamedTuple):
    """What R depends on, row by row of a map."""

    key: UInt32[Array, "2 N"]
    """Packed voxel index."""

    visited: UInt32[Array, "W N"]
    """Direction bins, 32 in a word."""

    counts: Float[Array, " N"]
    """Observations; 0 where there is no voxel."""

    m2: Float[Array, " N"]
    """Spread of the colors."""

    resolution: Float[Array, " N"]
    """Best resolution [px/m]."""

    voxel_size: Float[Array, ""]
    """Edge of a voxel [m]."""


class Cells(NamedTuple):
    """Cells of the coarse grid. The coordinates are apart: XLA fills each in one sweep."""

    x: Float[Array, " c"]
    """Center [m]."""

    y: Float[Array, " c"]
    """Center [m]."""

    z: Float[Array, " c"]
    """Center [m]."""

    unexplored: Bool[Array, " c"]
    """False for cells that are known, and for padding."""

    def take(self, index: Int[Array, " k"], valid: Bool[Array, " k"]) -> "Cells":
        """Returns the cells at `index`; not unexplored where `valid` is False."""
        part = (self.x[index], self.y[index], self.z[index])
        return Cells(*part, valid & self.unexplored[index])


class Views(NamedTuple):
    """Views of one kind and one size, of their depth buffers' pixels."""

    position: Float[Array, "P 3"]
    """Camera centers [m]."""

    rotation: Float[Array, "P 9"]
    """Of `T_world_camera`, row by row; panoramas have none."""

    fx: Float[Array, " P"]
    """Of the buffer, like the next three [px]; panoramas have none."""

    fy: Float[Array, " P"]
    cx: Float[Array, " P"]
    cy: Float[Array, " P"]

    max_range: Float[Array, " P"]
    """Nothing farther is visible [m]."""

    tolerance: Float[Array, " P"]
    """Depth of the surface in the buffer, across itself [voxels]."""

    pixel_angle: Float[Array, " P"]
    """Angle that a pixel covers [rad]."""

    focal: Float[Array, " P"]
    """Focal length of R [px]."""


class Layout(NamedTuple):
    """What all views of a call have in common."""

    wraps: bool
    """True for octahedral maps of all directions."""

    height: int
    """Rows of the depth buffers [px]."""

    width: int
    """Columns of the depth buffers [px]."""


class Forms(NamedTuple):
    """Form of each term of R where the paper leaves a choice."""

    kappa: str = "box"
    """`box`: 1 inside the seen directions' box, else 2. `one`: always 1."""

    delta: str = "trace"
    """`trace`: Algorithm 2. `pairwise`: the paper's text, 1 - 2 tr(M) / (n - 1)."""


class FrameArrays(NamedTuple):
    """A posed RGB-D image, and how it joins a map."""

    depth: Float[Array, "H W"]
    """z-depth [m]."""

    rgb: Float[Array, "H W 3"]
    """Colors."""

    T_world_camera: Float[Array, "4 4"]
    """Pose."""

    T_camera_world: Float[Array, "4 4"]
    """Its inverse."""

    fx: Float[Array, ""]
    """Like the next three [px]."""

    fy: Float[Array, ""]
    cx: Float[Array, ""]
    cy: Float[Array, ""]

    focal: Float[Array, ""]
    """Focal length of resolutions [px]."""

    max_range: Float[Array, ""]
    """Nothing farther counts [m]."""

    drops_edges: Float[Array, ""]
    """Above 0: pixels on depth edges are left out."""


def map_add(
    rows: MapRows, mean: Float[Array, "3 N"], frame: FrameArrays, num_bins: int
) -> tuple[MapRows, Float[Array, "3 N"], Int[Array, ""]]:
    """Adds an observation of every voxel that a measured pixel falls into, in place.

    The formula is `mapping.update.integrate_pixels`: the same rows, and the same numbers up to
    rounding.

    Returns:
        The rows and their mean colors, and how many voxels found no row.
    """
    *changing, voxel_size = rows
    table = [*changing, mean]
    *after, mean, lost = _call(
        "map_add",
        [*map(_like, table), jax.ShapeDtypeStruct((1,), jnp.int32)],
        (table, voxel_size, frame, _bins(num_bins), _workers()),
        input_output_aliases={i: i for i in range(len(table))},
        vmap_method="sequential",
    )
    key, visited, counts, m2, resolution = after
    rows = MapRows(key, visited, counts, m2, resolution, voxel_size)
    return rows, mean, lost[0]


def map_mark(
    rows: MapRows, frame: FrameArrays, is_visible: UInt8[Array, " N"], num_bins: int
) -> MapRows:
    """Sets the direction bin of the rows that a frame shows, and raises their resolution.

    The formulas are `mapping.seen.rows_in_view` and `mark_rows`.

    Args:
        rows: of the map.
        frame: the frame.
        is_visible: 1 where no other voxel hides a row, which is shown then even where depth failed.
        num_bins: direction bins of a voxel.
    """
    marks = [rows.visited, rows.resolution]
    visited, resolution = _call(
        "map_mark",
        [*map(_like, marks)],
        (marks, rows.key, rows.voxel_size, frame, is_visible, _bins(num_bins), _workers()),
        input_output_aliases={0: 0, 1: 1},
        vmap_method="sequential",
    )
    return rows._replace(visited=visited, resolution=resolution)


def sums(
    rows: MapRows, cells: Cells, views: Views, layout: Layout, forms: Forms,
    num_bins: int, voxel_bins: int, *, keep: bool = False,
) -> tuple[Array, ...]:  # fmt: skip
    """Returns sums what views show, by direction: `scoring.formulas.sums_in_view`.

    Args:
        rows: of the map.
        cells: of the grid.
        views: which.
        layout: of the views.
        forms: of R.
        num_bins: bins of the panorama; 1 sums over all directions.
        voxel_bins: direction bins of a voxel.
        keep: whether to say what each view sees.

    Returns:
        Sums of 1 - R [P, B] and numbers of unexplored cells [P, B]. If `keep`: also which rows
        of the map and which cells each view sees, as bits in bytes [P, p] and [P, q].
    """
    num = views.focal.shape[0]
    both = jax.ShapeDtypeStruct((num, num_bins), jnp.float32)
    sizes = [-(-size // 8) if keep else 0 for size in (rows.counts.shape[0], cells.x.shape[0])]
    bits = [jax.ShapeDtypeStruct((num, size), jnp.uint8) for size in sizes]
    found = _call(
        "sums",
        [both, both, *bits],
        (rows, _as_bytes(cells), views, _options(*layout, *_choices(forms)),
         _lattice(voxel_bins), _bins(num_bins)),
    )  # fmt: skip
    return found if keep else found[:2]


def changes(
    before: MapRows, after: MapRows, cells: Cells,
    seen: tuple[UInt8[Array, "P p"], UInt8[Array, "P q"]],
    position: Float[Array, "P 3"], focal: Float[Array, " P"], forms: Forms,
    num_bins: int, voxel_bins: int,
) -> tuple[Float[Array, "P B"], Float[Array, "P B"]]:  # fmt: skip
    """Returns sums what imagined views have changed: `scoring.formulas.change_of_sums`.

    Args:
        before: rows of the map before the views.
        after: the same rows after them.
        cells: of the grid; `unexplored` says which are no longer so after the views.
        seen: bits of the rows and cells that each position sees.
        position: camera centers [m].
        focal: focal lengths of R [px].
        forms: of R.
        num_bins: bins of the panorama.
        voxel_bins: direction bins of a voxel.

    Returns:
        Sums of 1 - R after less before, and numbers of cells that are no longer unexplored.
    """
    both = jax.ShapeDtypeStruct((position.shape[0], num_bins), jnp.float32)
    change, explored = _call(
        "changes",
        [both, both],
        (before, after, _as_bytes(cells), seen, position, focal, _options(*_choices(forms)),
         _lattice(voxel_bins), _bins(num_bins)),
    )  # fmt: skip
    return change, explored


def pixels(
    rows: MapRows, views: Views, layout: Layout, forms: Forms, voxel_bins: int, *, keep: bool
) -> tuple[Float[Array, " P"], Int[Array, "P hw"]]:
    """Finds the nearest voxel in every pixel: `scoring.formulas.rows_in_pixels`, `mean_in_pixels`.

    Returns:
        The means of R, and the rows in the pixels, N where there is none. If `keep`, the means
        are 0; if not, there are no rows [P, 0].
    """
    num, room = views.focal.shape[0], layout.height * layout.width if keep else 0
    shapes = [
        jax.ShapeDtypeStruct((num,), jnp.float32),
        jax.ShapeDtypeStruct((num, room), jnp.int32),
    ]
    options = _options(*layout, *_choices(forms))
    means, found = _call("pixels", shapes, (rows, views, options, _lattice(voxel_bins)))
    return means, found


def terms(
    rows: MapRows, position: Float[Array, "P 3"], focal: Float[Array, " P"], forms: Forms,
    voxel_bins: int,
) -> tuple[Float[Array, "P N"], ...]:  # fmt: skip
    """Computes the terms of R of every row, hidden or not: `scoring.terms.score_voxels`.

    Returns:
        kappa, bias, delta, noise, resolution and R; all NaN where a position is not finite.
    """
    # An array for each term: none is copied out of one for all.
    term = jax.ShapeDtypeStruct((position.shape[0], rows.counts.shape[0]), jnp.float32)
    options = _options(*_choices(forms))
    return _call("terms", [term] * 6, (rows, position, focal, options, _lattice(voxel_bins)))


def _call(name: str, results: list[jax.ShapeDtypeStruct], arguments: Any, **options: Any) -> Any:
    """Calls a kernel, which is compiled (or read from the disk) when the first call is traced."""
    from r3jax.kernels.bridge import register

    return tuple(jax.ffi.ffi_call(register(name), results, **options)(*jax.tree.leaves(arguments)))


def _like(array: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


def _as_bytes(cells: Cells) -> Cells:
    return cells._replace(unexplored=cells.unexplored.astype(jnp.uint8))


def _choices(forms: Forms) -> tuple[bool, bool]:
    """Returns whether kappa is always 1, and whether delta is that of pairs."""
    return forms.kappa == "one", forms.delta == "pairwise"


def _workers() -> np.ndarray:
    from r3jax.kernels.native.ffi import num_workers

    return np.array([num_workers()], dtype=np.int32)


def _options(*values: int) -> np.ndarray:
    """Returns the whole numbers of a call, and how many threads share it."""
    return np.append(np.array(values, dtype=np.int32), _workers())


@functools.cache
def _lattice(num_bins: int) -> np.ndarray:
    """Returns directions of bins [B, 3]."""
    return fibonacci_lattice(num_bins).astype(np.float32)


@functools.cache
def _bins(num_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns candidates of every octahedral cell [S^2, K], and directions of bins [B, 3]."""
    table = np.ascontiguousarray(nearest_bin_table(num_bins).T, dtype=np.int32)
    return table, _lattice(num_bins)
