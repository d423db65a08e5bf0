"""Kernels as functions of arrays, named after their formulas; XLA calls the machine code.

Arguments are named structs. Here their fields are arrays of JAX; in the kernels they are arrays and
numbers of Numba, which `kernels.bridge` reads out of a call in the order of the fields.

Shape symbols: N rows of a map; W words of bins; P views; c cells; B bins of a panorama; h w pixels
of a depth buffer; H W pixels of an image; p q bytes that hold a bit for every row and every cell;
n Gaussians; K floats of their harmonics; E intersections that there is room for; T tiles.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt32

from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin_table
from r3jax.kernels.constants import TILE
from r3jax.kernels.splatting import records


class MapRows(NamedTuple):
    """The arrays that R depends on, by row of a map."""

    key: UInt32[Array, "2 N"]
    """Packed voxel index."""

    visited: UInt32[Array, "W N"]
    """Direction bins, 32 in a word."""

    counts: Float[Array, " N"]
    """Number of observations; 0 for rows without a voxel."""

    m2: Float[Array, " N"]
    """Squared deviations of the colors."""

    resolution: Float[Array, " N"]
    """Best resolution [px/m]."""

    voxel_size: Float[Array, ""]
    """Voxel size [m]."""


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
        """Gathers the cells at `index`; not unexplored where `valid` is False."""
        part = (self.x[index], self.y[index], self.z[index])
        return Cells(*part, valid & self.unexplored[index])


class Views(NamedTuple):
    """Views of one kind and one size of depth buffer."""

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
    """Range of visibility [m]."""

    tolerance: Float[Array, " P"]
    """Depth of the surface in the buffer, across itself [voxels]."""

    pixel_angle: Float[Array, " P"]
    """Angle that a pixel covers [rad]."""

    focal: Float[Array, " P"]
    """Focal length of R [px]."""


class Layout(NamedTuple):
    """Properties that all views of a call share."""

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
    """Range of the sensor [m]."""

    drops_edges: Float[Array, ""]
    """Above 0: pixels on depth edges are left out."""


class Cloud(NamedTuple):
    """Gaussians, and where their projected centers are moved to."""

    means: Float[Array, "n 3"]
    """Centers [m]."""

    quats: Float[Array, "n 4"]
    """Orientations, of any length."""

    log_scales: Float[Array, "n 3"]
    """Logarithms of standard deviations [m]."""

    logits: Float[Array, " n"]
    """Of opacities."""

    sh: Float[Array, "n K"]
    """Harmonics, the colors of each side by side."""

    center_offsets: Float[Array, "n 2"]
    """Added to the projected centers [px]."""


class Images(NamedTuple):
    """Gaussians composited on black, or a gradient by that."""

    rgb: Float[Array, "H W 3"]
    """Sum of weight x color."""

    depth: Float[Array, "H W"]
    """Sum of weight x z-depth [m]."""

    alpha: Float[Array, "H W"]
    """Sum of the weights."""


class Drawn(NamedTuple):
    """Data of compositing for its gradient: projected Gaussians, and the lists of the tiles."""

    records: Float[Array, "n 16"]
    """See `kernels.splatting.records`."""

    ids: Int[Array, " E"]
    """Gaussians of the lists, one list after the other."""

    slots: Int[Array, " E"]
    """Places of the intersections in the order of the Gaussians."""

    rows: UInt8[Array, " E"]
    """First and last row of a tile that is touched, four bits each."""

    starts: Int[Array, " T+1"]
    """Where the list of each tile begins."""

    ends: Int[Array, " T"]
    """How far it was used."""


def map_add(
    rows: MapRows, mean: Float[Array, "3 N"], frame: FrameArrays, num_bins: int
) -> tuple[MapRows, Float[Array, "3 N"], Int[Array, ""]]:
    """Adds an observation of every voxel that a measured pixel falls into, in place.

    The formula is `mapping.update.integrate_pixels`: the same rows, and the same numbers up to
    rounding.

    Returns:
        The rows and their mean colors, and the number of dropped voxels.
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


