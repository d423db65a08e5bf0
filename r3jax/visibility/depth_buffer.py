"""Which voxels and cells a camera can see: depth buffers of voxels, pinhole and panoramic.

Every voxel is splatted once into an image pyramid (`footprint`); then the coarse levels are pushed
down. This is the idea of ODGS, omnidirectional splatting, on voxels.

Shape symbols: n voxels or points; h w size of the finest level.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.geometry.compaction import SPARE
from r3jax.mapping.state import MapState
from r3jax.visibility.config import VisibilityConfig
from r3jax.visibility.footprint import footprint, pyramid
from r3jax.visibility.selection import Selection, for_selected, narrow, select
from r3jax.visibility.slope import surface_limit
from r3jax.visibility.views import Placement, View, wrap

CORNER = 0.6
"""Where visibility is tested, in edges from a voxel's center along columns and rows."""

# The largest word: every voxel wins the minimum against it.
_NOTHING = 0xFFFFFFFF


class DepthBuffer(eqx.Module):
    """The nearest voxel per pixel."""

    item: Int[Array, "h w"]
    """Index of the voxel; n where there is none."""

    distance: Float[Array, "h w"]
    """Distance of its center from the camera [m]; inf where there is none."""

    limit: Float[Array, "h w"]
    """Voxels up to this distance are visible in this pixel [m]."""


def candidates_of(voxels: MapState, view: View) -> Selection:
    """The voxels that may appear in a view: a tenth to a half of a map."""
    return select(voxels.present & view.may_see(voxels.center, voxels.voxel_size))


def depth_buffer(
    voxels: MapState, candidates: Selection, view: View, config: VisibilityConfig
) -> DepthBuffer:
    """The nearest voxel in every pixel of a view."""
    shapes = pyramid(view.shape)
    offsets = [0]
    for height, width in shapes:
        offsets.append(offsets[-1] + height * width)
    num = candidates.num
    # As many bits for the index as it needs; all others sharpen the distance.
    item_bits = max(1, (num - 1).bit_length())

    def splat(
        index: Int[Array, " K"], valid: Bool[Array, " K"], pixels: UInt32[Array, " p"]
    ) -> UInt32[Array, " p"]:
        place = view.place(voxels.center_of(index))
        valid = valid & place.ahead & (place.distance <= view.max_range)
        # As a share of the range: the bits left beside the index cover the distances that occur.
        packed = _pack(place.distance / view.max_range, index, item_bits)
        for target in footprint(place, valid, voxels.voxel_size, shapes, offsets, wraps=view.wraps):
            # A minimum commutes: the result does not depend on the order of the scatter.
            pixels = pixels.at[target].min(packed, mode="drop")
        return pixels

    # All levels in one flat array: one scatter serves voxels of every size.
    blank = jnp.full(offsets[-1] + SPARE, _NOTHING, dtype=jnp.uint32)
    finest = _push_down(for_selected(candidates, splat, blank), shapes, offsets)
    is_hit = finest != jnp.uint32(_NOTHING)
    item = jnp.where(is_hit, (finest & jnp.uint32((1 << item_bits) - 1)).astype(jnp.int32), num)
    share = (finest >> item_bits).astype(jnp.float32) / _num_steps(item_bits)
    # Rounded down to a step of the share: the fewer voxels there are, the finer the steps.
    distance = jnp.where(is_hit, share * view.max_range, jnp.inf)
    # A slanting wall has voxels behind one another that are one surface.
    limit = surface_limit(distance, view.pixel_angle, config.tolerance * voxels.voxel_size)
    return DepthBuffer(item, distance, limit)


def visible_voxels(
    voxels: MapState, candidates: Selection, view: View, buffer: DepthBuffer
) -> Selection:
    """The voxels that the view sees: in the image, within range, and not hidden as a whole."""

    def test(index: Int[Array, " K"]) -> Bool[Array, " K"]:
        place = view.place(voxels.center_of(index))
        margin = corner_margin(view, place, voxels.voxel_size, buffer.limit)
        return is_in_view(view, place) & (margin >= 0.0)

    return narrow(candidates, test)


