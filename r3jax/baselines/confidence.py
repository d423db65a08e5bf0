"""Active-GS's confidence of each voxel, from directions, distances and angles of its observations.

    C = clip(exp(1 - ||mean_t v_t||) sum_t (1 - d_t / d_max) max(0, n . v_t), 0, 1)

over the frames t that saw the voxel: v_t is the unit vector from its center to the camera, d_t
the distance, n its normal as known after frame t: the mean over frames of the normal of the
frame's pixels in it. (The original's primitives are Gaussians; here they are the map's voxels.)

Shape symbols: N capacity of the map; H W image size.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.baselines.normals import pixel_normals
from r3jax.frame import Frame
from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.selection import positions_of_set
from r3jax.geometry.voxels import EMPTY_WORD, unpack, voxel_center
from r3jax.kernels.constants import JOINED
from r3jax.mapping.associate import Groups, group_by_voxel, points_of_pixels
from r3jax.mapping.seen import rows_in_view
from r3jax.mapping.state import MapState
from r3jax.mapping.table import find


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
    # All bits of float32: accelerators multiply matrices with fewer unless they are told.
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
