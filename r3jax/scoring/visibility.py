"""Which voxels and cells a camera can see: depth buffers of voxels, pinhole and panoramic.

Every voxel is splatted once, as a block of 2x2 pixels, into the level of an image pyramid whose
pixels are about as large as the voxel appears; then the coarse levels are pushed down. A near
voxel so covers many pixels and a far one less than one, at the same cost (the idea of ODGS,
omnidirectional splatting, on voxels).

The panoramic buffer is an octahedral map of the sphere round a position: no poles, and its
borders wrap in closed form.

Shape symbols: n voxels; c points; h w size of the finest level; S side of the panorama.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.geometry.cameras import Camera
from r3jax.geometry.numerics import safe_norm
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.voxels import Voxels

_HALF_WIDTH = 0.51
"""A voxel covers the pixel centers within this many edges of its own center: a little more than
half, so that neighbors in a wall leave no gap, and hardly more, so that they hide little."""

_SLOPE_GAIN = 2.0
"""Pixels of slope that the visibility test forgives: the reach of a footprint."""

_MAX_SLOPE = 4.0
"""And at most so many voxels, so that a ragged silhouette does not open what lies behind it."""

_NOTHING = 0xFFFFFFFF


class DepthBuffer(eqx.Module):
    """The nearest voxel per pixel."""

    item: Int[Array, "h w"]
    """Index of the voxel; n where there is none."""

    distance: Float[Array, "h w"]
    """Distance of its center from the camera [m]; inf where there is none."""

    limit: Float[Array, "h w"]
    """Voxels up to this distance are visible in this pixel [m]."""


class Placement(eqx.Module):
    """Where points fall in a buffer."""

    column: Float[Array, " n"]
    """Continuous column [px]."""

    row: Float[Array, " n"]
    """Continuous row [px]."""

    column_scale: Float[Array, " n"]
    """Columns per meter across the line of sight, at the point's distance [px/m]."""

    row_scale: Float[Array, " n"]
    """Rows per meter, likewise [px/m]."""

    distance: Float[Array, " n"]
    """From the camera [m]."""

    inside: Bool[Array, " n"]
    """In front of the camera and within range; the image borders are not tested."""


def reduced_camera(camera: Camera, config: ScoringConfig) -> Camera:
    """The camera at the depth buffer's size: the longest side has at most `zbuffer_size` px."""
    longest = max(camera.width, camera.height)
    scale = min(1.0, config.zbuffer_size / longest)
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def place_pinhole(
    points: Float[Array, "3 n"],
    present: Bool[Array, " n"],
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    max_range: Float[Array, ""],
) -> Placement:
    """Projects points of the world into a pinhole camera."""
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    offset = [points[i] - t[i] for i in range(3)]
    x, y, z = (sum(R[i, j] * offset[i] for i in range(3)) for j in range(3))
    distance = jnp.sqrt(x * x + y * y + z * z)
    is_ahead = z > 1e-3
    inverse = 1.0 / jnp.where(is_ahead, z, 1.0)
    return Placement(
        column=camera.fx * x * inverse + camera.cx,
        row=camera.fy * y * inverse + camera.cy,
        column_scale=camera.fx * inverse,
        row_scale=camera.fy * inverse,
        distance=distance,
        inside=present & is_ahead & (distance <= max_range),
    )


def place_panorama(
    points: Float[Array, "3 n"],
    present: Bool[Array, " n"],
    position: Float[Array, " 3"],
    size: int,
    max_range: Float[Array, ""],
) -> Placement:
    """Projects points of the world on the octahedral map round a position.

    For a unit direction d and a = |x| / |d|_1 the map stretches |grad u| =
    sqrt(1 - 2 a + 3 a^2) / |d|_1 along u, between 0.47 and 1.41; on the lower half u and v swap.
    """
    offset = points - position[:, None]
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    x, y, z = offset / distance[None, :]
    inverse = 1.0 / (jnp.abs(x) + jnp.abs(y) + jnp.abs(z))
    u, v = x * inverse, y * inverse
    a, b = jnp.abs(u), jnp.abs(v)
    sign = lambda value: jnp.where(value >= 0.0, 1.0, -1.0)
    half = 0.5 * size
    is_lower = z < 0.0
    column = jnp.where(is_lower, (1.0 - b) * sign(u), u) * half + half
    row = jnp.where(is_lower, (1.0 - a) * sign(v), v) * half + half
    p, q = jnp.where(is_lower, b, a), jnp.where(is_lower, a, b)
    scale = half * inverse / distance
    return Placement(
        column=column,
        row=row,
        column_scale=scale * jnp.sqrt(1.0 - 2.0 * p + 3.0 * p * p),
        row_scale=scale * jnp.sqrt(1.0 - 2.0 * q + 3.0 * q * q),
        distance=distance,
        inside=present & (distance <= max_range),
    )


