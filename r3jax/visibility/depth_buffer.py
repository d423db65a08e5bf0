"""Computes which voxels and points a camera sees, by pinhole and panoramic depth buffers of voxels.

Every voxel is splatted once into an image pyramid, on the level on which it covers at most 2x2
pixels; then the coarse levels are pushed down. A near voxel thus covers many pixels and a far one
less than one, at the same cost. Walls have no gaps: every voxel covers the pixel centers inside its
own projection, and the projections of neighbors meet. This applies the idea of ODGS,
omnidirectional splatting, to voxels.

Shape symbols: n voxels; m points; h w size of the finest level.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.selection import SPARE, spare_places
from r3jax.kernels.constants import (
    CORNER,
    FAR,
    HALF_WIDTH,
    MAX_STRETCH,
    NEAR,
    SEAM,
    STRIDES,
)
from r3jax.visibility.views import Placement, View, VisibilityConfig, wrap


class DepthBuffer(eqx.Module):
    """The nearest voxel per pixel; the first one if several are equally near."""

    distance: Float[Array, "h w"]
    """Distance of the nearest voxel's center from the camera [m]; inf where there is none."""

    row: Int[Array, "h w"]
    """Index of the nearest voxel; n where there is none."""

    limit: Float[Array, "h w"]
    """Voxels up to this distance are visible in this pixel [m]."""


class Voxels(eqx.Module):
    """Positions of voxels."""

    center: Float[Array, "3 n"]
    """[m]."""

    present: Bool[Array, " n"]
    """False where there is none."""

    size: Float[Array, ""]
    """Edge [m]."""


def depth_buffer(voxels: Voxels, view: View, config: VisibilityConfig) -> DepthBuffer:
    """Finds the nearest voxel in every pixel of a view; no derivative passes through it."""
    voxels = jax.lax.stop_gradient(voxels)
    distance, row = _nearest(voxels, view)
    # On a slanted wall, voxels behind one another belong to one surface.
    limit = surface_limit(distance, view.pixel_angle, config.tolerance * voxels.size)
    return DepthBuffer(distance, row, limit)


def _nearest(voxels: Voxels, view: View) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """Finds the distance and number of the nearest voxel in every pixel."""
    shapes = pyramid(view.shape)
    offsets = [0]
    for height, width in shapes:
        offsets.append(offsets[-1] + height * width)
    place, num = view.place(voxels.center), voxels.present.shape[0]
    valid = voxels.present & place.ahead & (place.distance <= view.max_range)
    targets = footprint(place, valid, voxels.size, shapes, offsets, wraps=view.wraps)
    # All levels in one flat array: one scatter serves voxels of every size. A minimum commutes: the
    # result does not depend on the order of the scatter.
    distances = jnp.full(offsets[-1] + SPARE, jnp.inf)
    for target in targets:
        distances = distances.at[target].min(place.distance)
    rows = jnp.full(offsets[-1] + SPARE, num, dtype=jnp.int32)
    for target in targets:
        is_nearest = valid & (place.distance == distances[target])
        rows = rows.at[target].min(jnp.where(is_nearest, jnp.arange(num, dtype=jnp.int32), num))
    distance, row = jnp.full((1, 1), jnp.inf), jnp.full((1, 1), num, dtype=jnp.int32)
    # From coarse to fine, each pixel once: a near voxel was written to four pixels at most.
    for (height, width), begin in zip(shapes[::-1], offsets[-2::-1], strict=True):
        # Odd sizes: the last coarse pixel sticks out and is cut off.
        distance, row = (_doubled(x)[:height, :width] for x in (distance, row))
        own = slice(begin, begin + height * width)
        near, first = distances[own].reshape(height, width), rows[own].reshape(height, width)
        is_own = (near < distance) | ((near == distance) & (first < row))
        distance, row = jnp.where(is_own, near, distance), jnp.where(is_own, first, row)
    return distance, row


def _doubled(image: Array) -> Array:
    return jnp.repeat(jnp.repeat(image, 2, axis=0), 2, axis=1)


def visible(
    voxels: Voxels, points: Float[Array, "3 m"], view: View, config: VisibilityConfig
) -> tuple[Bool[Array, " n"], Bool[Array, " m"]]:
    """Finds the voxels that a view sees, and the points in empty space that nothing hides."""
    buffer = depth_buffer(voxels, view, config)
    return sees_voxels(voxels, view, buffer), sees_points(points, view, buffer)


def sees_voxels(voxels: Voxels, view: View, buffer: DepthBuffer) -> Bool[Array, " n"]:
    """Finds the voxels in the image, within range, and not hidden as a whole."""
    place = view.place(jax.lax.stop_gradient(voxels.center))
    margin = corner_margin(view, place, voxels.size, buffer.limit)
    return voxels.present & is_in_view(view, place) & (margin >= 0.0)


