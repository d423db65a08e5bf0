"""Compositing in pure JAX: batches of tiles, chunks of Gaussians, sums as matrix products.

Tiles with about the same number of Gaussians are composited together, a chunk of Gaussians at a
time, from near to far, until every pixel of the batch is opaque. Nothing is kept for the backward
pass but the image: it goes the same way once more, with the sums so far telling those to come.

XLA on a CPU computes whatever several loops need once in each of them, however costly: so the steps
of a chunk are held apart by `stage`. Its scans are several times slower than written-out chains: so
running products and sums are chains of elementwise operations, in two levels. It sorts one array of
integers seven times faster than an array with a payload: so every sort is of one array, with the
payload in the low bits of the key.

Shape symbols: n Gaussians, t tiles (row by row), m slots of the tile lists (the budget), B tiles of
a batch, G Gaussians of a chunk, P = 256 pixels of a tile, N tiles padded to whole batches.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels.constants import ALPHA_MAX, ALPHA_MIN, NEAR_PLANE, TILE, TRANSMITTANCE_MIN
from r3jax.splatting.backend import Composite, RasterConfig
from r3jax.splatting.projection import project_gaussians
from r3jax.splatting.scene import GaussianScene

DEPTH_BITS = 28
"""Bits of a float32 depth counted from 0.01 m: exact to 4e7 m, for each power of two takes 23."""


MOST = 2**31 - 1
"""Counts saturate here."""


PIXELS = TILE * TILE


Operation = Callable[[Array, Array], Array]
"""Elementwise, such as a product or a sum."""


class TileLists(eqx.Module):
    """The Gaussians of every tile."""

    ids: Int[Array, " m"]
    """Gaussians of tile 0 from near to far, then those of tile 1, ...; arbitrary behind them."""

    start: Int[Array, " t"]
    """Where each tile's Gaussians begin in `ids`."""

    count: Int[Array, " t"]
    """How many they are."""

    num_intersections: Int[Array, ""]
    """Number of (tile, Gaussian) pairs, including dropped ones."""

    overflow: Int[Array, ""]
    """Dropped pairs: those of the farthest Gaussians."""


class TileBoxes(eqx.Module):
    """The rectangle of tiles that each Gaussian touches."""

    first: Int[Array, " n"]
    """The tile in its upper left corner."""

    columns: Int[Array, " n"]
    """How many tiles wide it is; at least 1."""

    count: Int[Array, " n"]
    """How many tiles it has; 0 where the Gaussian is not drawn."""


class Chunk(eqx.Module):
    """The next Gaussians of every tile of a batch, as its pixels see them."""

    splats: Float[Array, "11 B G"]
    """Center relative to the tile's middle, conic, opacity, RGB, depth, 1; zeros where the tile
    has no more Gaussians."""

    alpha: Float[Array, "B G P"]
    """0 where skipped."""

    weight: Float[Array, "B G P"]
    """What the Gaussian adds to the pixel: 0 once compositing has stopped."""

    through: Float[Array, "B P"]
    """Transmittance behind the last of them."""


