"""Scores of many candidates against one map: the inner loop of planning.

XLA runs the loops of one score on one core; on a CPU the candidates are therefore dealt out to as
many threads as the process may use. Where there are several devices, they share the candidates.

Shape symbols: C candidates; S standpoints; n voxels; c cells; B bins of the panorama.
"""

import functools
import operator
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.demand import Demand, asked_from, joined
from r3jax.scoring.kept import (
    Changes,
    Kept,
    changes_between,
    keep_panorama,
    panorama_again,
)
from r3jax.scoring.near import near
from r3jax.scoring.panorama import Panorama, panorama_of
from r3jax.scoring.sharding import Candidates, padded_to, score_on_devices
from r3jax.scoring.utility import ViewUtility, utility_of_view
from r3jax.scoring.voxels import Voxels

Scores = TypeVar("Scores")


def score_views(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    poses: Float[Array | np.ndarray, "C 4 4"],
    config: ScoringConfig,
) -> ViewUtility:
    """`view_utility` of every pose; fields of shape [C]. Not to be called under jit."""
    poses = jnp.asarray(poses, dtype=jnp.float32)
    voxels, cells, _ = near(state, grid, poses[:, :3, 3], config)
    return score_views_near(voxels, cells, camera, poses, config)


def score_positions(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    positions: Float[Array | np.ndarray, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
    standpoints: Float[Array | np.ndarray, "S 3"] | None = None,
) -> Panorama:
    """`panorama` of every position; fields of shape [C, ...]. Not to be called under jit.

    Args:
        state: the map.
        grid: whose unexplored cells count.
        camera: whose field of view and focal length count.
        positions: camera centers [m].
        config: settings.
        allowed: per position the axes that its best direction is taken from, at least one of
            the B of the panorama; None: all.
        standpoints: if given, voxels count by what seeing them would add for whoever looks from
            there [m] (`scoring.demand`), not by what they lack.
    """
    positions = jnp.asarray(positions, dtype=jnp.float32)
    voxels, cells, _ = near(state, grid, positions, config)
    demand = None if standpoints is None else demand_from(voxels, camera, standpoints, config)
    return score_positions_near(voxels, cells, camera, positions, config, allowed, demand)


def score_views_near(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    poses: Float[Array, "C 4 4"],
    config: ScoringConfig,
    demand: Demand | None = None,
) -> ViewUtility:
    """`score_views` of voxels and cells that `near` gathered, and of a demand for them if given."""
    return deal(functools.partial(_score_views, voxels, cells, camera, config, demand), poses)


def score_positions_near(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
    demand: Demand | None = None,
) -> Panorama:
    """`score_positions` of voxels and cells that `near` gathered."""
    score = functools.partial(_score_positions, voxels, cells, camera, config, demand)
    return deal(score, (positions, _all_if_none(allowed, positions, config)))


def keep_positions_near(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
) -> tuple[Panorama, Kept]:
    """`score_positions_near`, and what `score_kept_near` needs to do it again."""
    score = functools.partial(_keep_positions, voxels, cells, camera, config)
    return deal(score, (positions, _all_if_none(allowed, positions, config)))


def score_kept_near(
    kept: Kept,
    before: tuple[Voxels, Cells],
    after: tuple[Voxels, Cells],
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
) -> Panorama:
    """`score_positions_near` after imagined views, from what was kept before them."""
    changes = _changes_between(before, after)
    score = functools.partial(_score_kept, changes, camera, config)
    return deal(score, (kept, positions, _all_if_none(allowed, positions, config)))


def _all_if_none(
    allowed: Bool[Array | np.ndarray, "C B"] | None,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
) -> Bool[Array, "C B"]:
    """The axes that are allowed, or all."""
    if allowed is None:
        allowed = np.ones((positions.shape[0], config.panorama_bins), dtype=bool)
    return jnp.asarray(allowed)


def demand_from(
    voxels: Voxels,
    camera: Camera,
    standpoints: Float[Array | np.ndarray, "S 3"],
    config: ScoringConfig,
) -> Demand:
    """`demand_of` with the standpoints [m] dealt out. Not to be called under jit."""
    places = jnp.asarray(standpoints, dtype=jnp.float32)
    cover, size = deal(functools.partial(_ask, voxels, camera.focal, config), places)
    return _joined(places, cover, size, camera.focal)


@jax.jit
def _score_views(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    demand: Demand | None,
    poses: Float[Array, "C 4 4"],
) -> ViewUtility:
    score = functools.partial(utility_of_view, voxels, cells, camera, config=config, demand=demand)
    return jax.lax.map(score, poses)


@jax.jit
def _score_positions(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    demand: Demand | None,
    places: tuple[Float[Array, "C 3"], Bool[Array, "C B"]],
) -> Panorama:
    def score(place: tuple[Float[Array, " 3"], Bool[Array, " B"]]) -> Panorama:
        return panorama_of(voxels, cells, camera, place[0], config, place[1], demand)

    return jax.lax.map(score, places)


_changes_between = jax.jit(changes_between)


@jax.jit
def _keep_positions(
    voxels: Voxels,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    places: tuple[Float[Array, "C 3"], Bool[Array, "C B"]],
) -> tuple[Panorama, Kept]:
    return jax.lax.map(
        lambda at: keep_panorama(voxels, cells, camera, at[0], config, at[1]), places
    )


@jax.jit
def _score_kept(
    changes: Changes,
    camera: Camera,
    config: ScoringConfig,
    places: tuple[Kept, Float[Array, "C 3"], Bool[Array, "C B"]],
) -> Panorama:
    return jax.lax.map(
        lambda at: panorama_again(at[0], changes, camera, at[1], config, at[2]), places
    )


@jax.jit
def _ask(
    voxels: Voxels,
    focal: Float[Array, ""],
    config: ScoringConfig,
    standpoints: Float[Array, "S 3"],
) -> tuple[Float[Array, "S n"], Float[Array, " S"]]:
    return jax.lax.map(functools.partial(asked_from, voxels, focal, config), standpoints)


_joined = jax.jit(joined)


def deal(
    score: "functools.partial[Scores]",
    candidates: Candidates,
    devices: Sequence[Any] | None = None,
) -> Scores:
    """Scores candidates in equal shares on all devices; a CPU alone: on all of its cores.

    Args:
        score: of any number of candidates; a jitted function with all but the last argument.
        candidates: what to score.
        devices: of JAX, where to; by default all of this process.
    """
    num = jax.tree.leaves(candidates)[0].shape[0]
    devices = (jax.local_devices() if devices is None else devices)[:num]
    if len(devices) > 1:
        scores = score_on_devices(score.func, score.args, candidates, devices)
        return jax.tree.map(lambda x: x[:num], jax.device_put(scores, devices[0]))
    workers = min(len(os.sched_getaffinity(0)), num) if jax.default_backend() == "cpu" else 1
    if workers < 2:
        return score(candidates)
    padded = padded_to(workers, candidates)
    size = jax.tree.leaves(padded)[0].shape[0] // workers
    cuts = [slice(i * size, (i + 1) * size) for i in range(workers)]
    shares = [jax.tree.map(operator.itemgetter(cut), padded) for cut in cuts]
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda part: jax.block_until_ready(score(part)), shares))
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays)[:num], *parts)
