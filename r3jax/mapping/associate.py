"""Groups the points of one frame by voxel.

Many pixels share a voxel. Instead of sorting their keys (8 ms for 512x512 pixels on a CPU), each
pixel writes its number into a scratch table with `max`; the remaining one is the leader of its
voxel.

Shape symbols: P points of the frame; S scratch slots; H W image size.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from r3jax.frame import Frame
from r3jax.geometry.voxels import pack, voxel_index
from r3jax.kernels.constants import FAR, STRAY, THIN
from r3jax.mapping.table import hash_key

_SCRATCH_BITS = (7, 7, 6)
"""Scratch slots along x, y and z as powers of two: 6.4 x 6.4 x 3.2 m at 5 cm. Inside such a box no
two voxels share a slot; larger frames need further rounds that use a hash."""


_Election = tuple[UInt32[Array, ""], Int[Array, " P"], Bool[Array, " P"]]
"""Number of the round, leader of each point so far, points still waiting for one."""


class Groups(eqx.Module):
    """Points grouped by voxel. Each point `i` with `is_leader[i]` represents a voxel."""

    key: UInt32[Array, "2 P"]
    """Packed key of each point's voxel."""

    leader: Int[Array, " P"]
    """The leader of each point's voxel; P for ignored points."""

    is_leader: Bool[Array, " P"]
    """True for one point of each touched voxel."""

    rgb_sum: Float[Array, "P 4"]
    """Sum of the colors of the voxel's points, and their number; only at leaders."""


def group_by_voxel(
    points_world: Float[Array, "3 P"],
    rgb: Float[Array, "P 3"],
    valid: Bool[Array, " P"],
    voxel_size: Float[Array, ""],
) -> Groups:
    """Groups points by voxel and averages their colors, so that texture does not count as noise.

    Args:
        points_world: points [m].
        rgb: their colors.
        valid: False for points to ignore.
        voxel_size: edge of a voxel [m].
    """
    x, y, z = voxel_index(points_world, voxel_size)
    low, high = pack(x, y, z)
    leader = _leaders(low, high, _torus_slot(x, y, z), valid)
    num = points_world.shape[1]
    # A fourth channel of ones counts the points in the same pass.
    rows = jnp.concatenate([rgb, jnp.ones((num, 1), dtype=rgb.dtype)], axis=1)
    # One scatter of rows of four is as fast as a scatter of scalars.
    sums = jnp.zeros((num, 4), dtype=rgb.dtype).at[leader].add(rows, mode="drop")
    is_leader = leader == jnp.arange(num, dtype=jnp.int32)
    return Groups(key=jnp.stack([low, high]), leader=leader, is_leader=is_leader, rgb_sum=sums)


def group_means(groups: Groups, values: Float[Array, "P k"]) -> Float[Array, "P k"]:
    """Averages values over the points of each voxel; 0 except at leaders."""
    # Points write to their leaders; ignored points have leader P, which is dropped.
    sums = jnp.zeros_like(values).at[groups.leader].add(values, mode="drop")
    return sums / jnp.maximum(groups.rgb_sum[:, 3:], 1.0)


def points_of_pixels(frame: Frame, depth: Float[Array, "H W"]) -> Float[Array, "3 P"]:
    """Computes the points of all pixels in the world [m], row by row, coordinates first.

    With the long axis last the arithmetic is one vectorized loop; [H, W, 3] takes 3 ms more.
    """
    camera, T = frame.camera, frame.T_world_camera
    u = (jnp.arange(camera.width, dtype=jnp.float32) + 0.5 - camera.cx) / camera.fx
    v = (jnp.arange(camera.height, dtype=jnp.float32) + 0.5 - camera.cy) / camera.fy
    x, y = u[None, :] * depth, v[:, None] * depth
    along: Callable[[int], Array] = lambda i: T[i, 0] * x + T[i, 1] * y + T[i, 2] * depth + T[i, 3]
    return jnp.stack([along(i).reshape(-1) for i in range(3)])


def _torus_slot(x: Int[Array, " P"], y: Int[Array, " P"], z: Int[Array, " P"]) -> Int[Array, " P"]:
    # Low bits, not a hash: neighbors never collide, so that one round suffices in a room.
    bx, by, bz = _SCRATCH_BITS
    low_bits: Callable[[Array, int], Array] = lambda value, bits: value & ((1 << bits) - 1)
    return low_bits(x, bx) | (low_bits(y, by) << bx) | (low_bits(z, bz) << (bx + by))