class Layout(eqx.Module):
    """Static shapes."""

    width: int = eqx.field(static=True)
    """Columns of the image [px]."""

    height: int = eqx.field(static=True)
    """Rows of the image [px]."""

    batch: int = eqx.field(static=True)
    """Tiles composited at a time."""

    chunk: int = eqx.field(static=True)
    """Gaussians composited at a time."""

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of tiles."""
        return grid_shape(self.width, self.height)

    @property
    def num_batches(self) -> int:
        """Batches of tiles; the last may be filled up with empty ones."""
        return -(-self.grid[0] * self.grid[1] // self.batch)


class Batch(eqx.Module):
    """Some tiles, and where their Gaussians are in the lists."""

    start: Int[Array, " B"]
    """First slot of each tile."""

    count: Int[Array, " B"]
    """Its slots."""

    middle: Float[Array, "2 B"]
    """Column and row of its middle [px]."""

    inside: Bool[Array, "B P"]
    """True for the pixels that lie in the image."""

    go: Bool[Array, ""]
    """Whether there is anything to do: the first tile has most Gaussians."""


def rasterize(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> Composite:
    """Composites the scene on black; see `backend.Rasterize`.

    Raises:
        ValueError: a batch or chunk size below 1.
    """
    for name in ("tiles_per_batch", "gaussians_per_chunk"):
        if getattr(config, name) < 1:
            raise InputError(f"RasterConfig.{name} must be at least 1, got {getattr(config, name)}")
    projected = project_gaussians(scene, camera, T_world_camera, center_offsets)
    layout = Layout(camera.width, camera.height, config.tiles_per_batch, config.gaussians_per_chunk)
    lists = _list_tiles(
        layout, config.budget(scene.capacity), projected.center, projected.reach, projected.depth
    )
    splats = jnp.concatenate(
        [
            projected.center,
            projected.conic,
            projected.opacity[None, :],
            projected.color,
            projected.depth[None, :],
        ]
    ).T
    image: Array = composite(layout, splats, lists)
    return Composite(
        rgb=image[..., :3],
        depth_sum=image[..., 3],
        alpha=image[..., 4],
        num_intersections=lists.num_intersections,
        overflow=lists.overflow,
    )


def _list_tiles(
    layout: Layout, budget: int, center: Array, reach: Array, depth: Array
) -> TileLists:
    # One view after the other under vmap, for batched switches and loops do needless work.
    @jax.custom_batching.sequential_vmap
    def listed(center: Array, reach: Array, depth: Array) -> TileLists:
        return list_tiles(center, reach, depth, layout.width, layout.height, budget)

    return listed(*(jax.lax.stop_gradient(x) for x in (center, reach, depth)))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def composite(
    layout: Layout, splats: Float[Array, "n 10"], lists: TileLists
) -> Float[Array, "H W 5"]:
    """Composites projected Gaussians.

    Args:
        layout: sizes.
        splats: center, conic, opacity, color, depth of every Gaussian.
        lists: which meet which tile.

    Returns:
        RGB, depth and alpha, each summed over the Gaussians by their weights.
    """
    return _composite_fwd(layout, splats, lists)[0]


def _composite_fwd(
    layout: Layout, splats: Array, lists: TileLists
) -> tuple[Array, tuple[Array, TileLists, Array]]:
    image: Array = jax.custom_batching.sequential_vmap(partial(_forward, layout))(splats, lists)
    return image, (splats, lists, image)


def _composite_bwd(
    layout: Layout, residuals: tuple[Array, TileLists, Array], cotangent: Array
) -> tuple[Array, None]:
    splats, lists, image = residuals
    backward = jax.custom_batching.sequential_vmap(partial(_backward, layout))
    return backward(splats, lists, image, cotangent), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _forward(layout: Layout, splats: Float[Array, "n 10"], lists: TileLists) -> Array:
    """Renders the image [H, W, 5]."""
    order = _by_count(layout, lists)

    def composite_batch(i: Array, tiles: Array) -> Array:
        batch = _batch(layout, lists, _take(layout, order, i))

        def add_chunk(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            j, through, sums = carry
            _, rows = _rows(layout, splats, lists, batch, j)
            chunk = see_chunk(batch.go, rows, through)
            return j + 1, chunk.through, sums + chunk_sums(chunk)

        sums = jnp.zeros((layout.batch, 5, PIXELS))
        start = (jnp.int32(0), batch.inside.astype(jnp.float32), sums)
        goes_on = partial(_goes_on, layout, batch)
        _, _, sums = jax.lax.while_loop(lambda carry: goes_on(*carry[:2]), add_chunk, start)
        return jax.lax.dynamic_update_slice_in_dim(tiles, sums, i * layout.batch, 0)

    shape = (layout.num_batches * layout.batch, 5, PIXELS)
    tiles = jax.lax.fori_loop(0, layout.num_batches, composite_batch, jnp.zeros(shape))
    return _from_tiles(layout, order, tiles)


def _backward(
    layout: Layout,
    splats: Float[Array, "n 10"],
    lists: TileLists,
    image: Float[Array, "H W 5"],
    cotangent: Float[Array, "H W 5"],
) -> Float[Array, "n 10"]:
    """Computes the gradient by the splats."""
    order = _by_count(layout, lists)
    wanted = _to_tiles(layout, order, cotangent)
    total = jnp.sum(wanted * _to_tiles(layout, order, image), axis=1)

    def differentiate_batch(i: Array, gradient: Array) -> Array:
        batch = _batch(layout, lists, _take(layout, order, i))
        v, all_gain = _take(layout, wanted, i), _take(layout, total, i)

        def add_chunk(
            carry: tuple[Array, Array, Array, Array],
        ) -> tuple[Array, Array, Array, Array]:
            j, through, gain, gradient = carry
            ids, rows = _rows(layout, splats, lists, batch, j)
            chunk = see_chunk(batch.go, rows, through)
            part, gain = chunk_gradient(batch.go, chunk, v, all_gain, gain)
            part = part.reshape(10, -1).T
            gradient = gradient.at[ids.reshape(-1)].add(part, mode="drop")
            return j + 1, chunk.through, gain, gradient

        start = (jnp.int32(0), batch.inside.astype(jnp.float32), jnp.zeros_like(all_gain), gradient)
        goes_on = partial(_goes_on, layout, batch)
        return jax.lax.while_loop(lambda carry: goes_on(*carry[:2]), add_chunk, start)[-1]

    return jax.lax.fori_loop(0, layout.num_batches, differentiate_batch, jnp.zeros_like(splats))


def _goes_on(
    layout: Layout, batch: Batch, j: Int[Array, ""], through: Float[Array, "B P"]
) -> Bool[Array, ""]:
    """Checks whether any tile has Gaussians left at chunk j and a pixel that they may reach."""
    is_open = (through > TRANSMITTANCE_MIN).any(axis=1)
    return (is_open & (j * layout.chunk < batch.count)).any()


def _rows(
    layout: Layout,
    splats: Float[Array, "n 10"],
    lists: TileLists,
    batch: Batch,
    j: Int[Array, ""],
) -> tuple[Int[Array, "B G"], Float[Array, "11 B G"]]:
    """Gathers the Gaussians in the j-th chunk of every tile, n for none, and `Chunk.splats`."""

    def gather(middle: Array, ids: Array, splats: Array) -> Array:
        rows = splats.at[ids].get(mode="fill", fill_value=0.0)
        rows = jnp.moveaxis(rows, -1, 0)
        ones = jnp.ones((1, *ids.shape))
        return jnp.concatenate([rows[:2] - middle[:, :, None], rows[2:], ones])

    place = j * layout.chunk + jnp.arange(layout.chunk)
    valid = place[None, :] < batch.count[:, None]
    slots = jnp.where(valid, batch.start[:, None] + place[None, :], 0)
    ids = jnp.where(valid, lists.ids[slots], splats.shape[0])
    return ids, stage(batch.go, gather, batch.middle, ids, splats)


def _take(layout: Layout, x: Num[Array, "N ..."], i: Int[Array, ""]) -> Num[Array, "B ..."]:
    """Slices the part of x that belongs to batch i."""
    return jax.lax.dynamic_slice_in_dim(x, i * layout.batch, layout.batch)


def _by_count(layout: Layout, lists: TileLists) -> Int[Array, " N"]:
    """Sorts the tiles, those with most Gaussians first, padded to whole batches with -1."""
    order = jnp.argsort(-lists.count)
    return jnp.pad(
        order, (0, layout.num_batches * layout.batch - order.shape[0]), constant_values=-1
    )


def _batch(layout: Layout, lists: TileLists, tiles: Int[Array, " B"]) -> Batch:
    is_real = tiles >= 0
    tile = jnp.where(is_real, tiles, 0)
    row, column = jnp.divmod(tile, layout.grid[0])
    middle = (jnp.stack([column, row]) * TILE).astype(jnp.float32) + 0.5 * TILE
    px, py = (middle[i][:, None] + c[None, :] for i, c in enumerate(pixel_offsets()))
    count = jnp.where(is_real, lists.count[tile], 0)
    return Batch(
        start=lists.start[tile],
        count=count,
        middle=middle,
        inside=(px < layout.width) & (py < layout.height),
        go=count[0] > 0,
    )


def _from_tiles(
    layout: Layout, order: Int[Array, " N"], tiles: Float[Array, "N k P"]
) -> Float[Array, "H W k"]:
    """Puts tiles, given in that order, together to an image."""
    columns, rows = layout.grid
    # -1, the tiles that fill up, would be the last tile.
    target = jnp.where(order >= 0, order, columns * rows)
    placed = jnp.zeros((columns * rows, *tiles.shape[1:])).at[target].set(tiles, mode="drop")
    image = placed.reshape(rows, columns, -1, TILE, TILE).transpose(0, 3, 1, 4, 2)
    image = image.reshape(rows * TILE, columns * TILE, -1)
    return image[: layout.height, : layout.width]


def _to_tiles(
    layout: Layout, order: Int[Array, " N"], image: Float[Array, "H W k"]
) -> Float[Array, "N k P"]:
    """Cuts an image into tiles, in that order."""
    columns, rows = layout.grid
    below, beside = rows * TILE - layout.height, columns * TILE - layout.width
    padded = jnp.pad(image, ((0, below), (0, beside), (0, 0)))
    tiles = padded.reshape(rows, TILE, columns, TILE, -1).transpose(0, 2, 4, 1, 3)
    tiles = tiles.reshape(rows * columns, -1, PIXELS)
    return tiles.at[order].get(mode="fill", fill_value=0.0, wrap_negative_indices=False)


def stage(go: Bool[Array, ""], compute: Callable[..., Array], *args: Array) -> Array:
    """Computes compute(*args), into memory: XLA does not merge a branch with its surroundings.

    Args:
        go: true, but not known to be while compiling.
        compute: a function of arrays to one array.
        *args: its arguments.
    """
    result = jax.eval_shape(compute, *args)
    return jax.lax.cond(go, compute, lambda *_: jnp.zeros(result.shape, result.dtype), *args)


def see_chunk(
    go: Bool[Array, ""], splats: Float[Array, "11 B G"], through: Float[Array, "B P"]
) -> Chunk:
    """Evaluates a chunk at the pixels; `through` is the transmittance before it."""
    alpha = stage(go, _alpha, splats)
    products = stage(go, lambda alpha: _chain(1.0 - alpha, jnp.multiply), alpha)
    firsts, last = _link(through, products, jnp.multiply)
    weight = stage(go, _weight, alpha, products, firsts)
    return Chunk(splats=splats, alpha=alpha, weight=weight, through=last)


def chunk_sums(chunk: Chunk) -> Float[Array, "B 5 P"]:
    """Sums weight x (RGB, depth, 1) over the Gaussians of the chunk."""
    return jnp.einsum("kbg,bgp->bkp", chunk.splats[6:], chunk.weight)


def chunk_gradient(
    go: Bool[Array, ""],
    chunk: Chunk,
    wanted: Float[Array, "B 5 P"],
    total: Float[Array, "B P"],
    so_far: Float[Array, "B P"],
) -> tuple[Float[Array, "10 B G"], Float[Array, "B P"]]:
    """Computes the gradient by the splats of a chunk.

    With the transmittance T_i in front, the features c_i and v the cotangent of the pixel:
    alpha_i dL/dalpha_i = T_i alpha_i c_i.v - alpha_i / (1 - alpha_i) sum_(j > i) T_j alpha_j c_j.v

    Args:
        go: see `stage`.
        chunk: the Gaussians.
        wanted: v.
        total: sum of T alpha c.v over all Gaussians of the pixel.
        so_far: the same over those before this chunk.

    Returns:
        The gradient by center, conic, opacity, RGB and depth, and `so_far` with this chunk.
    """
    value = jnp.einsum("kbg,bkp->bgp", chunk.splats[6:], wanted)
    gain = stage(go, jnp.multiply, chunk.weight, value)
    sums = stage(go, partial(_chain, op=jnp.add), gain)
    firsts, last = _link(so_far, sums, jnp.add)
    pull = stage(go, _pull, chunk.alpha, chunk.weight, gain, sums, firsts, total)
    shape = _shape_gradient(chunk.splats, jnp.einsum("bgp,pm->mbg", pull, _moments()))
    features = jnp.einsum("bgp,bkp->kbg", chunk.weight, wanted[:, :4])
    return jnp.concatenate([shape, features]), last


def _alpha(splats: Float[Array, "11 B G"]) -> Float[Array, "B G P"]:
    """Computes min(0.99, o exp(-s)) at each pixel of the tile, 0 where it is skipped."""
    x, y, xx, xy, yy, opacity = splats[:6, :, :, None]
    px, py = (c[None, None, :] for c in pixel_offsets())
    dx, dy = x - px, y - py
    s = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = jnp.minimum(ALPHA_MAX, opacity * jnp.exp(-s))
    return jnp.where((alpha >= ALPHA_MIN) & (s >= 0.0), alpha, 0.0)


def _weight(
    alpha: Float[Array, "B G P"], products: Float[Array, "B O I P"], firsts: Float[Array, "B O P"]
) -> Float[Array, "B G P"]:
    """Computes T_i alpha_i, from the transmittance T_i (1 - alpha_i) behind the Gaussian."""
    behind = (firsts[:, :, None] * products).reshape(alpha.shape)
    return jnp.where(behind > TRANSMITTANCE_MIN, behind * (alpha / (1.0 - alpha)), 0.0)


def _pull(
    alpha: Float[Array, "B G P"],
    weight: Float[Array, "B G P"],
    gain: Float[Array, "B G P"],
    sums: Float[Array, "B O I P"],
    firsts: Float[Array, "B O P"],
    total: Float[Array, "B P"],
) -> Float[Array, "B G P"]:
    """Computes alpha dL/dalpha; 0 where alpha is clipped, since it is constant there."""
    later = total[:, None, :] - (firsts[:, :, None] + sums).reshape(alpha.shape)
    pull = gain - later * (alpha / (1.0 - alpha))
    return jnp.where((weight > 0.0) & (alpha < ALPHA_MAX), pull, 0.0)


def _shape_gradient(
    splats: Float[Array, "11 B G"], moments: Float[Array, "6 B G"]
) -> Float[Array, "6 B G"]:
    """Computes the gradient by center, conic and opacity.

    Args:
        splats: the Gaussians.
        moments: of alpha dL/dalpha = -dL/ds about the tile's middle, see `_moments`.
    """
    x, y, xx, xy, yy, opacity = splats[:6]
    one, mx, my, mxx, mxy, myy = moments
    # About the Gaussian's center: the sums of d, d d^T with d = center - pixel.
    dx, dy = x * one - mx, y * one - my
    dxx = x * (dx - mx) + mxx
    dxy = x * dy - y * mx + mxy
    dyy = y * (dy - my) + myy
    by_opacity = one / jnp.where(opacity > 0.0, opacity, 1.0)
    by_center = [-(xx * dx + xy * dy), -(xy * dx + yy * dy)]
    return jnp.stack([*by_center, -0.5 * dxx, -dxy, -0.5 * dyy, by_opacity])


def _chain(x: Float[Array, "B G P"], op: Operation) -> Float[Array, "B O I P"]:
    """Computes running products or sums within blocks of up to 8 elements of G."""
    tiles, size, pixels = x.shape
    inner = max(d for d in range(1, 9) if size % d == 0)
    blocks = x.reshape(tiles, size // inner, inner, pixels)
    chain = [blocks[:, :, 0]]
    for i in range(1, inner):
        chain.append(op(chain[-1], blocks[:, :, i]))
    return jnp.stack(chain, axis=2)


def _link(
    start: Float[Array, "B P"], chains: Float[Array, "B O I P"], op: Operation
) -> tuple[Float[Array, "B O P"], Float[Array, "B P"]]:
    """Chains the blocks of `_chain` from `start` on: the values before each, and after the last."""
    firsts = [start]
    for i in range(chains.shape[1]):
        firsts.append(op(firsts[-1], chains[:, i, -1]))
    return jnp.stack(firsts[:-1], axis=1), firsts[-1]


def pixel_offsets() -> tuple[Float[Array, " P"], Float[Array, " P"]]:
    """Computes the centers of a tile's pixels, row by row, relative to its middle [px]."""
    along = jnp.arange(TILE, dtype=jnp.float32) - 0.5 * (TILE - 1)
    return jnp.tile(along, TILE), jnp.repeat(along, TILE)


