"""Active-GS's confidence of each voxel, from directions, distances and angles of its observations.

    C = clip(exp(1 - ||mean_t v_t||) sum_t (1 - d_t / d_max) max(0, n . v_t), 0, 1)

over the frames t that saw the voxel: v_t is the unit vector from its center to the camera, d_t
the distance, n its normal as known after frame t: the mean over frames of the normal of the
frame's pixels in it. (The original's primitives are Gaussians; here they are the map's voxels.)

Normals of a depth image: planes are linear in inverse depth. A point (x, y, z) = z (u, v, 1) of the
plane n . p = h has 1 / z = (n / h) . (u, v, 1): the gradient of the inverse depth gives the normal
without a bias at any slope. It is fitted to pairs of pixels on both sides, up to one degree away:
neighbors alone would tell nothing (noise of 1 % is 3 cm at 3 m, where the pixels of a 512-pixel row
are 7 mm apart).

Shape symbols: N capacity of the map; H W image size; P = H W pixels.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.selection import positions_of_set
from r3jax.geometry.voxels import EMPTY_WORD, unpack, voxel_center
from r3jax.kernels.constants import JOINED
from r3jax.mapping.associate import Groups, group_by_voxel, points_of_pixels
from r3jax.mapping.seen import rows_in_view
from r3jax.mapping.state import MapState
from r3jax.mapping.table import find

_PIXELS_PER_DEGREE = 64
"""The widest pair reaches 1 / 64 of a row to either side: a degree, with 60 degrees of view."""

_NOISE = 0.06
"""Noise of 1 % bends a pair by up to so much of its inverse depth (2.5 sigma)."""


class Sightings(eqx.Module):
    """What Active-GS keeps beside the map: 40 bytes a row."""

    key: UInt32[Array, "2 N"]
    """The map's keys when this was written: rows move when a map grows."""

    views: Float[Array, " N"]
    """Frames that saw the voxel."""

    direction_sum: Float[Array, "3 N"]
    """Sum of the unit vectors to the camera."""

    cosine_sum: Float[Array, " N"]
    """Sum over frames of (1 - d / d_max) max(0, n . v)."""

    normal_sum: Float[Array, "3 N"]
    """Sum over frames of the unit normals."""

    @property
    def normal(self) -> Float[Array, "3 N"]:
        """Unit normals; 0 where there is none."""
        length = safe_norm(self.normal_sum, axis=0)
        return self.normal_sum / jnp.where(length > 0.0, length, 1.0)[None, :]

    @property
    def confidence(self) -> Float[Array, " N"]:
        """C of every row, in [0, 1]; 0 where nothing was seen."""
        # Opposite directions cancel: seen from all around, a voxel counts up to e times as much.
        spread = safe_norm(self.direction_sum, axis=0) / jnp.maximum(self.views, 1.0)
        return jnp.clip(jnp.exp(1.0 - spread) * self.cosine_sum, 0.0, 1.0)


def no_sightings(capacity: int = 2) -> Sightings:
    """Returns sightings of no voxel."""
    return Sightings(
        key=jnp.full((2, capacity), EMPTY_WORD, dtype=jnp.uint32),
        views=jnp.zeros(capacity),
        direction_sum=jnp.zeros((3, capacity)),
        cosine_sum=jnp.zeros(capacity),
        normal_sum=jnp.zeros((3, capacity)),
    )


def aligned(seen: Sightings, state: MapState) -> Sightings:
    """Reorders the sightings so that their rows are those of the map.

    Not to be called under jit: shapes may change.

    A map never moves its rows but to grow. Voxels that the map does not have are forgotten.
    """
    # Sizes first: keys of tables of different sizes cannot be compared row by row.
    if seen.views.shape[0] == state.capacity and bool(_is_aligned(seen.key, state.key)):
        return seen
    return _realigned(seen, state)


@jax.jit
def _is_aligned(key: Array, map_key: Array) -> Bool[Array, ""]:
    # The map may have gained rows since: only those that were written here must agree.
    is_used = key[1] != jnp.uint32(EMPTY_WORD)
    return jnp.all(~is_used | jnp.all(key == map_key, axis=0))


@jax.jit
def _realigned(seen: Sightings, state: MapState) -> Sightings:
    row = find(state.key, seen.key, seen.key[1] != jnp.uint32(EMPTY_WORD))

    def move(blank: Array, x: Array) -> Array:
        return blank.at[..., row].set(x, mode="drop")  # rows are distinct

    moved = jax.tree.map(move, no_sightings(state.capacity), seen)
    return eqx.tree_at(lambda s: s.key, moved, state.key)


