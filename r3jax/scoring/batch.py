"""Scores of many candidates against one map: the inner loop of planning.

One call scores all candidates. Several devices share the candidates: each has the whole map. A
share is a loop over its candidates. The partitioner of jit would run all of it on every device;
`shard_map` runs each share on its own device. A score without a CPU kernel, which would use one
core, is split over threads.

Shape symbols: C candidates; n voxels; c cells; B bins of the panorama; D devices; P candidates
padded to a multiple of D.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import Camera, is_traced
from r3jax.kernels.calls import Cells
from r3jax.kernels.native.platform import can_call_kernels, num_cores
from r3jax.mapping.occupancy import OccupancyGrid, cells_of
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.panorama import (
    Panorama,
    PanoramaCache,
    cached_panorama,
    panorama_from_cache,
    panorama_of,
)
from r3jax.scoring.utility import ViewUtility, utility_of_view

_AXIS = "candidates"


Candidates = Any
"""An array with a row for each candidate, [C, ...], or a tree of such arrays."""


Scores = TypeVar("Scores")


def score_views(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    poses: Float[Array | np.ndarray, "C 4 4"],
    config: ScoringConfig,
) -> ViewUtility:
    """Computes `view_utility` of every pose; fields of shape [C]. Not to be called under jit."""
    poses = jnp.asarray(poses, dtype=jnp.float32)
    voxels, cells = _at_hand(state, grid, poses[:, :3, 3], config)
    return score_views_near(voxels, cells, camera, poses, config)


def score_positions(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    positions: Float[Array | np.ndarray, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
) -> Panorama:
    """Computes `panorama` of every position; fields of shape [C, ...]. Not to be called under jit.

    Args:
        state: the map.
        grid: whose unexplored cells count.
        camera: whose field of view and focal length count.
        positions: camera centers [m].
        config: settings.
        allowed: per position the axes that its best direction is taken from, at least one of
            the B of the panorama; None: all.
    """
    positions = jnp.asarray(positions, dtype=jnp.float32)
    voxels, cells = _at_hand(state, grid, positions, config)
    return score_positions_near(voxels, cells, camera, positions, config, allowed)


def _at_hand(
    state: MapState, grid: OccupancyGrid, positions: Float[Array, "C 3"], config: ScoringConfig
) -> tuple[MapState, Cells]:
    """Returns the whole map and grid if a kernel culls them itself, else the rows within range."""
    if is_traced(state.key, positions):
        raise TypeError("score_views and score_positions distribute work: call them outside jit")
    if config.score.has_kernel and jax.default_backend() == "cpu" and can_call_kernels():
        return state, _cells_of(grid)
    voxels, cells, _ = gather_in_range(state, grid, positions, config)
    return voxels, cells


_cells_of = jax.jit(cells_of)


def score_views_near(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    poses: Float[Array, "C 4 4"],
    config: ScoringConfig,
) -> ViewUtility:
    """Computes `score_views` of voxels and cells that `near` gathered."""
    return map_over_devices(
        functools.partial(_score_views, voxels, cells, camera, config),
        poses,
        threads=_threads(config),
    )


def _threads(config: ScoringConfig) -> int | None:
    """Returns 1 where a kernel uses all cores itself."""
    return 1 if config.score.has_kernel else None


def score_positions_near(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
) -> Panorama:
    """Computes `score_positions` of voxels and cells that `near` gathered."""
    score = functools.partial(_score_positions, voxels, cells, camera, config)
    places = (positions, _all_if_none(allowed, positions, config))
    return map_over_devices(score, places, threads=_threads(config))


def cache_positions_near(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
) -> tuple[Panorama, PanoramaCache]:
    """Computes `score_positions_near`, and caches what `score_cached_near` needs."""
    score = functools.partial(_cache_positions, voxels, cells, camera, config)
    places = (positions, _all_if_none(allowed, positions, config))
    return map_over_devices(score, places, threads=_threads(config))


def score_cached_near(
    kept: PanoramaCache,
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    camera: Camera,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
    allowed: Bool[Array | np.ndarray, "C B"] | None = None,
    threads: int | None = None,
) -> Panorama:
    """Updates `score_positions_near` after imagined views, from the cache before them.

    `threads` is passed to `map_over_devices`: 1 if the caller is itself a thread.
    """
    score = functools.partial(_score_cached, before, after, camera, config)
    places = (kept, positions, _all_if_none(allowed, positions, config))
    return map_over_devices(score, places, threads=threads)


def _all_if_none(
    allowed: Bool[Array | np.ndarray, "C B"] | None,
    positions: Float[Array, "C 3"],
    config: ScoringConfig,
) -> Bool[Array, "C B"]:
    """Returns the allowed axes; all if `allowed` is None."""
    if allowed is None:
        # All true, not None: one compiled program then serves calls with and without `allowed`.
        allowed = np.ones((positions.shape[0], config.panorama_bins), dtype=bool)
    return jnp.asarray(allowed)


@jax.jit
def _score_views(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    poses: Float[Array, "C 4 4"],
) -> ViewUtility:
    return jax.vmap(lambda pose: utility_of_view(voxels, cells, camera, pose, config))(poses)


@jax.jit
def _score_positions(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    places: tuple[Float[Array, "C 3"], Bool[Array, "C B"]],
) -> Panorama:
    def score(place: tuple[Float[Array, " 3"], Bool[Array, " B"]]) -> Panorama:
        return panorama_of(voxels, cells, camera, place[0], config, place[1])

    return jax.vmap(score)(places)


@jax.jit
def _cache_positions(
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    config: ScoringConfig,
    places: tuple[Float[Array, "C 3"], Bool[Array, "C B"]],
) -> tuple[Panorama, PanoramaCache]:
    return jax.vmap(lambda at: cached_panorama(voxels, cells, camera, at[0], config, at[1]))(places)


@jax.jit
def _score_cached(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    camera: Camera,
    config: ScoringConfig,
    places: tuple[PanoramaCache, Float[Array, "C 3"], Bool[Array, "C B"]],
) -> Panorama:
    def score(place: tuple[PanoramaCache, Array, Array]) -> Panorama:
        kept, position, allowed = place
        return panorama_from_cache(kept, before, after, camera, position, config, allowed)

    return jax.vmap(score)(places)


def map_over_devices(
    score: "functools.partial[Scores]",
    candidates: Candidates,
    devices: Sequence[Any] | None = None,
    threads: int | None = None,
) -> Scores:
    """Scores candidates in equal shares on all devices, or on all cores of a single CPU.

    Args:
        score: a jitted function of any number of candidates, other arguments already bound.
        candidates: the candidates.
        devices: JAX devices to use; by default all of this process.
        threads: maximum on a single CPU; 1 for a `score` that is parallel itself.
    """
    num = jax.tree.leaves(candidates)[0].shape[0]
    devices = (jax.local_devices() if devices is None else devices)[:num]
    if len(devices) > 1:
        scores = score_on_devices(score.func, score.args, candidates, devices)
        return jax.tree.map(lambda x: x[:num], jax.device_put(scores, devices[0]))
    is_cpu = jax.default_backend() == "cpu"
    workers = min(num_cores(), num, threads or num) if is_cpu else 1
    if workers < 2:
        return score(candidates)
    # Shares of one size: one compiled program serves all threads.
    padded = padded_to(workers, candidates)
    size = jax.tree.leaves(padded)[0].shape[0] // workers
    cuts = [slice(i * size, (i + 1) * size) for i in range(workers)]
    shares = [jax.tree.map(operator.itemgetter(cut), padded) for cut in cuts]
    # Threads share the map, and XLA runs outside of Python's lock. Each waits for its own share:
    # a dispatch alone may return before the work is done.
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda part: jax.block_until_ready(score(part)), shares))
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays)[:num], *parts)


def padded_to(multiple: int, candidates: Candidates) -> Candidates:
    """Repeats the last candidate until their number is a multiple."""

    def pad(rows: Array) -> Array:
        missing = -rows.shape[0] % multiple
        if missing == 0:
            return rows  # not copied: caches of a hundred panoramas take megabytes
        last = jnp.broadcast_to(rows[-1:], (missing, *rows.shape[1:]))
        return jnp.concatenate([rows, last])

    return jax.tree.map(pad, candidates)


def score_on_devices(
    score: Callable[..., Any],
    known: tuple[Any, ...],
    candidates: Candidates,
    devices: Sequence[Any],
) -> Any:
    """Computes `score(*known, candidates)` with the candidates spread over the devices.

    Each candidate's score is computed as on one device: the numbers are equal, except for the last
    bits if a share is a single candidate, whose loop XLA unrolls and fuses differently.

    Args:
        score: a module-level function of `known` and of any number of candidates, so that it
            compiles once; gives fields of shape [C, ...].
        known: the same for all candidates, copied to each device; other values than numbers and
            arrays, such as functions, are passed unchanged.
        candidates: the candidates.
        devices: of JAX, all of one kind.

    Returns:
        Fields of shape [P, ...], D shards along the first axis; rows from C on are padding.
    """
    mesh = Mesh(np.asarray(devices), (_AXIS,))
    apart = NamedSharding(mesh, PartitionSpec(_AXIS))
    everywhere = NamedSharding(mesh, PartitionSpec())
    # There may be a function among them (`score_pixels`), which no device can hold.
    numbers, others = eqx.partition(known, eqx.is_array_like)
    numbers = jax.device_put(numbers, everywhere)
    shares = jax.device_put(padded_to(len(devices), candidates), apart)
    return _score(score, mesh, eqx.combine(numbers, others), shares)


@eqx.filter_jit
def _score(
    score: Callable[..., Any],
    mesh: Mesh,
    known: tuple[Any, ...],
    candidates: Candidates,
) -> Any:
    arrays, others = eqx.partition(known, eqx.is_array)

    def own(arrays: Any, share: Any) -> Any:
        return score(*eqx.combine(arrays, others), share)

    split = PartitionSpec(_AXIS)
    # The loops inside start from replicated constants and end in values that vary by device.
    spread = jax.shard_map(
        own, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
    )
    return spread(arrays, candidates)