def _moments() -> Float[Array, "P 6"]:
    """Computes 1, x, y, x^2, xy, y^2 at a tile's pixels."""
    x, y = pixel_offsets()
    return jnp.stack([jnp.ones(PIXELS), x, y, x * x, x * y, y * y], axis=-1)


def grid_shape(width: int, height: int) -> tuple[int, int]:
    """Computes columns and rows of tiles in an image of this size [px]."""
    return -(-width // TILE), -(-height // TILE)


def list_tiles(
    center: Float[Array, "2 n"],
    reach: Float[Array, "2 n"],
    depth: Float[Array, " n"],
    width: int,
    height: int,
    budget: int,
) -> TileLists:
    """Bins Gaussians into the tiles that their boxes touch, sorted by (tile, depth).

    Args:
        center: column and row [px].
        reach: half width and half height of the box [px]; negative: not drawn.
        depth: z-depth [m]; at equal depths the first row is in front.
        width: of the image [px].
        height: of the image [px].
        budget: slots; what does not fit is counted in `overflow`.

    Returns:
        The lists of all tiles.
    """
    columns, rows = grid_shape(width, height)
    is_drawn = reach[0] >= 0.0
    boxes = tile_boxes(center, reach, columns, rows)
    order = near_to_far(depth, is_drawn)
    boxes = jax.tree.map(lambda x: x[order], boxes)
    end, total = _running_total(boxes.count, columns * rows)
    sizes = _sizes(budget)
    fitting = sum(((total <= size).astype(jnp.int32) for size in sizes[1:]), jnp.int32(0))
    branches = [partial(_sorted, grid=(columns, rows), size=size, budget=budget) for size in sizes]
    ids, bounds = jax.lax.switch(fitting, branches, boxes, order, end)
    return TileLists(
        ids=ids,
        start=bounds[:-1],
        count=bounds[1:] - bounds[:-1],
        num_intersections=total,
        overflow=jnp.maximum(total - budget, 0),
    )


def tile_boxes(
    center: Float[Array, "2 n"], reach: Float[Array, "2 n"], columns: int, rows: int
) -> TileBoxes:
    """Finds the tiles that the boxes center +- reach [px] touch, on a grid of columns x rows."""
    is_drawn = reach[0] >= 0.0

    def span(axis: int, size: int) -> tuple[Array, Array]:
        def tile_of(x: Array) -> Array:
            # Clipped as floats: integers cannot hold what lies far outside.
            return jnp.clip(jnp.floor(x / TILE), 0.0, size - 1.0)

        low = tile_of(jnp.where(is_drawn, center[axis] - reach[axis], 0.0))
        high = tile_of(jnp.where(is_drawn, center[axis] + reach[axis], 0.0))
        return low.astype(jnp.int32), high.astype(jnp.int32)

    (left, right), (top, bottom) = span(0, columns), span(1, rows)
    wide = right - left + 1
    count = jnp.where(is_drawn, wide * (bottom - top + 1), 0)
    return TileBoxes(first=top * columns + left, columns=wide, count=count)


def near_to_far(depth: Float[Array, " n"], is_drawn: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Sorts Gaussians that are drawn by depth, then the rest; returns the order. Stable.

    A radix sort: each pass sorts by some bits of the depth, the lowest first, the place in the
    order so far being the low bits of its keys.
    """
    n = depth.shape[0]
    bits = jax.lax.bitcast_convert_type(jnp.maximum(depth, NEAR_PLANE), jnp.uint32)
    base = jax.lax.bitcast_convert_type(jnp.float32(NEAR_PLANE), jnp.uint32)
    last = jnp.uint32(2**DEPTH_BITS - 1)
    keys = jnp.where(is_drawn, jnp.minimum(bits - base, last - jnp.uint32(1)), last)
    place_bits = max((n - 1).bit_length(), 1)
    places = jnp.arange(n, dtype=jnp.uint32)
    order = places
    for shift in range(0, DEPTH_BITS, 32 - place_bits):
        digits = keys[order] >> jnp.uint32(shift)
        placed = jnp.sort((digits << jnp.uint32(place_bits)) | places)
        order = order[placed & jnp.uint32(2**place_bits - 1)]
    return order.astype(jnp.int32)


def _running_total(
    count: Int[Array, " n"], num_tiles: int
) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """Computes the running sum of the counts, and their total.

    Both saturate instead of wrapping around.
    """
    end = jnp.cumsum(count)
    if count.shape[0] * num_tiles > MOST:
        approximate = jnp.cumsum(count.astype(jnp.float32))
        end = jnp.where(approximate < 0.99 * MOST, end, MOST)
    return end, end[-1]


def _sizes(budget: int) -> list[int]:
    """Lists the numbers of slots that may be sorted, falling.

    Sorting the whole budget would often be a waste.
    """
    sizes = [budget]
    while sizes[-1] > 1 << 15 and len(sizes) < 5:
        sizes.append(-(-sizes[-1] // 2))
    return sizes


def _sorted(
    boxes: TileBoxes,
    order: Int[Array, " n"],
    end: Int[Array, " n"],
    grid: tuple[int, int],
    size: int,
    budget: int,
) -> tuple[Int[Array, " m"], Int[Array, " bounds"]]:
    """Writes the intersections down in `size` slots and sorts them.

    Args:
        boxes: from near to far.
        order: the Gaussian of each box.
        end: running total of the boxes' tiles.
        grid: columns and rows of tiles.
        size: slots to use.
        budget: slots to return.

    Returns:
        The Gaussians of one tile after the other, and where each tile's begin, and the last ends.
    """
    num_tiles = grid[0] * grid[1]
    slots = jnp.arange(size)
    begin = end - boxes.count
    # Each box has a tile, but for those that are not drawn, which come last: so the number of
    # boxes opened up to a slot tells whose slot it is.
    opens = jnp.where(boxes.count > 0, begin, size)
    rank = jnp.cumsum(jnp.zeros(size, dtype=jnp.int32).at[opens].add(1, mode="drop")) - 1
    local, wide = slots - begin[rank], boxes.columns[rank]
    row = jnp.floor((local.astype(jnp.float32) + 0.5) / wide.astype(jnp.float32))
    tile = boxes.first[rank] + row.astype(jnp.int32) * (grid[0] - wide) + local
    tile = jnp.where(slots < end[-1], tile, num_tiles)
    rank, bounds = _sort_pairs(tile, rank, num_tiles, order.shape[0])
    return jnp.pad(order[rank], (0, budget - size)), bounds


def _sort_pairs(
    tile: Int[Array, " m"], rank: Int[Array, " m"], num_tiles: int, num_ranks: int
) -> tuple[Int[Array, " m"], Int[Array, " bounds"]]:
    """Sorts by (tile, rank); returns the ranks, and where each tile begins and the last ends."""
    rank_bits = max((num_ranks - 1).bit_length(), 1)
    tiles = jnp.arange(num_tiles + 1)
    if (num_tiles + 1) << rank_bits > 2**32:
        tile, rank = jax.lax.sort((tile, rank), num_keys=2)
        return rank, jnp.searchsorted(tile, tiles).astype(jnp.int32)
    shift = jnp.uint32(rank_bits)
    keys = jnp.sort((tile.astype(jnp.uint32) << shift) | rank.astype(jnp.uint32))
    bounds = jnp.searchsorted(keys, tiles.astype(jnp.uint32) << shift)
    return (keys & jnp.uint32(2**rank_bits - 1)).astype(jnp.int32), bounds.astype(jnp.int32)