def pinhole_buffer(
    voxels: Voxels, camera: Camera, T_world_camera: Float[Array, "4 4"], config: ScoringConfig
) -> DepthBuffer:
    """Depth buffer of one view, at the reduced size."""
    small = reduced_camera(camera, config)
    place = place_pinhole(voxels.center, voxels.present, small, T_world_camera, config.max_range)
    return _splat(place, (small.height, small.width), voxels.size, config, wraps=False)


def panorama_buffer(
    voxels: Voxels, position: Float[Array, " 3"], config: ScoringConfig
) -> DepthBuffer:
    """Depth buffer of all directions from one position; every view there can reuse it."""
    size = config.panorama_size
    place = place_panorama(voxels.center, voxels.present, position, size, config.max_range)
    return _splat(place, (size, size), voxels.size, config, wraps=True)


def is_visible(place: Placement, buffer: DepthBuffer, *, strict: bool = False) -> Bool[Array, " n"]:
    """True for points whose pixel lies in the buffer and shows nothing clearly nearer.

    Args:
        place: where the points fall in the buffer.
        buffer: of the same view.
        strict: points of empty space: nothing nearer at all. Otherwise points of the surfaces
            themselves, for which the buffer's tolerance is meant.
    """
    height, width = buffer.limit.shape
    is_in = (place.column >= 0.0) & (place.column < width)
    is_in &= (place.row >= 0.0) & (place.row < height) & place.inside
    column = jnp.clip(place.column, 0.0, width - 1.0).astype(jnp.int32)
    row = jnp.clip(place.row, 0.0, height - 1.0).astype(jnp.int32)
    limit = (buffer.distance if strict else buffer.limit).reshape(-1)[row * width + column]
    return is_in & (place.distance <= limit)


def _splat(
    place: Placement,
    shape: tuple[int, int],
    voxel_size: Float[Array, ""],
    config: ScoringConfig,
    *,
    wraps: bool,
) -> DepthBuffer:
    num = place.distance.shape[0]
    shapes = _pyramid(shape)
    offsets = [0]
    for height, width in shapes:
        offsets.append(offsets[-1] + height * width)
    item_bits = max(1, (num - 1).bit_length())
    packed = _pack(place, item_bits, config.max_range)
    pixels = jnp.full(offsets[-1], _NOTHING, dtype=jnp.uint32)
    for index in _block_indices(place, voxel_size, shapes, offsets, wraps=wraps):
        pixels = pixels.at[index].min(packed, mode="drop")
    finest = _push_down(pixels, shapes, offsets)
    is_hit = finest != jnp.uint32(_NOTHING)
    item = jnp.where(is_hit, (finest & jnp.uint32((1 << item_bits) - 1)).astype(jnp.int32), num)
    step = config.max_range / float(1 << (32 - item_bits))
    distance = jnp.where(is_hit, (finest >> item_bits).astype(jnp.float32) * step, jnp.inf)
    return DepthBuffer(item, distance, _limit(distance, config.tolerance * voxel_size, voxel_size))


def _pack(place: Placement, item_bits: int, max_range: Float[Array, ""]) -> UInt32[Array, " n"]:
    """Distance in the high bits, index in the low ones: `min` keeps the nearest voxel."""
    num_steps = float((1 << (32 - item_bits)) - 1)
    share = jnp.clip(place.distance / max_range, 0.0, 1.0)
    steps = (share * num_steps).astype(jnp.uint32)
    index = jnp.arange(place.distance.shape[0], dtype=jnp.uint32)
    # All ones would read as "nothing".
    return jnp.minimum((steps << item_bits) | index, jnp.uint32(_NOTHING - 1))


