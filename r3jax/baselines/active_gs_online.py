"""Active-GS with its published map: discs with confidence, trained online.

    C = clip(exp(1 - |mean view direction|) sum over frames of (1 - d / d_max) max(0, n . v), 0, 1)
    U = 1000 (visible unexplored cells / all cells) + mean over pixels of (1 - C) depth / d_max

A Gaussian is supported by a frame in which it weighs more than 0.03 at a pixel with depth. C and
depth are composited by the renderer, on black. `active-gs` computes the same on voxels.

Left out: the oracle that the published code reads (the simulator's mask of missing surfaces), the
noise of its own simulator, and the two losses on normals, which would double the rendering.

Shape symbols: C candidates; n Gaussians; X Y Z cells; h w pixels.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r3jax.baselines.active_gs import EXPLORATION_WEIGHT, LOW_CONFIDENCE, draw_views
from r3jax.baselines.information import with_room
from r3jax.baselines.online_map import (
    DISCS,
    OnlineMap,
    OnlinePolicy,
    Seen,
    colored,
    memory_of,
    supported_by,
)
from r3jax.geometry.cameras import Camera, invert_pose, project, transform
from r3jax.geometry.numerics import safe_norm
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid, cells_of, world_to_cell
from r3jax.planning.candidates import Candidates, draw_lots
from r3jax.planning.decide import Drawn
from r3jax.planning.policy import Situation
from r3jax.splatting.backend import RasterConfig, find_backend
from r3jax.splatting.projection import rotation_rows
from r3jax.splatting.scene import GaussianScene

SURFACE_OPACITY = 0.7
"""Fainter Gaussians make no region of interest."""

EMPTY_DEPTH = 1e-3
"""A pixel whose composited depth is below this shows nothing [m]."""


def normals_of(scene: GaussianScene) -> Float[Array, "n 3"]:
    """Returns the unit normals of the discs: their third axes."""
    rotation = rotation_rows(scene.quats)
    return jnp.stack([rotation[i][2] for i in range(3)], axis=1)


def confidence(marks: Float[Array, "n 5"]) -> Float[Array, " n"]:
    """Computes C of every Gaussian from its supports, sum of view directions and score."""
    spread = safe_norm(marks[:, 1:4], axis=1) / jnp.maximum(marks[:, 0], 1.0)
    return jnp.clip(jnp.exp(1.0 - spread) * marks[:, 4], 0.0, 1.0)


@jax.jit
def support(
    marks: Float[Array, "n 5"],
    scene: GaussianScene,
    position: Float[Array, " 3"],
    is_supported: Bool[Array, " n"],
    max_range: Float[Array, ""],
) -> Float[Array, "n 5"]:
    """Adds a frame taken at `position` to the marks of the Gaussians that it supports."""
    offset = position[None, :] - scene.means
    distance = jnp.maximum(safe_norm(offset, axis=1), 1e-6)
    view = offset / distance[:, None]
    cosine = jnp.clip(jnp.sum(normals_of(scene) * view, axis=1), 0.0, 1.0)
    score = (1.0 - jnp.clip(distance / max_range, 0.0, 1.0)) * cosine
    more = jnp.concatenate([jnp.ones_like(score)[:, None], view, score[:, None]], axis=1)
    return marks + jnp.where(is_supported[:, None], more, 0.0)


def rendering_utility(seen: Seen, max_range: Float[Array, ""]) -> Float[Array, ""]:
    """Computes the mean over pixels of (1 - C) depth / d_max; `seen.rgb` is C."""
    depth, believed = seen.depth, seen.rgb[..., 0]
    is_empty = depth < EMPTY_DEPTH
    doubt = jnp.where(is_empty, 1.0, jnp.where(depth > max_range, 0.0, 1.0 - believed))
    return jnp.mean(doubt * jnp.where(is_empty, 0.5 * max_range, depth)) / max_range


def cells_in_sight(
    cells: Cells, camera: Camera, pose: Float[Array, "4 4"], seen: Seen, max_range: Float[Array, ""]
) -> Float[Array, ""]:
    """Counts unexplored cells in the image, in range and before the rendered surface."""
    centers = jnp.stack([cells.x, cells.y, cells.z], axis=1)
    pixels, z = project(camera, transform(invert_pose(pose), centers))
    column, row = jnp.floor(pixels[:, 0]), jnp.floor(pixels[:, 1])
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    at = (
        jnp.clip(row, 0, camera.height - 1).astype(jnp.int32),
        jnp.clip(column, 0, camera.width - 1).astype(jnp.int32),
    )
    far = jnp.where(seen.depth < EMPTY_DEPTH, max_range, jnp.minimum(seen.depth, max_range))
    return jnp.sum(cells.unexplored & inside & (z > 0.0) & (z < far[at]), dtype=jnp.float32)


@jax.jit
def _scores(
    config: RasterConfig,
    believed: GaussianScene,
    camera: Camera,
    cells: Cells,
    poses: Float[Array, "C 4 4"],
    max_range: Float[Array, ""],
) -> tuple[tuple[Array, Array], Array]:
    """Counts the visible cells and computes the rendering utility of every pose."""
    offsets = jnp.zeros((believed.capacity, 2))

    def score(pose: Array) -> tuple[tuple[Array, Array], Array]:
        result = find_backend(config.backend)(believed, camera, pose, offsets, config)
        seen = Seen(result.rgb, result.depth_sum, result.alpha)
        numbers = (
            cells_in_sight(cells, camera, pose, seen, max_range),
            rendering_utility(seen, max_range),
        )
        return numbers, result.overflow

    return jax.lax.map(score, poses)


def doubtful(online: OnlineMap, grid: OccupancyGrid) -> tuple[np.ndarray, np.ndarray]:
    """Counts the Gaussians of low confidence [X, Y, Z], and sums normals [3, X, Y, Z]."""
    scene, shape = online.scene, grid.log_odds.shape
    opacity = jax.nn.sigmoid(scene.opacity_logits)
    is_low = (confidence(online.marks) < LOW_CONFIDENCE) & (opacity > SURFACE_OPACITY)
    cell = np.asarray(world_to_cell(grid, scene.means))
    is_low = np.asarray(is_low) & np.all((cell >= 0) & (cell < shape), axis=1)
    at, normals = tuple(cell[is_low].T), np.asarray(normals_of(scene))[is_low]
    count, total = np.zeros(shape, np.int32), np.zeros((3, *shape))
    np.add.at(count, at, 1)
    for axis in range(3):
        np.add.at(total[axis], at, normals[:, axis])
    return count, total


@dataclass(frozen=True)
class ActiveGSOnline(OnlinePolicy):
    """Active-GS with discs trained online, as published, instead of voxels."""

    name = "active-gs-online"
    source = "Active-GS, Jin et al., RA-L 2025, with its own map"
    settings = DISCS
    num_marks = 5

    def note(self, online: OnlineMap) -> OnlineMap:
        """Counts the latest frame for the Gaussians that it supports."""
        position = jnp.asarray(online.frames.T_world_camera[-1, :3, 3])
        is_supported = jnp.asarray(supported_by(online, -1))
        reach = self.config.scoring.max_range
        marks = support(online.marks, online.scene, position, is_supported, reach)
        return replace(online, marks=marks)

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws up to `num_frontier` views of regions of interest, and other views nearby."""
        count, normal_sum = doubtful(memory_of(situation), situation.scoring_grid)
        drawn = draw_views(situation, self.config, count, normal_sum, key=key)
        return Drawn(drawn, situation.memory)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes U of every view and its two parts; random scores decide if every U is 0."""
        online = memory_of(situation)
        believed = colored(online.scene, confidence(online.marks))
        cells, rendering = with_room(
            _scores, believed, self.score_camera(situation.camera),
            cells_of(situation.scoring_grid), candidates.poses_on_device(),
            self.config.scoring.max_range,
        )  # fmt: skip
        exploration = np.asarray(cells, np.float64) / situation.grid.log_odds.size
        rendering = np.asarray(rendering, np.float64)
        return candidates, {
            "exploration": exploration,
            "rendering": rendering,
            "utility": EXPLORATION_WEIGHT * exploration + rendering,
        } | draw_lots(len(candidates.valid), key=key)
