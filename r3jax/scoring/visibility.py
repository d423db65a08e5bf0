"""Which voxels and cells a camera can see: depth buffers of voxels, pinhole and panoramic.

Every voxel is splatted once, as a block of 2x2 pixels, into the level of an image pyramid whose
pixels are about as large as the voxel appears; then the coarse levels are pushed down. A near
voxel so covers many pixels and a far one less than one, at the same cost (the idea of ODGS,
omnidirectional splatting, on voxels).

The panoramic buffer is an octahedral map of the sphere round a position: no poles, and its
borders wrap in closed form.

Shape symbols: n voxels; c points; h w size of the finest level; S side of the panorama.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.geometry.cameras import Camera
from r3jax.scoring.chunks import Selection, for_selected, narrow, select
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


Coordinates = Float[Array, "3 n"] | tuple[Array, Array, Array]
"""x, y and z of points [m], as one array or three."""


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

    ahead: Bool[Array, " n"]
    """False behind the camera, where the rest means nothing."""


class PinholeView(eqx.Module):
    """One view, at the size of its depth buffer."""

    camera: Camera
    """Intrinsics of the buffer."""

    T_world_camera: Float[Array, "4 4"]
    """Pose."""

    max_range: Float[Array, ""]
    """Nothing farther is visible [m]."""

    wraps: ClassVar[bool] = False

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the buffer [px]."""
        return self.camera.height, self.camera.width

    def in_camera(self, points: Coordinates) -> tuple[Array, Array, Array]:
        """Coordinates in the camera's frame [m]."""
        R, t = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        offset = [points[i] - t[i] for i in range(3)]
        along = lambda j: R[0, j] * offset[0] + R[1, j] * offset[1] + R[2, j] * offset[2]
        return along(0), along(1), along(2)

    def may_see(self, points: Coordinates, margin: Float[Array, ""]) -> Bool[Array, " n"]:
        """False only for points that lie outside the frustum by more than `margin` [m]."""
        x, y, z = self.in_camera(points)
        camera = self.camera
        reach = self.max_range + margin
        low_x, high_x = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
        low_y, high_y = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
        # Distance to a side plane x = k z is |x - k z| / sqrt(1 + k^2).
        slack = lambda k: margin * jnp.sqrt(1.0 + k * k)
        is_in = (x >= low_x * z - slack(low_x)) & (x <= high_x * z + slack(high_x))
        is_in &= (y >= low_y * z - slack(low_y)) & (y <= high_y * z + slack(high_y))
        return is_in & (z > -margin) & (x * x + y * y + z * z <= reach * reach)

    def place(self, points: Float[Array, "3 n"]) -> Placement:
        """Projects points of the world."""
        x, y, z = self.in_camera(points)
        is_ahead = z > 1e-3
        inverse = 1.0 / jnp.where(is_ahead, z, 1.0)
        return Placement(
            column=self.camera.fx * x * inverse + self.camera.cx,
            row=self.camera.fy * y * inverse + self.camera.cy,
            column_scale=self.camera.fx * inverse,
            row_scale=self.camera.fy * inverse,
            distance=jnp.sqrt(x * x + y * y + z * z),
            ahead=is_ahead,
        )