def _pyramid(shape: tuple[int, int]) -> list[tuple[int, int]]:
    shapes = [shape]
    while max(shapes[-1]) > 1:
        height, width = shapes[-1]
        shapes.append((-(-height // 2), -(-width // 2)))
    return shapes


def _block_indices(
    place: Placement,
    voxel_size: Float[Array, ""],
    shapes: list[tuple[int, int]],
    offsets: list[int],
    *,
    wraps: bool,
) -> list[Int[Array, " n"]]:
    """Indices into the pyramid of the pixels that each voxel covers; out of bounds: dropped.

    The level is the first on which the footprint spans at most two pixel centers an axis.
    """
    widths = [2.0 * _HALF_WIDTH * voxel_size * x for x in (place.column_scale, place.row_scale)]
    widest = jnp.maximum(jnp.maximum(widths[0], widths[1]), 1e-6)
    level = jnp.clip(jnp.ceil(jnp.log2(0.5 * widest)), 0.0, len(shapes) - 1.0)
    scale = jnp.exp2(-level)
    level = level.astype(jnp.int32)
    table = lambda values: jnp.asarray(values, dtype=jnp.int32)[level]
    height, width = table([s[0] for s in shapes]), table([s[1] for s in shapes])
    offset = table(offsets[:-1])
    columns = _covered(place.column * scale, widths[0] * scale)
    rows = _covered(place.row * scale, widths[1] * scale)
    indices = []
    for r, covers_row in rows:
        for c, covers_column in columns:
            is_in = place.inside & covers_row & covers_column
            if wraps:
                r_in, c_in = _wrap(r, c, height)
            else:
                is_in = is_in & (r >= 0) & (r < height) & (c >= 0) & (c < width)
                r_in, c_in = r, c
            indices.append(jnp.where(is_in, offset + r_in * width + c_in, offsets[-1]))
    return indices


def _covered(
    middle: Float[Array, " n"], width: Float[Array, " n"]
) -> list[tuple[Int[Array, " n"], Bool[Array, " n"]]]:
    """The two pixels round a coordinate, and whether a footprint of `width` covers each center.

    The pixel that holds the coordinate is always covered.
    """
    first = jnp.floor(jnp.clip(middle, -2.0, 1e6) - 0.5)
    reach = jnp.maximum(0.5 * width, 0.5)
    return [
        (pixel.astype(jnp.int32), jnp.abs(pixel + 0.5 - middle) <= reach)
        for pixel in (first, first + 1.0)
    ]


def _wrap(
    row: Int[Array, " n"], column: Int[Array, " n"], size: Int[Array, " n"]
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Pixels one step outside the octahedral map: its borders are glued to themselves, turned."""
    crosses_column = (column < 0) | (column >= size)
    crosses_row = (row < 0) | (row >= size)
    turned_row = jnp.where(crosses_column, size - 1 - row, row)
    turned_column = jnp.where(crosses_row, size - 1 - column, column)
    return jnp.clip(turned_row, 0, size - 1), jnp.clip(turned_column, 0, size - 1)


def _push_down(
    pixels: UInt32[Array, " p"], shapes: list[tuple[int, int]], offsets: list[int]
) -> UInt32[Array, "h w"]:
    """The minimum over all levels, at the finest."""
    level = lambda i: pixels[offsets[i] : offsets[i + 1]].reshape(shapes[i])
    combined = level(len(shapes) - 1)
    for i in range(len(shapes) - 2, -1, -1):
        height, width = shapes[i]
        enlarged = jnp.repeat(jnp.repeat(combined, 2, axis=0), 2, axis=1)[:height, :width]
        combined = jnp.minimum(level(i), enlarged)
    return combined


def _limit(
    distance: Float[Array, "h w"], tolerance: Float[Array, ""], voxel_size: Float[Array, ""]
) -> Float[Array, "h w"]:
    """Distance up to which voxels count as the surface in the buffer, not as behind it.

    On a surface seen at a grazing angle the block of a near voxel covers the pixels of farther
    ones. As in shadow mapping the allowance grows with the buffer's slope, taken on the flatter
    side of each axis so that a silhouette does not count.
    """
    slope = jnp.zeros_like(distance)
    capped = jnp.minimum(distance, 1e4)
    for axis in (0, 1):
        if distance.shape[axis] < 3:
            continue
        n = distance.shape[axis]
        step = jnp.abs(jnp.diff(capped, axis=axis))
        first = jnp.concatenate([jnp.take(step, jnp.array([0]), axis=axis), step], axis=axis)
        second = jnp.concatenate([step, jnp.take(step, jnp.array([n - 2]), axis=axis)], axis=axis)
        slope = slope + jnp.minimum(first, second)
    return distance + tolerance + jnp.minimum(_SLOPE_GAIN * slope, _MAX_SLOPE * voxel_size)
