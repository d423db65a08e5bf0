"""A smooth surrogate for the utility of a view, round one place: what gradients can climb.

The utility counts what is in the image and not hidden. It is piecewise constant but for R, and its
gradient says nothing of what comes into sight a step aside. Here

    soft(c, R) = sum over points p of  w_p(c) F_p(c, R)

with c the position of the camera, in a box, and R its axes.

- w_p, what p adds where it is in the image: (1 - R) of a voxel, or
  lambda1 for an unexplored cell, times a soft depth test and a soft test of the range, both
  sigmoids of a distance [m]. It is worked out in full, with a depth buffer of its own, at nodes:
  the middle of the box and the middles of its six sides. In between w_p is a parabola along each
  axis, cut off at the least and the greatest of the nodes: so surfaces come out from behind
  others, and direction bins and kappa's box take effect gradually.
- F_p, the soft frustum: the product of a sigmoid of the angle to each side of the image.

The buffers look along the start's axis with a margin all round: a surrogate for turns up to it.
Where there are more points in sight than room, an even sample of them counts for all.

Shape symbols: n voxels; c cells; m points; k nodes, 7, or 1 where the position stays; h w size of
the depth buffers.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.geometry.compaction import positions_of_set
from r3jax.geometry.numerics import safe_norm
from r3jax.mapping.state import MapState
from r3jax.scoring.cells import Cells, visible_cells
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.depth_buffer import (
    corner_margin,
    depth_buffer,
    depth_margin,
    is_in_image,
    visible_voxels,
)
from r3jax.visibility.selection import select
from r3jax.visibility.views import PinholeView, Placement, pinhole_view

MOST_VOXELS, MOST_CELLS = 1 << 12, 1 << 10
"""Points of each kind that a climb looks at."""

MARGIN = math.radians(25.0)
"""The buffers reach so far beyond the image on each side [rad]."""

_WIDEST = math.radians(75.0)
"""Half a buffer's field of view at most [rad]: a plane cannot show 90."""


class Softness(eqx.Module):
    """Where sigmoids are at 73 %. The smaller, the nearer to the exact utility, and the rougher."""

    angle: Float[Array, ""] = eqx.field(default=0.04, converter=jnp.asarray)
    """Inside the image [rad]."""

    depth: Float[Array, ""] = eqx.field(default=0.5, converter=jnp.asarray)
    """Before what hides, and within range [voxels]."""


class Surrogate(eqx.Module):
    """What may be seen from a box of positions, and what it is worth from its nodes."""

    x: Float[Array, " m"]
    """Coordinate of the points: voxels, then cells [m]."""

    y: Float[Array, " m"]
    """[m]."""

    z: Float[Array, " m"]
    """[m]."""

    worth: Float[Array, "k m"]
    """w at the nodes: the middle, then the lower and the upper side along x, y and z."""

    middle: Float[Array, " 3"]
    """Center of the box [m]."""

    half: Float[Array, " 3"]
    """From the middle to the sides [m]."""


def soft_utility(
    around: Surrogate,
    camera: Camera,
    position: Float[Array, " 3"],
    R: Float[Array, "3 3"],
    softness: Softness,
) -> Float[Array, ""]:
    """The surrogate for the utility of a view.

    Args:
        around: what may be seen.
        camera: of the view.
        position: of its center, in the box [m].
        R: its axes in the world, as columns: right, down, forward.
        softness: of the image's border.
    """
    offset = [p - position[i] for i, p in enumerate((around.x, around.y, around.z))]
    x, y, z = (sum(R[i, j] * offset[i] for i in range(3)) for j in range(3))
    # Added under the root: at the camera itself the gradient stays finite.
    inverse = 1.0 / jnp.sqrt(x * x + y * y + z * z + 1e-6)
    inside = jnp.ones_like(x)
    for along, focal, center, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        for side, k in ((1.0, -center / focal), (-1.0, (size - center) / focal)):
            # Distance to the side's plane over that to the camera: a sine, smooth at the border.
            sine = side * (along - k * z) * inverse / jnp.sqrt(1.0 + k * k)
            inside = inside * jax.nn.sigmoid(sine / softness.angle)
    return jnp.sum(inside * _worth_at(around, position))


def surrogate_of(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
    config: ScoringConfig,
    softness: Softness,
    *,
    moves: bool = True,
) -> Surrogate:
    """Looks about from the nodes of a box.

    Args:
        voxels: what is known.
        cells: unexplored space.
        camera: of the view.
        T_world_camera: where it begins; its axis decides what is looked at.
        low: corner of the box [m].
        high: opposite corner [m].
        config: settings of the utility.
        softness: of depth and range.
        moves: False: the camera stays in the middle of the box.
    """
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    nodes = _nodes_of(middle, half) if moves else middle[None, :]
    wide = _widened(camera)

    def view_from(position: Float[Array, " 3"]) -> PinholeView:
        return pinhole_view(wide, T_world_camera.at[:3, 3].set(position), config)

    sight = _look_about(voxels, cells, nodes, safe_norm(half), view_from, config)
    # What any node sees: it may come into sight on the way.
    row, is_row, each = _sample(jnp.any(sight.seen, axis=0), MOST_VOXELS)
    part, center = voxels.take(row, is_row), voxels.center_of(row)
    cell, is_cell, each_cell = _sample(jnp.any(sight.empty, axis=0), MOST_CELLS)
    points = jnp.stack([cells.x[cell], cells.y[cell], cells.z[cell]])
    soft = softness.depth * voxels.voxel_size

    def worth(node: tuple[Array, Array, Array]) -> Float[Array, " m"]:
        position, limit, distance = node
        view = view_from(position)
        lack = 1.0 - score_voxels(part, position, camera.focal, config.forms).value
        place = view.place(center)
        margin = corner_margin(view, place, voxels.voxel_size, limit)
        shown = _softly_seen(view, place, margin, is_row, soft)
        place = view.place(points)
        open_ = _softly_seen(view, place, depth_margin(view, place, distance), is_cell, soft)
        return jnp.concatenate([each * lack * shown, each_cell * config.lambda1 * open_])

    x, y, z = (jnp.concatenate([center[i], points[i]]) for i in range(3))
    worths = jax.lax.map(worth, (nodes, sight.limit, sight.distance))
    return Surrogate(x, y, z, worths, middle, half)