def _leaders(
    low: UInt32[Array, " P"],
    high: UInt32[Array, " P"],
    torus_slot: Int[Array, " P"],
    valid: Bool[Array, " P"],
) -> Int[Array, " P"]:
    """Elects the leading point of each point's voxel; P where the point is not valid."""
    num = low.shape[0]
    point = jnp.arange(num, dtype=jnp.int32)
    num_slots = 1 << sum(_SCRATCH_BITS)

    def elect(
        slot: Int[Array, " P"], leader: Int[Array, " P"], waiting: Bool[Array, " P"]
    ) -> tuple[Int[Array, " P"], Bool[Array, " P"]]:
        scratch = jnp.full(num_slots, -1, dtype=jnp.int32)
        # `max` commutes: the result does not depend on the order of the scatter.
        scratch = scratch.at[jnp.where(waiting, slot, num_slots)].max(point, mode="drop")
        # Empty slots hold -1, which would index from the end.
        elected = jnp.maximum(scratch[slot], 0)
        # Voxels may share a slot: only points with the winner's key follow it.
        agrees = waiting & (low[elected] == low) & (high[elected] == high)
        return jnp.where(agrees, elected, leader), waiting & ~agrees

    def elect_by_hash(carry: _Election) -> _Election:
        round_number, leader, waiting = carry
        seeded = hash_key(low + round_number * jnp.uint32(0x9E3779B9), high)
        slot = (seeded & jnp.uint32(num_slots - 1)).astype(jnp.int32)
        return round_number + 1, *elect(slot, leader, waiting)

    nobody = jnp.full(num, num, dtype=jnp.int32)
    leader, waiting = elect(torus_slot, nobody, valid)
    # Every round settles at least one voxel (the highest waiting point wins its slot).
    start = (jnp.ones((), jnp.uint32), leader, waiting)
    return jax.lax.while_loop(lambda c: jnp.any(c[2]), elect_by_hash, start)[1]


def edge_pixels(depth: Float[Array, "H W"], voxel_size: Float[Array, ""]) -> Bool[Array, "H W"]:
    """Finds pixels on depth edges, whose color mixes foreground and background.

    An edge is a step of more than a voxel between neighbors that is not a slope: the pixel also
    deviates by more than a voxel from the plane through its neighbors on both sides. A plane is
    linear in inverse depth, so a floor or a ceiling seen at a grazing angle, whose depth changes by
    many voxels a pixel, has no edges.

    Raw depth of a noisy sensor steps by more than a voxel everywhere beyond 3 m (1 % of the depth
    is 4 cm at 4 m), which would empty the far half of every frame; so the test runs on the 3x3
    median, which keeps steps and removes noise, and adds the pixels that deviate from it. Pixels
    without a measurement do not count as neighbors: beside a hole only the other neighbor is
    compared.

    Args:
        depth: z-depth [m]; 0 no measurement, inf beyond range.
        voxel_size: edge of a voxel [m].
    """
    # Everything but a measurement is a hole.
    capped = jnp.where(depth > 0.0, jnp.minimum(depth, FAR), 0.0)
    around = _neighborhood(capped)
    # Holes take the value of the pixel in the middle.
    median = _median9([jnp.where(value > 0.0, value, capped) for value in around])
    is_edge = jnp.abs(capped - median) > voxel_size + STRAY * capped
    is_edge |= _breaks(median, _neighborhood(median), voxel_size)
    # Deviations beyond 1 % noise are edges whatever the median: thin structures.
    is_edge |= _breaks(capped, around, voxel_size + THIN * capped)
    return (depth > 0.0) & is_edge


def _breaks(
    depth: Float[Array, "H W"], around: list[Float[Array, "H W"]], limit: Float[Array, "..."]
) -> Bool[Array, "H W"]:
    """Finds where the surface breaks by more than a limit [m], along its row or its column."""
    # The floor keeps holes finite: infinity minus infinity would be NaN.
    inverse: Callable[[Array], Array] = lambda value: 1.0 / jnp.maximum(value, 1e-4)
    is_break = jnp.zeros(depth.shape, dtype=bool)
    for before, after in ((around[3], around[5]), (around[1], around[7])):
        # A missing neighbor agrees with the pixel itself.
        before, after = (jnp.where(value > 0.0, value, depth) for value in (before, after))
        step = jnp.maximum(jnp.abs(before - depth), jnp.abs(after - depth))
        # Exactly the step where one of the neighbors lies as deep as the pixel, 0 on a plane.
        bend = jnp.abs(inverse(before) + inverse(after) - 2.0 * inverse(depth))
        bend *= depth * jnp.maximum(jnp.maximum(before, after), depth)
        is_break |= (step > limit) & (bend > limit)
    return is_break


def _neighborhood(image: Float[Array, "H W"]) -> list[Float[Array, "H W"]]:
    """Stacks the 3x3 neighbors of every pixel; the border is repeated."""
    height, width = image.shape
    padded = jnp.pad(image, 1, mode="edge")
    return [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]


def _median9(values: list[Float[Array, "H W"]]) -> Float[Array, "H W"]:
    """Computes the median of nine images.

    Of sorted triples: the median of the largest minimum, the median of the medians and the
    smallest maximum.
    """
    # Minima and maxima of whole images vectorize; sorting nine values per pixel does not.
    triples = [_sort3(*values[i : i + 3]) for i in (0, 3, 6)]
    smallest = jnp.maximum(jnp.maximum(triples[0][0], triples[1][0]), triples[2][0])
    middle = _sort3(triples[0][1], triples[1][1], triples[2][1])[1]
    largest = jnp.minimum(jnp.minimum(triples[0][2], triples[1][2]), triples[2][2])
    return _sort3(smallest, middle, largest)[1]


def _sort3(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    top = jnp.maximum(high, c)
    rest = jnp.minimum(high, c)
    return jnp.minimum(low, rest), jnp.maximum(low, rest), top