def see(seen: Sightings, state: MapState, frame: Frame, max_range: Float[Array, ""]) -> Sightings:
    """Takes note of a frame that the map has integrated: one sighting per voxel in it.

    Every measured pixel within range counts, those on depth edges too: they keep a voxel's color
    from being known, not the voxel from being seen. Pixels in voxels that the map does not have
    are ignored.

    Args:
        seen: the sightings before, in any order of rows.
        state: the map after the frame.
        frame: the frame.
        max_range: d_max, the sensor's range [m].
    """
    return _see(aligned(seen, state), state, frame, max_range)


@jax.jit
def _see(seen: Sightings, state: MapState, frame: Frame, max_range: Float[Array, ""]) -> Sightings:
    seen = eqx.tree_at(lambda s: s.key, seen, state.key)
    depth = frame.depth
    valid = (depth > 0.0) & (depth <= max_range)
    # Any finite depth where there is none: the mask drops these points, NaN would spread.
    points = points_of_pixels(frame, jnp.where(valid, depth, 1.0))
    normals = pixel_normals(frame.camera, depth, valid, state.voxel_size)
    # Normals stand in for colors: groups add up any three numbers per point.
    groups = group_by_voxel(points, normals.T, valid.reshape(-1), state.voxel_size)
    num = groups.is_leader.shape[0]
    size = min(num, JOINED)
    # Room for whole chunks: XLA would shift a slice past the end back over the one before.
    leaders = positions_of_set(groups.is_leader, -(-num // size) * size)
    num_voxels = jnp.sum(groups.is_leader, dtype=jnp.int32)

    # Chunks are counted one by one, as in `geometry.selection`: XLA miscounts other steps.
    def see_chunk(chunk: Int[Array, ""], seen: Sightings) -> Sightings:
        index = jax.lax.dynamic_slice_in_dim(leaders, chunk * size, size)
        return _sight(seen, state, groups, index, frame, max_range)

    return jax.lax.fori_loop(0, (num_voxels + (size - 1)) // size, see_chunk, seen)


def _sight(
    seen: Sightings,
    state: MapState,
    groups: Groups,
    leader: Array,
    frame: Frame,
    max_range: Float[Array, ""],
) -> Sightings:
    """Computes one frame's sighting of the voxels that hold some points."""
    num = groups.is_leader.shape[0]
    # Padding lies past the end: clipped to be read here, and then found in no row.
    index = jnp.minimum(leader, num - 1)
    key = groups.key[:, index]
    row = find(state.key, key, leader < num)
    at: Callable[[Array], Array] = lambda x: x.at[..., row].get(mode="fill", fill_value=0)

    def put(x: Array, value: Array) -> Array:
        return x.at[..., row].set(value, mode="drop")  # rows are distinct

    center = voxel_center(jnp.stack(unpack(key[0], key[1])), state.voxel_size)
    offset = frame.position[:, None] - center
    # A camera at the very center of a voxel must not divide by zero.
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    direction = offset / distance[None, :]
    R = frame.T_world_camera[:3, :3]
    # All bits of float32: accelerators multiply matrices with fewer by default.
    turned = jnp.matmul(R, groups.rgb_sum[index, :3].T, precision="highest")
    normal_sum = at(seen.normal_sum) + _unit(turned)
    # With this frame counted in: n is the normal as known after frame t.
    cosine = jnp.maximum(0.0, jnp.sum(_unit(normal_sum) * direction, axis=0))
    weight = _weight(distance, max_range)
    return Sightings(
        key=seen.key,
        views=put(seen.views, at(seen.views) + 1.0),
        direction_sum=put(seen.direction_sum, at(seen.direction_sum) + direction),
        cosine_sum=put(seen.cosine_sum, at(seen.cosine_sum) + weight * cosine),
        normal_sum=put(seen.normal_sum, normal_sum),
    )


def _unit(x: Float[Array, "3 M"]) -> Float[Array, "3 M"]:
    length = safe_norm(x, axis=0)
    return x / jnp.where(length > 0.0, length, 1.0)[None, :]


def _weight(distance: Float[Array, " N"], max_range: Float[Array, ""]) -> Float[Array, " N"]:
    """Weighs a sighting by its distance: 1 at the camera, 0 at the range."""
    # Rays within range by depth may be longer than it off the axis: no negative weights.
    return jnp.maximum(0.0, 1.0 - distance / max_range)


@jax.jit
def glance(
    before: Sightings,
    touched: Sightings,
    state: MapState,
    frame: Frame,
    max_range: Float[Array, ""],
) -> Sightings:
    """Adds one sighting of every known voxel in view that the frame has not touched.

    No pixel of the frame fell into these; the map counts them as seen for every policy
    (`mapping.seen`), and without the same rule here the noise in front of a surface would keep
    Active-GS looking without end. The normal is the one known so far: only pixels tell of normals.

    Args:
        before: the sightings before the frame, row by row those of the map (`aligned`).
        touched: the same after `see`.
        state: the map, the frame integrated.
        frame: the frame.
        max_range: d_max, the sensor's range [m].
    """
    # Whole numbers are exact in float32: an equal count means that no pixel fell in.
    is_new = rows_in_view(state, frame, max_range) & (touched.views == before.views)
    center = voxel_center(jnp.stack(unpack(state.key[0], state.key[1])), state.voxel_size)
    offset = frame.position[:, None] - center
    distance = jnp.maximum(safe_norm(offset, axis=0), 1e-6)
    direction = offset / distance[None, :]
    cosine = jnp.maximum(0.0, jnp.sum(touched.normal * direction, axis=0))
    weight = _weight(distance, max_range)
    add: Callable[[Array, Array | float], Array] = lambda x, more: x + jnp.where(is_new, more, 0.0)
    return Sightings(
        key=touched.key,
        views=add(touched.views, 1.0),
        direction_sum=touched.direction_sum + jnp.where(is_new[None, :], direction, 0.0),
        cosine_sum=add(touched.cosine_sum, weight * cosine),
        normal_sum=touched.normal_sum,
    )


def pixel_normals(
    camera: Camera, depth: Float[Array, "H W"], valid: Bool[Array, "H W"], step: Float[Array, ""]
) -> Float[Array, "3 P"]:
    """Estimates normals towards the camera in its frame, scaled so that sums stay unbiased.

    A pixel's vector m is n / |n . p| times its depth: m . (u, v, 1) = -1 on its own ray, so that
    it never faces away. A pair that is bent (one side lies on another surface, by more than
    `step` and what noise explains) or incomplete (a hole, the border) does not count. Along an
    axis without any pair the depth is taken to be constant.

    Args:
        camera: of the image.
        depth: z-depth [m]; its value matters where `valid` only.
        valid: pixels with a measurement.
        step: a step of depth up to this is no edge [m].
    """
    height, width = depth.shape
    # Holes get a finite depth: NaN or infinity would survive the products below.
    depth = jnp.where(valid, depth, 1.0)
    inverse = jnp.where(valid, 1.0 / depth, 0.0)
    # In inverse depth a step of fixed size shrinks with the square of the distance.
    limit = _NOISE * inverse + step * inverse * inverse
    along_u = camera.fx * _slope(inverse, limit, width, axis=1)
    along_v = camera.fy * _slope(inverse, limit, width, axis=0)
    # Rays run through the middles of pixels, which lie at halves.
    u = (jnp.arange(width, dtype=jnp.float32) + 0.5 - camera.cx) / camera.fx
    v = (jnp.arange(height, dtype=jnp.float32) + 0.5 - camera.cy) / camera.fy
    along_axis = inverse - along_u * u[None, :] - along_v * v[:, None]
    return jnp.stack([-(depth * part).reshape(-1) for part in (along_u, along_v, along_axis)])


def _slope(
    inverse: Float[Array, "H W"], limit: Float[Array, "H W"], width: int, *, axis: int
) -> Float[Array, "H W"]:
    """Fits the change of the inverse depth per pixel along an axis; 0 without any pair."""
    rise, run = jnp.zeros_like(inverse), jnp.zeros_like(inverse)
    reach = 1
    while reach <= max(1, width // _PIXELS_PER_DEGREE):
        before, after = _shifted(inverse, -reach, axis), _shifted(inverse, reach, axis)
        is_straight = jnp.abs(before + after - 2.0 * inverse) <= limit
        is_pair = (before > 0.0) & (after > 0.0) & is_straight
        # Least squares: the same noise over a wider pair says more about the slope.
        weight = jnp.where(is_pair, float(reach), 0.0)
        rise, run = rise + weight * (after - before), run + 2.0 * reach * weight
        # Powers of two: a few pairs tell nearly as much as all of them.
        reach *= 2
    return rise / jnp.where(run > 0.0, run, 1.0)


def _shifted(image: Float[Array, "H W"], by: int, axis: int) -> Float[Array, "H W"]:
    """Shifts an image by `by` pixels along an axis; 0 beyond the border."""
    size = image.shape[axis]
    if abs(by) >= size:
        return jnp.zeros_like(image)
    padding = [(0, 0), (0, 0)]
    padding[axis] = (max(0, -by), max(0, by))
    padded = jnp.pad(image, padding)
    start = [0, 0]
    start[axis] = max(0, by)
    return padded[start[0] : start[0] + image.shape[0], start[1] : start[1] + image.shape[1]]