def map_look(
    rows: MapRows,
    mean: Float[Array, "3 N"],
    misses: UInt8[Array, " N"] | None,
    frame: FrameArrays,
    is_visible: UInt8[Array, " N"],
    num_bins: int,
) -> tuple[MapRows, Float[Array, "3 N"], UInt8[Array, " N"] | None]:
    """Removes the voxels that a frame sees through, and marks the rows that it shows, in place.

    The formulas are `mapping.moved.count_misses`, and `mapping.seen.rows_in_view` and `mark_rows`.

    Args:
        rows: of the map.
        mean: colors of the rows.
        misses: number of frames that saw through each row so far; None: no voxel is removed.
        frame: the frame.
        is_visible: 1 for rows that no other voxel hides, which count as seen even where depth
            failed.
        num_bins: direction bins of a voxel.

    Returns:
        The rows, their colors and the numbers after the frame.
    """
    *changing, voxel_size = rows
    table = [*changing, mean, jnp.zeros(0, jnp.uint8) if misses is None else misses]
    key, visited, counts, m2, resolution, mean, after = _call(
        "map_look",
        [*map(_like, table)],
        (table, voxel_size, frame, is_visible, _bins(num_bins), _workers()),
        input_output_aliases={i: i for i in range(len(table))},
        vmap_method="sequential",
    )
    rows = MapRows(key, visited, counts, m2, resolution, voxel_size)
    return rows, mean, None if misses is None else after


def grid_depth(
    log_odds: Float[Array, "X Y Z"],
    origin: Float[Array, " 3"],
    cell_size: Float[Array, ""],
    frame: FrameArrays,
) -> Float[Array, "X Y Z"]:
    """Updates a grid with a depth image, in place: `mapping.occupancy.integrate_depth`."""
    return _call(
        "grid_depth",
        [_like(log_odds)],
        (log_odds, origin, cell_size, frame),
        input_output_aliases={0: 0},
        vmap_method="sequential",
    )[0]


def sums(
    rows: MapRows, cells: Cells, views: Views, layout: Layout, forms: Forms,
    num_bins: int, voxel_bins: int, *, keep: bool = False,
) -> tuple[Array, ...]:  # fmt: skip
    """Sums what views show, by direction: `scoring.formulas.sums_in_view`.

    Args:
        rows: of the map.
        cells: of the grid.
        views: which.
        layout: of the views.
        forms: of R.
        num_bins: bins of the panorama; 1 sums over all directions.
        voxel_bins: direction bins of a voxel.
        keep: also return visibility.

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
    """Sums what imagined views have changed: `scoring.formulas.change_of_sums`.

    Args:
        before: rows of the map before the views.
        after: the same rows after them.
        cells: of the grid; `unexplored` marks cells that are no longer unexplored after the views.
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