def _nodes_of(middle: Float[Array, " 3"], half: Float[Array, " 3"]) -> Float[Array, "k 3"]:
    """The middle of a box, then of its lower and upper side along x, y and z."""
    sides = np.stack([sign * np.eye(3)[axis] for axis in range(3) for sign in (-1.0, 1.0)])
    offsets = half[None, :] * jnp.asarray(sides, dtype=jnp.float32)
    return jnp.concatenate([middle[None, :], middle[None, :] + offsets])


class _Sight(NamedTuple):
    """What is seen from a node, and the depth buffer there: of one, or of k."""

    limit: Float[Array, "*k h w"]
    distance: Float[Array, "*k h w"]
    seen: Bool[Array, "*k n"]
    empty: Bool[Array, "*k c"]


def _look_about(
    voxels: MapState,
    cells: Cells,
    nodes: Float[Array, "k 3"],
    reach: Float[Array, ""],
    view_from: Callable[[Float[Array, " 3"]], PinholeView],
    config: ScoringConfig,
) -> _Sight:
    """Looks from every node, at what can be seen from within `reach` [m] of the first."""
    middle = view_from(nodes[0])
    # Culled once: with the reach as margin nothing that another node sees is lost.
    near_voxels = select(voxels.present & middle.may_see(voxels.center, voxels.voxel_size + reach))
    near_cells = select(cells.unexplored & middle.may_see((cells.x, cells.y, cells.z), reach))

    def look(position: Float[Array, " 3"]) -> _Sight:
        view = view_from(position)
        buffer = depth_buffer(voxels, near_voxels, view, config)
        seen = visible_voxels(voxels, near_voxels, view, buffer)
        empty = visible_cells(cells, view, buffer, near_cells)
        return _Sight(buffer.limit, buffer.distance, seen.mask, empty.mask)

    return jax.lax.map(look, nodes)


def _softly_seen(
    view: PinholeView,
    place: Placement,
    margin: Float[Array, " m"],
    is_real: Bool[Array, " m"],
    soft: Float[Array, ""],
) -> Float[Array, " m"]:
    """How surely points in the image are in sight, by how far they are from being hidden [m]."""
    margin = jnp.minimum(margin, view.max_range - place.distance)
    return jnp.where(is_real & is_in_image(view, place), jax.nn.sigmoid(margin / soft), 0.0)


def _worth_at(around: Surrogate, position: Float[Array, " 3"]) -> Float[Array, " m"]:
    """W at a position: a parabola along each axis, within what the nodes have."""
    worth = around.worth
    middle = worth[0]
    if worth.shape[0] == 1:
        return middle
    share = (position - around.middle) / jnp.maximum(around.half, 1e-6)
    total = middle
    for axis in range(3):
        before, after = worth[2 * axis + 1], worth[2 * axis + 2]
        t = share[axis]
        total = total + 0.5 * t * (after - before) + t * t * (0.5 * (before + after) - middle)
    return jnp.clip(total, worth.min(axis=0), worth.max(axis=0))


def _widened(camera: Camera) -> Camera:
    """A camera of as many pixels that sees `MARGIN` more on each side."""

    def tangent(k: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.tan(jnp.minimum(jnp.arctan(k) + MARGIN, _WIDEST))

    def lens(
        focal: Float[Array, ""], center: Float[Array, ""], size: int
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        before, after = tangent(center / focal), tangent((size - center) / focal)
        wide = size / (before + after)
        return wide, wide * before

    fx, cx = lens(camera.fx, camera.cx, camera.width)
    fy, cy = lens(camera.fy, camera.cy, camera.height)
    return Camera(camera.width, camera.height, fx, fy, cx, cy)


def _sample(
    chosen: Bool[Array, " n"], most: int
) -> tuple[Int[Array, " m"], Bool[Array, " m"], Float[Array, ""]]:
    """At most so many of the chosen, every so-manieth; which are real, and for how many each is.

    Voxels lie in the order of a hash table: a sample by number is one by chance.
    """
    num = chosen.shape[0]
    order = positions_of_set(chosen, num)
    count = jnp.sum(chosen, dtype=jnp.float32)
    # What each stands for: the sum over the sample keeps the size of that over all.
    each = jnp.maximum(count / most, 1.0)
    number = jnp.arange(min(most, num), dtype=jnp.float32)
    index = order[jnp.minimum((number * each).astype(jnp.int32), num - 1)]
    is_real = (number < count) & (index < num)
    return jnp.minimum(index, num - 1), is_real, each
