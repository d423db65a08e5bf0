"""Lists the Gaussians that touch each tile of the image, from near to far.

XLA on a CPU sorts one array of integers seven times faster than an array with a payload. So every
sort here is of one array, with the payload in the low bits of the key.

Shape symbols: n Gaussians, t tiles (row by row), m slots for intersections (the budget).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.kernels.constants import NEAR_PLANE, TILE

DEPTH_BITS = 28
"""Bits of a float32 depth counted from 0.01 m: exact to 4e7 m, for each power of two takes 23."""

MOST = 2**31 - 1
"""Counts saturate here."""


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