def composite(
    cloud: Cloud, view: Float[Array, " 19"], size: tuple[int, int], budget: int
) -> tuple[Images, Int[Array, " 2"], Drawn]:
    """Composites Gaussians on black: `splatting.backends.reference.rasterize`.

    Args:
        cloud: the Gaussians.
        view: see `kernels.splatting.records.VIEW_SIZE`.
        size: width and height of the image [px].
        budget: intersections of a tile and a Gaussian that there is room for.

    Returns:
        The images, black if the room is too small; intersections needed, and how many exceed the
        budget; and what the gradient needs.
    """
    width, height = size
    tiles = -(-width // TILE) * -(-height // TILE)
    floats = [(height, width, 3), (height, width), (height, width)]
    shapes = [
        *(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in floats),
        jax.ShapeDtypeStruct((2,), jnp.int32),
        jax.ShapeDtypeStruct((cloud.means.shape[0], records.SIZE), jnp.float32),
        jax.ShapeDtypeStruct((budget,), jnp.int32),
        jax.ShapeDtypeStruct((budget,), jnp.int32),
        jax.ShapeDtypeStruct((budget,), jnp.uint8),
        jax.ShapeDtypeStruct((tiles + 1,), jnp.int32),
        jax.ShapeDtypeStruct((tiles,), jnp.int32),
    ]
    found = _call("composite", shapes, (cloud, view, _workers()), vmap_method="sequential")
    return Images(*found[:3]), found[3], Drawn(*found[4:])


def composite_gradient(
    cloud: Cloud, view: Float[Array, " 19"], images: Images, drawn: Drawn, gradients: Images
) -> tuple[Cloud, Float[Array, " 19"]]:
    """Computes gradients by Gaussians and view, from those by the images of `composite`."""
    arguments = (cloud, view, _workers(), images, drawn, gradients)
    shapes = [*map(_like, (*cloud, view))]
    *by_cloud, by_view = _call("composite_gradient", shapes, arguments, vmap_method="sequential")
    return Cloud(*by_cloud), by_view


def squares(
    cloud: Cloud, view: Float[Array, " 19"], images: Images, drawn: Drawn, background: Array
) -> tuple[Array, ...]:
    """Sums squared gradients of pixels: `baselines.information.pixel_squares`.

    Args:
        cloud: the Gaussians.
        view: of them.
        images: of `composite`.
        drawn: of `composite`.
        background: sum of its channels [1].

    Returns:
        Sums by means, quats, log scales, logits and harmonics.
    """
    arguments = (cloud, view, _workers(), images, drawn, background)
    return _call("squares", [*map(_like, cloud[:5])], arguments, vmap_method="sequential")


def tallies(
    drawn: Drawn, value: Float[Array, "H W"], counts: Float[Array, "H W"], least: Float[Array, " 2"]
) -> Float[Array, "n 2"]:
    """Sums weights of single Gaussians over pixels: `baselines.information.pixel_tallies`."""
    shape = jax.ShapeDtypeStruct((drawn.records.shape[0], 2), jnp.float32)
    arguments = (drawn, _workers(), value, counts, least)
    return _call("tallies", [shape], arguments, vmap_method="sequential")[0]


def image_loss(
    rgb: Float[Array, "H W 3"], target: Float[Array, "H W 3"], weight: Float[Array, ""]
) -> tuple[Float[Array, " 2"], Float[Array, "H W 3"]]:
    """Computes `splatting.training.train_step.loss_and_error`, and the gradient of the loss."""
    height, width, _ = rgb.shape
    flat = [image.reshape(height, 3 * width) for image in (rgb, target)]
    shapes = [jax.ShapeDtypeStruct((2,), jnp.float32), _like(flat[0])]
    arguments = (*flat, weight.reshape(1), _workers())
    numbers, gradient = _call("image_loss", shapes, arguments, vmap_method="sequential")
    return numbers, gradient.reshape(rgb.shape)


def adam(
    state: list[Array], gradient: list[Array], rates: Float[Array, " 6"],
    corrections: Float[Array, " 2"], num_open: Int[Array, ""], is_wanted: Bool[Array, ""],
) -> tuple[Array, ...]:  # fmt: skip
    """Takes a step of Adam in place: `splatting.training.optimizer.adam_update`.

    Args:
        state: the five arrays of a scene, and their moments of first and second order.
        gradient: by the five arrays.
        rates: of means, quats, log scales, logits, the constant harmonic and the others.
        corrections: factors of the moments.
        num_open: harmonics that take part.
        is_wanted: if False, or if a number or a gradient is not finite, nothing changes.

    Returns:
        The state after, and whether the step was done.
    """
    row = 3 * state[4].shape[1]
    options = [jnp.int32(x) for x in (row, 3 * num_open, is_wanted, _workers()[0])]
    # Not flattened: XLA would copy arrays to reshape them.
    shapes = [*map(_like, state), jax.ShapeDtypeStruct((1,), jnp.int32)]
    *after, applied = _call(
        "adam",
        shapes,
        (state, gradient, rates, corrections, jnp.stack(options)),
        input_output_aliases={i: i for i in range(len(state))},
        vmap_method="sequential",
    )
    return (*after, applied[0] > 0)


def compile_first(*names: str) -> None:
    """Compiles kernels now, in this order, unless that is done: others may wait for a process."""
    from r3jax.kernels.bridge import register

    for name in names:
        register(name)


def _call(name: str, results: list[jax.ShapeDtypeStruct], arguments: Any, **options: Any) -> Any:
    """Calls a kernel, which is compiled (or loaded from disk) when its first call is traced."""
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
    """Joins the whole numbers of a call and the number of threads that share it."""
    return np.append(np.array(values, dtype=np.int32), _workers())


@functools.cache
def _lattice(num_bins: int) -> np.ndarray:
    """Returns the directions of bins [B, 3]."""
    return fibonacci_lattice(num_bins).astype(np.float32)


@functools.cache
def _bins(num_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns candidates of every octahedral cell [S^2, K], and directions of bins [B, 3]."""
    table = np.ascontiguousarray(nearest_bin_table(num_bins).T, dtype=np.int32)
    return table, _lattice(num_bins)