def seen_in(
    voxels: MapState, view: View, config: VisibilityConfig
) -> tuple[DepthBuffer, Selection]:
    """The depth buffer of a view, and the voxels that it sees."""
    candidates = candidates_of(voxels, view)
    buffer = depth_buffer(voxels, candidates, view, config)
    return buffer, visible_voxels(voxels, candidates, view, buffer)


def is_visible(view: View, place: Placement, limit: Float[Array, "h w"]) -> Bool[Array, " n"]:
    """True for points in the image and within range, no farther than `limit` at their pixel.

    Args:
        view: the view.
        place: where the points fall in it.
        limit: `DepthBuffer.distance` for points in empty space, which nothing may hide.
    """
    return is_in_view(view, place) & (depth_margin(view, place, limit) >= 0.0)


def depth_margin(view: View, place: Placement, limit: Float[Array, "h w"]) -> Float[Array, " n"]:
    """How far before `limit` points lie at their pixel [m]; negative: something hides them."""
    return _at_pixel(limit, place.column, place.row, wraps=view.wraps) - place.distance


def corner_margin(
    view: View, place: Placement, voxel_size: Float[Array, ""], limit: Float[Array, "h w"]
) -> Float[Array, " n"]:
    """The same for voxels, at that of their corners, as they appear in the view, that shows most.

    Half of the voxels that a cluttered room hides in part show something beside the edge that
    hides their middle.
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
    """True for points that fall into the image, at whatever distance."""
    height, width = view.shape
    # Half-open: a point on the far border belongs to a pixel that is not there.
    is_in = (place.column >= 0.0) & (place.column < width) & place.ahead
    return is_in & (place.row >= 0.0) & (place.row < height)


def is_in_view(view: View, place: Placement) -> Bool[Array, " n"]:
    """True for points in the image and within range."""
    return is_in_image(view, place) & (place.distance <= view.max_range)


def _at_pixel(
    image: Float[Array, "h w"],
    column: Float[Array, " n"],
    row: Float[Array, " n"],
    *,
    wraps: bool,
) -> Float[Array, " n"]:
    """Values at continuous coordinates; outside, where the map wraps, or at the border."""
    height, width = image.shape

    def whole(value: Array, size: int) -> Array:
        # Clipped before it becomes an integer: far outside, int32 would wrap round.
        return jnp.floor(jnp.clip(value, -1.0, float(size))).astype(jnp.int32)

    r, c = whole(row, height), whole(column, width)
    if wraps:
        r, c = wrap(r, c, jnp.full_like(r, height))
    r, c = jnp.clip(r, 0, height - 1), jnp.clip(c, 0, width - 1)
    return image.reshape(-1)[r * width + c]


def _num_steps(item_bits: int) -> float:
    # The largest value of the bits that the index leaves: a share of 1 must still fit.
    return float((1 << (32 - item_bits)) - 1)


def _pack(
    share: Float[Array, " n"], index: Int[Array, " n"], item_bits: int
) -> UInt32[Array, " n"]:
    """Distance in the high bits, index in the low ones: `min` keeps the nearest voxel."""
    # Points that are not valid are packed as well: unclipped, theirs could be a cast out of range.
    steps = (jnp.clip(share, 0.0, 1.0) * _num_steps(item_bits)).astype(jnp.uint32)
    packed = (steps << item_bits) | index.astype(jnp.uint32)
    return jnp.minimum(packed, jnp.uint32(_NOTHING - 1))  # all ones would read as "nothing"


def _push_down(
    pixels: UInt32[Array, " p"], shapes: list[tuple[int, int]], offsets: list[int]
) -> UInt32[Array, "h w"]:
    """The minimum over all levels, at the finest."""
    level: Callable[[int], Array] = lambda i: pixels[offsets[i] : offsets[i + 1]].reshape(shapes[i])
    # From coarse to fine, each pixel once: a near voxel was written to four pixels at most.
    combined = level(len(shapes) - 1)
    for i in range(len(shapes) - 2, -1, -1):
        height, width = shapes[i]
        # Odd sizes: the last coarse pixel sticks out and is cut off.
        enlarged = jnp.repeat(jnp.repeat(combined, 2, axis=0), 2, axis=1)[:height, :width]
        combined = jnp.minimum(level(i), enlarged)
    return combined