class PanoramaView(eqx.Module):
    """All directions round a position, on an octahedral map."""

    position: Float[Array, " 3"]
    """[m], world."""

    max_range: Float[Array, ""]
    """Nothing farther is visible [m]."""

    size: int = eqx.field(static=True)
    """Side of the map [px]."""

    wraps: ClassVar[bool] = True

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the buffer [px]."""
        return self.size, self.size

    def may_see(self, points: Coordinates, margin: Float[Array, ""]) -> Bool[Array, " n"]:
        """False only for points out of range by more than `margin` [m]."""
        x, y, z = (points[i] - self.position[i] for i in range(3))
        reach = self.max_range + margin
        return x * x + y * y + z * z <= reach * reach

    def place(self, points: Float[Array, "3 n"]) -> Placement:
        """Projects points of the world on the map.

        For a unit direction d and a = |x| / |d|_1 the map stretches |grad u| =
        sqrt(1 - 2 a + 3 a^2) / |d|_1 along u, between 0.47 and 1.41; on the lower half u and v
        swap.
        """
        x, y, z = (points[i] - self.position[i] for i in range(3))
        distance = jnp.maximum(jnp.sqrt(x * x + y * y + z * z), 1e-6)
        inverse = 1.0 / jnp.maximum(jnp.abs(x) + jnp.abs(y) + jnp.abs(z), 1e-6)
        u, v = x * inverse, y * inverse
        a, b = jnp.abs(u), jnp.abs(v)
        sign = lambda value: jnp.where(value >= 0.0, 1.0, -1.0)
        half = 0.5 * self.size
        is_lower = z < 0.0
        p, q = jnp.where(is_lower, b, a), jnp.where(is_lower, a, b)
        return Placement(
            column=jnp.where(is_lower, (1.0 - b) * sign(u), u) * half + half,
            row=jnp.where(is_lower, (1.0 - a) * sign(v), v) * half + half,
            column_scale=half * inverse * jnp.sqrt(1.0 - 2.0 * p + 3.0 * p * p),
            row_scale=half * inverse * jnp.sqrt(1.0 - 2.0 * q + 3.0 * q * q),
            distance=distance,
            ahead=jnp.ones(distance.shape, dtype=bool),
        )


View = PinholeView | PanoramaView


def pinhole_view(
    camera: Camera, T_world_camera: Float[Array, "4 4"], config: ScoringConfig
) -> PinholeView:
    """The view of a camera; its longest side is reduced to `config.zbuffer_size` pixels.

    Visibility is piecewise constant, so no derivative passes through the pose.
    """
    longest = max(camera.width, camera.height)
    scale = min(1.0, config.zbuffer_size / longest)
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    pose = jax.lax.stop_gradient(T_world_camera)
    return PinholeView(camera.resized(*size), pose, config.max_range)


def panorama_view(position: Float[Array, " 3"], config: ScoringConfig) -> PanoramaView:
    """All directions from a position; no derivative passes through it."""
    still = jax.lax.stop_gradient(position)
    return PanoramaView(still, config.max_range, config.panorama_size)


def candidates_of(voxels: Voxels, view: View) -> Selection:
    """The voxels that may appear in a view: a tenth to a half of a map."""
    return select(voxels.present & view.may_see(voxels.center, voxels.size))


def depth_buffer(
    voxels: Voxels, candidates: Selection, view: View, config: ScoringConfig
) -> DepthBuffer:
    """The nearest voxel in every pixel of a view."""
    shapes = _pyramid(view.shape)
    offsets = [0]
    for height, width in shapes:
        offsets.append(offsets[-1] + height * width)
    num = candidates.num
    item_bits = max(1, (num - 1).bit_length())

    def splat(index, valid, pixels):
        place = view.place(voxels.center_of(index))
        valid = valid & place.ahead & (place.distance <= view.max_range)
        packed = _pack(place.distance / view.max_range, index, item_bits)
        for target in _footprint(place, valid, voxels.size, shapes, offsets, wraps=view.wraps):
            pixels = pixels.at[target].min(packed, mode="drop")
        return pixels

    blank = jnp.full(offsets[-1], _NOTHING, dtype=jnp.uint32)
    finest = _push_down(for_selected(candidates, splat, blank), shapes, offsets)
    is_hit = finest != jnp.uint32(_NOTHING)
    item = jnp.where(is_hit, (finest & jnp.uint32((1 << item_bits) - 1)).astype(jnp.int32), num)
    share = (finest >> item_bits).astype(jnp.float32) / _num_steps(item_bits)
    distance = jnp.where(is_hit, share * view.max_range, jnp.inf)
    return DepthBuffer(item, distance, _limit(distance, config.tolerance, voxels.size))


def visible_voxels(
    voxels: Voxels, candidates: Selection, view: View, buffer: DepthBuffer
) -> Selection:
    """The voxels that the view sees: not hidden by voxels, in the image and within range."""

    def test(index):
        return is_visible(view, view.place(voxels.center_of(index)), buffer.limit)

    return narrow(candidates, test)


def is_visible(view: View, place: Placement, limit: Float[Array, "h w"]) -> Bool[Array, " n"]:
    """True for points in the image and within range, no farther than `limit` at their pixel.

    Args:
        view: the view.
        place: where the points fall in it.
        limit: `DepthBuffer.limit` for points on surfaces, `DepthBuffer.distance` for points in
            empty space, which nothing may hide.
    """
    height, width = limit.shape
    is_in = (place.column >= 0.0) & (place.column < width) & place.ahead
    is_in &= (place.row >= 0.0) & (place.row < height) & (place.distance <= view.max_range)
    column = jnp.clip(place.column, 0.0, width - 1.0).astype(jnp.int32)
    row = jnp.clip(place.row, 0.0, height - 1.0).astype(jnp.int32)
    return is_in & (place.distance <= limit.reshape(-1)[row * width + column])


def _num_steps(item_bits: int) -> float:
    return float((1 << (32 - item_bits)) - 1)


def _pack(
    share: Float[Array, " n"], index: Int[Array, " n"], item_bits: int
) -> UInt32[Array, " n"]:
    """Distance in the high bits, index in the low ones: `min` keeps the nearest voxel."""
    steps = (jnp.clip(share, 0.0, 1.0) * _num_steps(item_bits)).astype(jnp.uint32)
    packed = (steps << item_bits) | index.astype(jnp.uint32)
    return jnp.minimum(packed, jnp.uint32(_NOTHING - 1))  # all ones would read as "nothing"


def _pyramid(shape: tuple[int, int]) -> list[tuple[int, int]]:
    shapes = [shape]
    while max(shapes[-1]) > 1:
        height, width = shapes[-1]
        shapes.append((-(-height // 2), -(-width // 2)))
    return shapes


def _footprint(
    place: Placement,
    valid: Bool[Array, " n"],
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
            is_in = valid & covers_row & covers_column
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
    return (
        distance
        + tolerance * voxel_size
        + jnp.minimum(_SLOPE_GAIN * slope, _MAX_SLOPE * voxel_size)
    )