def sees_points(points: Float[Array, "3 m"], view: View, buffer: DepthBuffer) -> Bool[Array, " m"]:
    """Finds the points in the image, within range, and before every voxel."""
    place = view.place(jax.lax.stop_gradient(points))
    # Before the surface itself: the slack behind it is for voxels that belong to it.
    return is_in_view(view, place) & (depth_margin(view, place, buffer.distance) >= 0.0)


def depth_margin(view: View, place: Placement, limit: Float[Array, "h w"]) -> Float[Array, " n"]:
    """Computes how far points lie before `limit` at their pixel [m].

    It is negative for a point that something hides.
    """
    return _at_pixel(limit, place.column, place.row, wraps=view.wraps) - place.distance


def corner_margin(
    view: View, place: Placement, voxel_size: Float[Array, ""], limit: Float[Array, "h w"]
) -> Float[Array, " n"]:
    """Computes `depth_margin`, maximized over the corners of each voxel's projected square.

    Of the partly hidden voxels in a cluttered room, half are visible beside the edge that hides
    their center.
    """
    right = CORNER * voxel_size * place.column_scale
    down = CORNER * voxel_size * place.row_scale
    farthest = [
        _at_pixel(limit, place.column + i * right, place.row + j * down, wraps=view.wraps)
        for i in (-1.0, 1.0)
        for j in (-1.0, 1.0)
    ]
    # The best of four corners: a voxel is hidden only if it is hidden as a whole.
    reach = jnp.maximum(
        jnp.maximum(farthest[0], farthest[1]), jnp.maximum(farthest[2], farthest[3])
    )
    return reach - place.distance


def is_in_image(view: View, place: Placement) -> Bool[Array, " n"]:
    """Checks which points fall into the image, at any distance."""
    height, width = view.shape
    # Half-open: a point on the far border belongs to a pixel outside of the image.
    is_in = (place.column >= 0.0) & (place.column < width) & place.ahead
    return is_in & (place.row >= 0.0) & (place.row < height)


def is_in_view(view: View, place: Placement) -> Bool[Array, " n"]:
    """Checks which points lie in the image and within range."""
    return is_in_image(view, place) & (place.distance <= view.max_range)


def _at_pixel(
    image: Float[Array, "h w"],
    column: Float[Array, " n"],
    row: Float[Array, " n"],
    *,
    wraps: bool,
) -> Float[Array, " n"]:
    """Reads values at continuous coordinates; outside, where the map wraps, or at the border."""
    height, width = image.shape

    def whole(value: Array, size: int) -> Array:
        # Clipped before it becomes an integer: far outside, int32 would wrap round.
        return jnp.floor(jnp.clip(value, -1.0, float(size))).astype(jnp.int32)

    r, c = whole(row, height), whole(column, width)
    if wraps:
        r, c = wrap(r, c, jnp.full_like(r, height))
    r, c = jnp.clip(r, 0, height - 1), jnp.clip(c, 0, width - 1)
    return image.reshape(-1)[r * width + c]


