"""What each of many views would add to the renderability of all surfaces, exactly.

    gain(view) = sum over voxels of mean over the standpoints that see it of (R after - R before)
                 + the worth of the unexplored cells that the view shows

in voxels: 1 is a voxel that could not be rendered at all, and then perfectly. After means after
`simulate_view`. Only voxels that the view shows can change, and only those that lack something can
gain.

Shape symbols: C views; N rows of the map; p standpoints.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.apps.audit.diagnosis import Answers, Demand
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import score_voxels
from r3jax.scoring.simulated import simulate_view
from r3jax.scoring.utility import visible_unexplored
from r3jax.visibility.depth_buffer import candidates_of, depth_buffer
from r3jax.visibility.selection import for_selected, select
from r3jax.visibility.views import pinhole_view

_ENOUGH = 0.95
"""A voxel with this mean renderability has hardly anything to gain."""


def view_gains(
    state: MapState,
    grid: OccupancyGrid,
    demand: Demand,
    answers: Answers,
    camera: Camera,
    poses: np.ndarray,
    config: ScoringConfig,
) -> np.ndarray:
    """The gain of every view, [C] [voxels].

    Args:
        state: the map.
        grid: whose unexplored cells count, `config.lambda1` each.
        demand: who asks.
        answers: what they say of the map as it is.
        camera: of the views.
        poses: [C, 4, 4] [audit units].
        config: of all scores.
    """
    T = jnp.asarray(poses, dtype=jnp.float32)
    part = functools.partial(_gains, state, grid, demand, answers, camera, config)
    return np.asarray(map_over_devices(part, T), np.float64)


def view_coverage(
    state: MapState, camera: Camera, poses: np.ndarray, config: ScoringConfig
) -> np.ndarray:
    """Share of the pixels of every view that show a voxel, [C]; arguments as in `view_gains`."""
    T = jnp.asarray(poses, dtype=jnp.float32)
    return np.asarray(
        map_over_devices(functools.partial(_coverage, state, camera, config), T), np.float64
    )


@jax.jit
def _coverage(
    state: MapState, camera: Camera, config: ScoringConfig, poses: Float[Array, "C 4 4"]
) -> Float[Array, " C"]:
    def share(pose: Float[Array, "4 4"]) -> Float[Array, ""]:
        view = pinhole_view(camera, pose, config)
        buffer = depth_buffer(state, candidates_of(state, view), view, config)
        return jnp.mean(buffer.item < state.capacity, dtype=jnp.float32)

    return jax.lax.map(share, poses)


@jax.jit
def _gains(
    state: MapState,
    grid: OccupancyGrid,
    demand: Demand,
    answers: Answers,
    camera: Camera,
    config: ScoringConfig,
    poses: Float[Array, "C 4 4"],
) -> Float[Array, " C"]:
    weight = 1.0 / jnp.maximum(demand.num_seen, 1.0)
    mean = weight * jnp.sum(answers.value, axis=0)
    lacks = (demand.num_seen > 0.0) & (mean < _ENOUGH)

    def gain(pose: Float[Array, "4 4"]) -> Float[Array, ""]:
        after, shown = simulate_view(state, camera, pose, config)

        def add(
            rows: Int[Array, " K"], valid: Bool[Array, " K"], total: Float[Array, ""]
        ) -> Float[Array, ""]:
            part = after.take(rows, valid)

            def of_standpoint(index: Int[Array, ""]) -> Float[Array, ""]:
                position = demand.position[index]
                value = score_voxels(part, position, camera.focal, config.forms).value
                seen = valid & demand.visible[index, rows]
                change = jnp.where(seen, value - answers.value[index, rows], 0.0)
                return jnp.sum(change * weight[rows])

            ids = jnp.arange(demand.position.shape[0], dtype=jnp.int32)
            return total + jnp.sum(jax.lax.map(of_standpoint, ids))

        surfaces = for_selected(select(shown & lacks), add, jnp.zeros(()))
        cells = visible_unexplored(state, grid, camera, pose, config)
        return surfaces + config.lambda1 * jnp.sum(cells, dtype=jnp.float32)

    return jax.lax.map(gain, poses)
