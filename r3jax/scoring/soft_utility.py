"""A utility of a view that gradients can climb: smooth in position and direction.

`view_utility` counts points that are in the image and not hidden. Its derivative ignores that
points enter and leave the view, and that kappa changes between 1 and 2. Here, near the pose that it
is made for,

    U(c, R) = sum over points p of  n_p w_p(c) F_p(c, R) D_p(c)

over the voxels and unexplored cells visible from that pose, c the camera's center and R its axes:

- w_p: 1 - R_p(c) of a voxel, lambda1 of an unexplored cell;
- F_p: the product of a sigmoid of the angle to each side of the image;
- D_p: a sigmoid of the remaining distance to the end of the range;
- n_p: the number of points that p represents if the points were sampled.

Frozen at the pose are occlusion and kappa. It is not a bound on the utility, so that poses found
with it are scored exactly before use (`planning.refine`).

Shape symbols: m points, v of them voxels.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.arguments import a_camera, a_pose, checked
from r3jax.geometry.cameras import Camera, nan_unless_valid
from r3jax.geometry.selection import positions_of_set
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid, a_grid, cells_of
from r3jax.mapping.seen import seen_in_view
from r3jax.mapping.state import MapState, a_map
from r3jax.scoring.config import ScoringConfig, scoring_settings
from r3jax.scoring.terms import deficits, score_voxels
from r3jax.visibility.views import pinhole_view

MAX_VOXELS, MAX_CELLS = 1 << 12, 1 << 10
"""Maximum number of points of each kind; if more are visible, an even sample."""

SOFTNESS = 0.04
"""Angle inside the image at which a point counts 73 % [rad]."""

_MARGIN = math.radians(25.0)
"""Points are collected up to this angle beyond each side of the image [rad]."""

_WIDEST = math.radians(75.0)
"""Maximum half angle of the field of view in which they are collected [rad]; below 90 degrees."""

_RANGE_MARGIN = 1.2
"""Points are collected up to this multiple of the range."""


class SoftUtility(eqx.Module):
    """The smooth utility of views near one pose; `soft_utility` makes it. A function of a pose."""

    points: Float[Array, "3 m"]
    """Centers of voxels, then of cells [m]."""

    count: Float[Array, " m"]
    """Number of points that each represents; 0: padding."""

    voxels: MapState
    """Rows of the voxels."""

    kappa_is_one: Bool[Array, " v"]
    """Of the voxels, seen from the pose."""

    camera: Camera
    """Of the views."""

    config: ScoringConfig
    """Settings of the utility."""

    softness: Float[Array, ""]
    """Of the image's sides [rad], and of the range as a share of it."""

    def __call__(self, T_world_camera: Float[Array, "4 4"]) -> Float[Array, ""]:
        """Computes the soft utility of a view."""
        R, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
        # Products and sums, not a matrix product, which some devices compute with 10-bit mantissas.
        offset = self.points - position[:, None]
        x, y, z = (jnp.sum(R[:, j, None] * offset, axis=0) for j in range(3))
        # Added under the root: the gradient stays finite at the camera itself.
        distance = jnp.sqrt(x * x + y * y + z * z + 1e-6)
        left = (1.0 - distance / self.config.max_range) / self.softness
        visible = self.count * jax.nn.sigmoid(left)
        camera = self.camera
        for along, focal, center, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            for side, k in ((1.0, -center / focal), (-1.0, (size - center) / focal)):
                # Distance to the side's plane over that to the camera: a sine, smooth across it.
                sine = side * (along - k * z) / (distance * jnp.sqrt(1.0 + k * k))
                visible = visible * jax.nn.sigmoid(sine / self.softness)
        score, is_one = self.config.score, self.kappa_is_one
        of_voxels = deficits(self.voxels, position, camera.focal, score, is_one)
        of_cells = jnp.broadcast_to(self.config.lambda1, x.shape[0] - of_voxels.shape[0])
        return jnp.sum(visible * jnp.concatenate([of_voxels, of_cells]))


