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
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.splatting.backend import Composite
from r3jax.splatting.config import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, RasterConfig
from r3jax.splatting.projection import project_gaussians
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.tiles import TileLists, grid_shape, list_tiles

PIXELS = TILE * TILE


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

    corner: Float[Array, "2 B"]
    """Column and row of its middle [px]."""

    inside: Bool[Array, "B P"]
    """True for the pixels that lie in the image."""


class Chunk(eqx.Module):
    """The next Gaussians of every tile of a batch, as its pixels see them."""

    ids: Int[Array, "B G"]
    """Which Gaussians; n where the tile has no more."""

    center: Float[Array, "2 B G"]
    """Relative to the tile's middle [px]."""

    conic: Float[Array, "3 B G"]
    """xx, xy, yy [1/px^2]."""

    opacity: Float[Array, "B G"]
    """In [0, 1]."""

    features: Float[Array, "B G 5"]
    """RGB, depth, 1."""

    alpha: Float[Array, "B G P"]
    """0 where skipped."""

    before: Float[Array, "B G P"]
    """Transmittance in front of the Gaussian."""

    behind: Float[Array, "B G P"]
    """Transmittance behind it."""

    @property
    def weight(self) -> Float[Array, "B G P"]:
        """What the Gaussian adds to the pixel: 0 once compositing has stopped."""
        return jnp.where(self.behind > TRANSMITTANCE_MIN, self.before * self.alpha, 0.0)


def rasterise(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
    config: RasterConfig,
) -> Composite:
    """Composites the scene on black; see `backend.Rasterise`.

    Raises:
        ValueError: a batch or chunk size below 1.
    """
    for name in ("tiles_per_batch", "gaussians_per_chunk"):
        if getattr(config, name) < 1:
            raise ValueError(f"RasterConfig.{name} must be at least 1, got {getattr(config, name)}")
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
    image = composite(layout, splats, lists)
    return Composite(
        rgb=image[..., :3],
        depth_sum=image[..., 3],
        alpha=image[..., 4],
        num_intersections=lists.num_intersections,
        overflow=lists.overflow,
    )


def _list_tiles(layout: Layout, budget: int, center: Array, reach: Array, depth: Array):
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


def _composite_fwd(layout: Layout, splats: Array, lists: TileLists):
    image = jax.custom_batching.sequential_vmap(partial(_forward, layout))(splats, lists)
    return image, (splats, lists, image)


