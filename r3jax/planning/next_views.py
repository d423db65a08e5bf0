"""Chooses several next views at once, each as if those before it had been taken.

Taking a view never increases the utility of another one: voxels in it do not become worse, and its
unexplored cells are explored (`scoring.simulated`). So an old score is an upper bound of the new
one, and only the candidates with the greatest bounds are scored again (lazy greedy, Minoux 1978).
The result is the same as with scoring all candidates each time.

Shape symbols: C candidates; k views.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from r3jax.errors import InputError
from r3jax.geometry.arguments import a_camera, checked
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.kernels.calls import Cells
from r3jax.mapping.occupancy import OccupancyGrid, a_grid, centers_on_host
from r3jax.mapping.state import MapState, a_map
from r3jax.planning.candidates import best_views, candidates_at, spread
from r3jax.planning.config import PlannerConfig
from r3jax.planning.lazy_greedy import renew_best
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.travel import safe_cells
from r3jax.scoring.batch import cache_positions_near, score_cached_near, score_views_near
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.simulated import simulate_view_near

_AT_ONCE = 8
"""Number of candidates scored together: programs are compiled for C and for this number."""


class NextViews(eqx.Module):
    """Views to take, the most useful first."""

    T_world_camera: Float[np.ndarray, "k 4 4"]
    """Poses."""

    utility: Float[np.ndarray, " k"]
    """lambda1 U_G + U_R of each, as if those before it had been taken; never rising."""


ScoreIndices = Callable[[MapState, Cells, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Maps voxels, cells and indices of candidates [k] to their poses [k, 4, 4], turned if directions
are free, and their utilities [k]."""


@checked(state=a_map, grid=a_grid, camera=a_camera)
def next_views(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    k: int,
    *,
    poses: ArrayLike | None = None,
    config: PlannerConfig | None = None,
) -> NextViews:
    """Finds the k most useful views, each given those before it. Not to be called under jit.

    For one camera that takes all of them, several cameras that take one each, or a person with a
    list. Paths are not counted; for a robot's next view use `decide`.

    Args:
        state: the map.
        grid: the coarse grid; its free space is where views may be taken.
        camera: the camera of the views.
        k: number of views.
        poses: candidates, [C, 4, 4], each chosen at most once. By default `config.num_candidates`
            positions, spread over all known free space with the safety margin; each in the
            direction of the highest utility in its panorama.
        config: candidates, safety margin, and `scoring`: lambda1 and the range.

    Raises:
        ValueError: k is less than 1 or more than the poses, a pose is not rigid, or no free
            space is known.
    """
    config = PlannerConfig() if config is None else config
    free = np.asarray(grid.free)
    safe = safe_cells(free, float(grid.cell_size), config.safety_margin)
    if k < 1:
        raise InputError(f"k must be at least 1, got {k}")
    checked = None if poses is None else _checked(poses, k)
    positions = _positions_in(grid, safe, config) if checked is None else checked[:, :3, 3]
    # Without a safe cell nothing is reachable, and the mask would leave no unexplored cells.
    known_grid = mask_unexplorable(grid, safe) if safe.any() else grid
    # Gathered once: taking views changes the statistics, not the rows in range.
    places = jnp.asarray(positions, dtype=jnp.float32)
    voxels, cells, _ = gather_in_range(state, known_grid, places, config.scoring)
    if checked is None:
        ask, first = _score_turned(voxels, cells, positions, camera, config)
    else:
        ask = _score_as_given(checked, camera, config)
        first = ask(voxels, cells, np.arange(len(checked)))
    # A position may serve several views, each in another direction; a given pose only once.
    left = np.full(len(positions), k if checked is None else 1)
    return _lazy_greedy(ask, first, voxels, cells, camera, left, k, config)


def _positions_in(grid: OccupancyGrid, safe: np.ndarray, config: PlannerConfig) -> np.ndarray:
    """Spreads positions [C, 3] float64 [m] over the cells with the safety margin."""
    cells = np.argwhere(safe)
    if len(cells) == 0:
        raise InputError(
            "the grid has no free cell with the safety margin of "
            f"{config.safety_margin} m: integrate a frame with depth, or give poses"
        )
    centers = centers_on_host(grid, cells)
    # Spread, not drawn: the same map gives the same list, and no seed is needed.
    return centers[spread(centers, config.num_candidates)]


def _checked(poses: ArrayLike, k: int) -> np.ndarray:
    checked = np.asarray(poses, dtype=np.float64)
    if checked.ndim != 3 or checked.shape[1:] != (4, 4):
        raise InputError(f"poses must have shape [C, 4, 4], got {checked.shape}")
    if len(checked) < k:
        raise InputError(f"cannot choose {k} views from {len(checked)} poses, each at most once")
    # A pose that is not rigid would get a meaningless score.
    for i, pose in enumerate(checked):
        if (error := rigid_error(pose)) is not None:
            raise InputError(f"pose {i}: {error}")
    return checked


def _score_as_given(poses: np.ndarray, camera: Camera, config: PlannerConfig) -> ScoreIndices:
    def score(voxels: MapState, cells: Cells, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        T = jnp.asarray(poses[ids], dtype=jnp.float32)
        scores = score_views_near(voxels, cells, camera, T, config.scoring)
        return poses[ids], np.asarray(scores.total, dtype=np.float64)

    return score


def _score_turned(
    voxels: MapState, cells: Cells, positions: np.ndarray, camera: Camera, config: PlannerConfig
) -> tuple[ScoreIndices, tuple[np.ndarray, np.ndarray]]:
    start, scoring = (voxels, cells), config.scoring
    places = jnp.asarray(positions, dtype=jnp.float32)
    # Cached: taking a view moves no surface, so that visibility stays the same.
    panorama, kept = cache_positions_near(*start, camera, places, scoring)

    def score(voxels: MapState, cells: Cells, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        some, after = jnp.asarray(ids), (voxels, cells)
        again = score_cached_near(kept.at(some), start, after, camera, places[some], scoring)
        turned, utility = best_views(candidates_at(positions[ids]), again)
        return turned.T_world_camera, utility

    turned, utility = best_views(candidates_at(positions), panorama)
    return score, (turned.T_world_camera, utility)


def _lazy_greedy(
    score: ScoreIndices,
    first: tuple[np.ndarray, np.ndarray],
    voxels: MapState,
    cells: Cells,
    camera: Camera,
    left: np.ndarray,
    k: int,
    config: PlannerConfig,
) -> NextViews:
    """Picks the best candidate k times (lazy greedy, Minoux 1978), each at most `left` times."""
    poses, bound = first
    is_new = np.ones(len(left), dtype=bool)
    taken: list[np.ndarray] = []
    utilities: list[float] = []

    def renew(ids: np.ndarray) -> np.ndarray:
        # One shape, so that renewing compiles once.
        turned, values = score(voxels, cells, ids[np.arange(_AT_ONCE) % len(ids)])
        poses[ids] = turned[: len(ids)]
        return values[: len(ids)]

    while True:
        best = renew_best(bound, is_new, renew, _AT_ONCE)
        assert best is not None  # there are at least k candidates
        taken.append(poses[best].copy())
        utilities.append(float(bound[best]))
        if len(taken) == k:
            return NextViews(np.stack(taken), np.asarray(utilities))
        left[best] -= 1
        if not left[best]:
            bound[best] = -np.inf
        # A view was taken: all other scores are now bounds.
        is_new[:] = False
        T = jnp.asarray(poses[best], dtype=jnp.float32)
        voxels, cells = simulate_view_near(voxels, cells, camera, T, config.scoring)