@checked(state=a_map, grid=a_grid, camera=a_camera, T_world_camera=a_pose, config=scoring_settings)
@jax.jit
def soft_utility(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
    softness: Float[Array, ""] | float = SOFTNESS,
) -> SoftUtility:
    """Makes a smooth stand-in for `view_utility` round a pose, as a function of the pose.

        utility = r3jax.soft_utility(m, grid, camera, r3jax.pose_along(position, direction))
        slope = jax.grad(lambda p, d: utility(r3jax.pose_along(p, d)), argnums=(0, 1))
        along_position, along_direction = slope(position, direction)

    Occlusion and kappa are those at `T_world_camera`. Points enter and leave the image and the
    sensor's range gradually, up to 25 degrees beyond the image; for larger turns make a new one.

    Args:
        state: the map.
        grid: whose unexplored cells count.
        camera: of the views.
        T_world_camera: where occlusion is determined.
        config: settings of the utility.
        softness: angle at the image's sides over which points enter [rad]; a smaller value is
            closer to the exact utility, but less smooth.
    """
    config = ScoringConfig() if config is None else config
    made = soft_utility_near(state, cells_of(grid), camera, T_world_camera, config, softness)
    factor = nan_unless_valid(camera, T_world_camera, state.voxel_size, grid.cell_size)
    return eqx.tree_at(lambda u: u.count, made, factor * made.count)


def soft_utility_near(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
    softness: Float[Array, ""] | float = SOFTNESS,
) -> SoftUtility:
    """Prepares `soft_utility` from gathered voxels and cells."""
    farther = eqx.tree_at(lambda c: c.max_range, config, _RANGE_MARGIN * config.max_range)
    view = pinhole_view(_widened(camera), T_world_camera, farther)
    seen, unexplored = seen_in_view(voxels, cells, view, farther)
    row, num_each = _sample(seen, MAX_VOXELS)
    cell, num_each_cell = _sample(unexplored, MAX_CELLS)
    part, center = voxels.take(row, num_each > 0.0), voxels.center_of(row)
    terms = score_voxels(part, T_world_camera[:3, 3], camera.focal, config.score)
    return SoftUtility(
        points=jnp.stack(
            [jnp.concatenate([center[i], (cells.x, cells.y, cells.z)[i][cell]]) for i in range(3)]
        ),
        count=jnp.concatenate([num_each, num_each_cell]),
        voxels=part,
        kappa_is_one=terms.kappa == 1.0,
        camera=camera,
        config=config,
        softness=jnp.asarray(softness, dtype=jnp.float32),
    )


def _widened(camera: Camera) -> Camera:
    """Widens a camera by `_MARGIN` on every side, with the same number of pixels."""

    def lens(focal: Array, center: Array, size: int) -> tuple[Array, float]:
        # Symmetric about the axis: each side as wide as the wider one.
        half = jnp.arctan(jnp.maximum(center, size - center) / focal)
        return 0.5 * size / jnp.tan(jnp.minimum(half + _MARGIN, _WIDEST)), 0.5 * size

    fx, cx = lens(camera.fx, camera.cx, camera.width)
    fy, cy = lens(camera.fy, camera.cy, camera.height)
    return Camera(camera.width, camera.height, fx, fy, cx, cy)


def _sample(chosen: Bool[Array, " n"], most: int) -> tuple[Int[Array, " m"], Float[Array, " m"]]:
    """Samples at most `most` of the chosen evenly, and returns the number that each represents.

    The number is 0 for padding. Rows of a hash table are in random order, so that an even sample of
    rows is a random one.
    """
    num = chosen.shape[0]
    order = positions_of_set(chosen, num)
    count = jnp.sum(chosen, dtype=jnp.float32)
    each = jnp.maximum(count / most, 1.0)
    number = jnp.arange(min(most, num), dtype=jnp.float32)
    index = order[jnp.minimum((number * each).astype(jnp.int32), num - 1)]
    is_chosen = (number * each < count) & (index < num)
    return jnp.minimum(index, num - 1), jnp.where(is_chosen, each, 0.0)