def pyramid(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Lists heights and widths of all levels, the finest first, each half of the one before."""
    shapes = [shape]
    while max(shapes[-1]) > 1:
        height, width = shapes[-1]
        # Rounded up: every pixel of the finer level needs a parent.
        shapes.append((-(-height // 2), -(-width // 2)))
    return shapes


def footprint(
    place: Placement,
    valid: Bool[Array, " n"],
    voxel_size: Float[Array, ""],
    shapes: list[tuple[int, int]],
    offsets: list[int],
    *,
    wraps: bool,
) -> list[Int[Array, " n"]]:
    """Finds the pixels of the pyramid that each voxel covers; indices past its end mean none.

    The level is the first on which the footprint spans at most two pixel centers an axis. A
    footprint is the octagon round the projected cube.

    Args:
        place: where the voxels fall in the view.
        valid: False for voxels to leave out.
        voxel_size: edge of a voxel [m].
        shapes: of the pyramid's levels.
        offsets: where each level begins; one more for the end, behind which lie spare places.
        wraps: True for an octahedral map.
    """
    half = voxel_size * (HALF_WIDTH + NEAR * voxel_size / place.distance)
    widths = [2.0 * half * x for x in (place.column_scale, place.row_scale)]
    widest = jnp.maximum(jnp.maximum(widths[0], widths[1]), 1e-6)
    # Half the width before the logarithm: on its level a footprint is at most two pixels wide.
    level = jnp.clip(jnp.ceil(jnp.log2(0.5 * widest)), 0.0, len(shapes) - 1.0)
    scale = jnp.exp2(-level)
    level = level.astype(jnp.int32)
    table: Callable[[list[int]], Array] = lambda values: jnp.asarray(values, dtype=jnp.int32)[level]
    # Voxels side by side may lie on different levels, so sizes and offsets are gathered for each.
    height, width = table([s[0] for s in shapes]), table([s[1] for s in shapes])
    offset = table(offsets[:-1])
    begins_level = (level > 0) & (0.5 * widest * scale < SEAM)
    spread = jnp.where(begins_level, 0.25, 0.0)
    columns = _covered(place.column * scale, 0.5 * widths[0] * scale + spread)
    rows = _covered(place.row * scale, 0.5 * widths[1] * scale + spread)
    # The octagon's slanted sides: a cube seen at an edge does not fill its bounding rectangle.
    slanted = [half * w * scale + 2.0 * spread for w in (place.sum_scale, place.difference_scale)]
    nowhere = spare_places(offsets[-1], level.shape[0])
    indices: list[Int[Array, " n"]] = []
    for r, covers_row, down in rows:
        for c, covers_column, right in columns:
            # A far voxel may reach no pixel center at all, and must show in its own pixel still.
            is_own = (jnp.abs(right) <= 0.5) & (jnp.abs(down) <= 0.5)
            covers = (jnp.abs(right + down) <= slanted[0]) & (jnp.abs(right - down) <= slanted[1])
            is_in = valid & covers_row & covers_column & (covers | is_own)
            if wraps:
                r_in, c_in = wrap(r, c, height)
            else:
                is_in = is_in & (r >= 0) & (r < height) & (c >= 0) & (c < width)
                r_in, c_in = r, c
            indices.append(jnp.where(is_in, offset + r_in * width + c_in, nowhere))
    return indices


def _covered(
    middle: Float[Array, " n"], reach: Float[Array, " n"]
) -> list[tuple[Int[Array, " n"], Bool[Array, " n"], Float[Array, " n"]]]:
    """Finds the two pixels round a coordinate, which centers `reach` covers, and its offset.

    The pixel that holds the coordinate is always covered.
    """
    # Clipped before it becomes an integer: far outside, int32 would wrap round.
    first = jnp.floor(jnp.clip(middle, -2.0, 1e6) - 0.5)
    reach = jnp.maximum(reach, 0.5)
    return [
        (pixel.astype(jnp.int32), jnp.abs(pixel + 0.5 - middle) <= reach, pixel + 0.5 - middle)
        for pixel in (first, first + 1.0)
    ]


def surface_limit(
    distance: Float[Array, "h w"],
    pixel_angle: float | Float[Array, ""],
    allowance: Float[Array, ""],
) -> Float[Array, "h w"]:
    """Computes the distance up to which voxels count as the surface in the buffer [m].

    On a surface at angle a to the line of sight, voxels that lie behind one another across it are
    1 / cos(a) times as far apart along the line, so the allowance is scaled by this factor.
    Measured across the surface it stays the same, so objects behind a wall remain hidden, however
    obliquely the wall is seen.

    Args:
        distance: the buffer [m]; inf where there is nothing.
        pixel_angle: angle that a pixel covers [rad].
        allowance: depth of the surface across itself [m].
    """
    capped = jnp.minimum(distance, FAR)
    # Beyond the border the buffer is continued in a straight line.
    padded = jnp.pad(capped, max(STRIDES), mode="reflect", reflect_type="odd")
    squared = jnp.zeros_like(distance)
    for axis in (0, 1):
        steepest = jnp.zeros_like(distance)
        for step in STRIDES:
            steepest = jnp.maximum(steepest, _slope(capped, padded, step, axis))
        squared = squared + steepest * steepest
    # Meters of depth per pixel, over the meters that a pixel spans there.
    tangent = jnp.sqrt(squared) / (pixel_angle * jnp.maximum(capped, 1e-6))
    # 1 / cos a = sqrt(1 + tan^2 a); uncapped, a wall seen edge on would hide nothing.
    stretch = jnp.minimum(jnp.sqrt(1.0 + tangent * tangent), MAX_STRETCH)
    # On the uncapped distance: where there is nothing, the limit stays infinite.
    return distance + allowance * stretch


def _slope(
    distance: Float[Array, "h w"], padded: Float[Array, "hp wp"], step: int, axis: int
) -> Float[Array, "h w"]:
    """Computes the change per pixel on the flatter side of each pixel [m/px].

    It is 0 where the sides disagree.

    So neither a silhouette nor a ragged edge counts as a slope.
    """
    margin = max(STRIDES)
    height, width = distance.shape

    def moved(shift: int) -> Float[Array, "h w"]:
        row, column = margin + shift * (axis == 0), margin + shift * (axis == 1)
        return padded[row : row + height, column : column + width]

    before, after = distance - moved(-step), moved(step) - distance
    flatter = jnp.minimum(jnp.abs(before), jnp.abs(after)) / step
    return jnp.where(before * after > 0.0, flatter, 0.0)
