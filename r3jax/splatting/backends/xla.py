"""Compositing in pure JAX: batches of tiles, chunks of Gaussians, sums as matrix products.

Tiles with about the same number of Gaussians are composited together, a chunk of Gaussians at a
time, from near to far, until every pixel of the batch is opaque. Nothing is kept for the backward
pass but the image: it goes the same way once more, with the sums so far telling those to come.

Shape symbols: n Gaussians, m slots of the tile lists, B tiles of a batch, G Gaussians of a chunk,
P = 256 pixels of a tile, N tiles padded to whole batches.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels.constants import TILE, TRANSMITTANCE_MIN
from r3jax.splatting.backend import Composite
from r3jax.splatting.backends.tiles import TileLists, grid_shape, list_tiles
from r3jax.splatting.backends.xla_chunk import (
    PIXELS,
    chunk_gradient,
    chunk_sums,
    pixel_offsets,
    see_chunk,
    stage,
)
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.projection import project_gaussians
from r3jax.splatting.scene import GaussianScene


class Layout(eqx.Module):
    """What is known while compiling."""

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