def _composite_bwd(layout: Layout, residuals, cotangent: Array):
    splats, lists, image = residuals
    backward = jax.custom_batching.sequential_vmap(partial(_backward, layout))
    return backward(splats, lists, image, cotangent), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _forward(layout: Layout, splats: Float[Array, "n 10"], lists: TileLists) -> Array:
    """The image [H, W, 5]."""
    order = _by_count(layout, lists)

    def composite_batch(i: Array, tiles: Array) -> Array:
        batch = _batch(
            layout, lists, jax.lax.dynamic_slice_in_dim(order, i * layout.batch, layout.batch)
        )

        def add_chunk(carry):
            j, through, sums = carry
            chunk = _chunk(layout, splats, lists, batch, j, through)
            sums = sums + jnp.einsum("bgk,bgp->bkp", chunk.features, chunk.weight)
            return j + 1, chunk.behind[:, -1], sums

        start = (
            jnp.int32(0),
            batch.inside.astype(jnp.float32),
            jnp.zeros((layout.batch, 5, PIXELS)),
        )
        _, _, sums = jax.lax.while_loop(partial(_goes_on, layout, batch), add_chunk, start)
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
    """The gradient by the splats."""
    order = _by_count(layout, lists)
    wanted = _to_tiles(layout, order, cotangent)
    # Sum over all Gaussians of weight x (features . cotangent).
    whole = jnp.sum(wanted * _to_tiles(layout, order, image), axis=1)

    def differentiate_batch(i: Array, gradient: Array) -> Array:
        def take(x: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(x, i * layout.batch, layout.batch)

        batch = _batch(layout, lists, take(order))
        v, total = take(wanted), take(whole)

        def add_chunk(carry):
            j, through, so_far, gradient = carry
            chunk = _chunk(layout, splats, lists, batch, j, through)
            part, so_far = _chunk_gradient(chunk, v, total, so_far)
            gradient = gradient.at[chunk.ids.reshape(-1)].add(part.reshape(-1, 10), mode="drop")
            return j + 1, chunk.behind[:, -1], so_far, gradient

        start = (jnp.int32(0), batch.inside.astype(jnp.float32), jnp.zeros_like(total), gradient)
        return jax.lax.while_loop(partial(_goes_on, layout, batch), add_chunk, start)[-1]

    return jax.lax.fori_loop(0, layout.num_batches, differentiate_batch, jnp.zeros_like(splats))


def _chunk_gradient(
    chunk: Chunk,
    v: Float[Array, "B 5 P"],
    total: Float[Array, "B P"],
    so_far: Float[Array, "B P"],
) -> tuple[Float[Array, "B G 10"], Float[Array, "B P"]]:
    """The gradient by the splats of a chunk.

    With the color c_i, transmittance T_i in front and v the cotangent of the pixel:
    dL/dalpha_i = T_i c_i.v - (sum over j > i of T_j alpha_j c_j.v) / (1 - alpha_i).

    Args:
        chunk: the Gaussians.
        v: cotangent of the image.
        total: sum of weight x features . v over all Gaussians of the pixel.
        so_far: the same over those before this chunk.

    Returns:
        The gradient of each splat, and the sum including this chunk.
    """
    weight = chunk.weight
    value = jnp.einsum("bgk,bkp->bgp", chunk.features, v)
    _, through = _running(weight * value, so_far, jnp.add, 0.0)
    later = total[:, None, :] - through
    later = jnp.where(chunk.behind > TRANSMITTANCE_MIN, later, 0.0)
    # alpha dL/dalpha; a clipped alpha does not move.
    pull = weight * value - chunk.alpha * later / (1.0 - chunk.alpha)
    pull = jnp.where(chunk.alpha < ALPHA_MAX, pull, 0.0)
    sums = jnp.einsum("bgp,pm->mbg", pull, _moments())
    x, y = chunk.center
    xx, xy, yy = chunk.conic
    # Moments about the Gaussian's center, from those about the tile's middle.
    dx, dy = x * sums[0] - sums[1], y * sums[0] - sums[2]
    dxx = x * dx - x * sums[1] + sums[3]
    dxy = x * dy - y * sums[1] + sums[4]
    dyy = y * dy - y * sums[2] + sums[5]
    opacity = sums[0] / jnp.where(chunk.opacity > 0.0, chunk.opacity, 1.0)
    shape = jnp.stack(
        [-xx * dx - xy * dy, -xy * dx - yy * dy, -0.5 * dxx, -dxy, -0.5 * dyy, opacity], axis=-1
    )
    features = jnp.einsum("bgp,bkp->bgk", weight, v[:, :4])
    return jnp.concatenate([shape, features], axis=-1), through[:, -1]


def _goes_on(layout: Layout, batch: Batch, carry) -> Bool[Array, ""]:
    j, through = carry[:2]
    is_open = (through > TRANSMITTANCE_MIN).any(axis=1)
    return (is_open & (j * layout.chunk < batch.count)).any()


def _chunk(
    layout: Layout,
    splats: Float[Array, "n 10"],
    lists: TileLists,
    batch: Batch,
    j: Int[Array, ""],
    through: Float[Array, "B P"],
) -> Chunk:
    """The j-th chunk of every tile of a batch, `through` being the transmittance before it."""
    place = j * layout.chunk + jnp.arange(layout.chunk)
    valid = place[None, :] < batch.count[:, None]
    slots = jnp.where(valid, batch.start[:, None] + place[None, :], 0)
    ids = jnp.where(valid, lists.ids[slots], splats.shape[0])
    rows = splats.at[ids].get(mode="fill", fill_value=0.0)
    center = jnp.moveaxis(rows[..., :2], -1, 0) - batch.corner[:, :, None]
    conic = jnp.moveaxis(rows[..., 2:5], -1, 0)
    alpha = _alpha(center, conic, rows[..., 5])
    before, behind = _running(1.0 - alpha, through, jnp.multiply, 1.0)
    ones = jnp.ones((*ids.shape, 1))
    return Chunk(
        ids=ids,
        center=center,
        conic=conic,
        opacity=rows[..., 5],
        features=jnp.concatenate([rows[..., 6:], ones], axis=-1),
        alpha=alpha,
        before=before,
        behind=behind,
    )


def _alpha(
    center: Float[Array, "2 B G"], conic: Float[Array, "3 B G"], opacity: Float[Array, "B G"]
) -> Float[Array, "B G P"]:
    """min(0.99, o exp(-s)) at each pixel of the tile, 0 where it is skipped."""
    px, py = _pixels()
    dx, dy = center[0][..., None] - px, center[1][..., None] - py
    xx, xy, yy = conic[..., None]
    s = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = jnp.minimum(ALPHA_MAX, opacity[..., None] * jnp.exp(-s))
    return jnp.where((alpha >= ALPHA_MIN) & (s >= 0.0), alpha, 0.0)


def _running(
    x: Float[Array, "B G P"], start: Float[Array, "B P"], op, unit: float
) -> tuple[Float[Array, "B G P"], Float[Array, "B G P"]]:
    """Running products or sums along G, from `start` on: without and with each element.

    In two levels, each a chain of elementwise operations: XLA's own scans are several times slower.
    """
    b, g, p = x.shape
    inner = max(d for d in range(1, 9) if g % d == 0)
    blocks = x.reshape(b, g // inner, inner, p)
    chain = [blocks[:, :, 0]]
    for i in range(1, inner):
        chain.append(op(chain[-1], blocks[:, :, i]))
    firsts = [start]
    for i in range(g // inner - 1):
        firsts.append(op(firsts[-1], chain[-1][:, i]))
    first = jnp.stack(firsts, axis=1)[:, :, None]
    within = jnp.stack(chain, axis=2)
    units = jnp.full_like(within[:, :, :1], unit)
    without = op(first, jnp.concatenate([units, within[:, :, :-1]], axis=2))
    return without.reshape(b, g, p), op(first, within).reshape(b, g, p)


def _pixels() -> tuple[Float[Array, "1 1 P"], Float[Array, "1 1 P"]]:
    """Centers of a tile's pixels, row by row, relative to its middle [px]."""
    along = jnp.arange(TILE) - 0.5 * (TILE - 1)
    return jnp.tile(along, TILE)[None, None, :], jnp.repeat(along, TILE)[None, None, :]


def _moments() -> Float[Array, "P 6"]:
    """1, x, y, x^2, xy, y^2 at a tile's pixels."""
    x, y = (c.reshape(-1) for c in _pixels())
    return jnp.stack([jnp.ones(PIXELS), x, y, x * x, x * y, y * y], axis=-1)


def _by_count(layout: Layout, lists: TileLists) -> Int[Array, " N"]:
    """The tiles, those with most Gaussians first, filled up to whole batches with -1."""
    order = jnp.argsort(-lists.count)
    return jnp.pad(
        order, (0, layout.num_batches * layout.batch - order.shape[0]), constant_values=-1
    )


def _batch(layout: Layout, lists: TileLists, tiles: Int[Array, " B"]) -> Batch:
    is_real = tiles >= 0
    tile = jnp.where(is_real, tiles, 0)
    row, column = jnp.divmod(tile, layout.grid[0])
    corner = (jnp.stack([column, row]) * TILE).astype(jnp.float32) + 0.5 * TILE
    px, py = _pixels()
    inside = (corner[0][:, None] + px[0] < layout.width) & (
        corner[1][:, None] + py[0] < layout.height
    )
    return Batch(
        start=lists.start[tile],
        count=jnp.where(is_real, lists.count[tile], 0),
        corner=corner,
        inside=inside,
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
