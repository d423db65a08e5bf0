"""Which further views would help most: one after the other, each imagined before the next.

Candidates: every place where somebody could stand gets its panorama (arXiv 2601.07484), the utility
of all directions at once, and looks along its best directions; views that show too little of what
is known are left out. What a view would add to the renderability of all surfaces is computed
exactly, after `simulate_view`:

    gain(view) = sum over voxels of mean over the standpoints that see it of (R after - R before)
                 + the utility of the unexplored cells that the view shows

in voxels: 1 is a voxel that could not be rendered at all, and then perfectly. Only voxels that the
view shows can change, and only those that lack something can gain.

Of all candidates the one with the largest gain is taken, the map goes on as if it had been, the
unexplored cells that it shows count no longer, and the others are asked again: lazy greedy (Minoux
1978). A gain hardly ever grows by other views, so an old one is as good as an upper bound, and only
candidates whose old gain is above the best new one are asked again.

Beside it, as many views at random from the same places say how much of the gain is owed to the
choice.

Shape symbols: p places or standpoints; B bins of the panorama; C candidates; N rows of the map.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.apps.audit.diagnosis import (
    CAUSES,
    FINE,
    Demand,
    Diagnosis,
    StandpointScores,
    diagnose,
    score_from_standpoints,
)
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import poses_along
from r3jax.scoring.batch import map_over_devices, score_positions
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
    answers: StandpointScores,
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
    answers: StandpointScores,
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


DIRECTIONS = 6
"""Directions in which a candidate looks from every place."""

_APART = 40.0
"""Between the directions of one place [deg]."""

OVERLAP = 0.4
"""Share of a view's pixels that must show what is known already: a picture of nothing but the
unknown cannot be registered with the others."""

_BATCH = 8
"""Candidates that are asked again at once."""

_LEAST_GAIN = 1.0
"""A view that gains less than one voxel is not worth taking."""


@dataclass(frozen=True)
class Suggestion:
    """One view to take."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64 [audit units]."""

    gain: float
    """What it was chosen for [voxels]; see `gains`."""

    cells: np.ndarray
    """Unseen edges that it shows, as flat indices of the grid's cells."""

    shown: np.ndarray
    """Rows of the voxels that it shows."""

    num_mended: int
    """Voxels that were not fine for those who stand about, and are fine after it."""

    causes: dict[str, int]
    """Number of voxels that it shows and that were not fine, by cause."""

    mean_after: float
    """Mean renderability of all surfaces once it is taken."""

    fine_after: float
    """Share of the surfaces that are fine once it is taken."""


@dataclass(frozen=True)
class SuggestedViews:
    """The suggested views, in order, and what they promise."""

    views: tuple[Suggestion, ...]

    before: Diagnosis
    """Diagnosis of the capture as it is."""

    after: Diagnosis
    """Diagnosis once all views are taken, as far as it can be foreseen."""

    random_mean: tuple[float, ...]
    """Mean renderability of all surfaces after each of as many random views."""


@dataclass(frozen=True)
class Task:
    """What does not change from view to view."""

    camera: Camera
    """Camera of the views; its focal length in the map's unit."""

    demand: Demand
    """From where the result will be looked at."""

    config: ScoringConfig
    """Settings of all scores."""

    def evaluate(self, state: MapState) -> tuple[StandpointScores, Diagnosis]:
        """What the standpoints say of a map, and what it comes to."""
        answers = score_from_standpoints(state, self.demand, self.camera.focal, self.config)
        return answers, diagnose(state, self.demand, answers)


def suggest(
    state: MapState,
    grid: OccupancyGrid,
    task: Task,
    places: np.ndarray,
    num: int,
    *,
    seed: int = 0,
    on_view: Callable[[], None] = lambda: None,
) -> SuggestedViews:
    """Chooses up to `num` views.

    Args:
        state: the map.
        grid: whose unexplored cells count: those that somebody could ever see.
        task: camera, standpoints, settings.
        places: where a view may be taken, [p, 3] [audit units].
        num: views wanted; fewer come where nothing is left to be gained.
        seed: of the random views.
        on_view: called after each view.
    """
    answers, now = task.evaluate(state)
    before = now
    views: list[Suggestion] = []
    imagined, open_grid = state, grid
    poses = candidate_poses(state, grid, task, places) if num else np.zeros((0, 4, 4))
    gains = np.full(len(poses), np.inf)
    for _ in range(num):
        best = _best(gains, imagined, open_grid, task, answers, poses)
        if best is None:
            break
        pose, gain = poses[best], float(gains[best])
        imagined, open_grid, shown, cells = _take(imagined, open_grid, task, pose)
        answers, after = task.evaluate(imagined)
        views.append(_suggestion(pose, gain, cells, shown, now, after))
        now = after
        on_view()
    return SuggestedViews(tuple(views), before, now, _random(state, task, places, len(views), seed))


def candidate_poses(
    state: MapState, grid: OccupancyGrid, task: Task, places: np.ndarray
) -> np.ndarray:
    """The best directions of every place, [C, 4, 4] float64: exactly rigid, roll-free."""
    panoramas = score_positions(state, grid, task.camera, places, task.config)
    scores = np.asarray(panoramas.direction_scores)
    lattice = fibonacci_lattice(scores.shape[1])
    chosen = np.concatenate([lattice[_apart(line, lattice)] for line in scores])
    poses = poses_along(np.repeat(places, DIRECTIONS, axis=0), chosen)
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    known = view_coverage(state, task.camera, poses, task.config)
    # Where the map has gaps everywhere, the fullest half of the views is full enough.
    return poses[known >= min(OVERLAP, float(np.median(known)))]


def _apart(scores: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Indices of the best directions of a place, apart from each other."""
    left = scores.astype(np.float64)
    chosen: list[int] = []
    for _ in range(DIRECTIONS):
        best = int(np.argmax(left))
        chosen.append(best)
        left[lattice @ lattice[best] > np.cos(np.radians(_APART))] = -np.inf
    return np.asarray(chosen)


def _best(
    gains: np.ndarray,
    state: MapState,
    grid: OccupancyGrid,
    task: Task,
    answers: StandpointScores,
    poses: np.ndarray,
) -> int | None:
    """The candidate that gains most now; brings `gains` up to date as far as needed.

    None: no candidate gains anything worth it.
    """
    is_new = np.zeros(len(gains), dtype=bool)
    while len(gains):
        best = int(np.argmax(gains))
        if gains[best] < _LEAST_GAIN:
            return None
        if is_new[best]:
            return best
        # All at first, then the few that may be best.
        first = np.isinf(gains)
        order = np.argsort(-np.where(is_new, -np.inf, gains), kind="stable")
        asked = np.flatnonzero(first) if first.any() else order[:_BATCH]
        gains[asked] = view_gains(
            state, grid, task.demand, answers, task.camera, poses[asked], task.config
        )
        is_new[asked] = True
    return None


def _take(
    state: MapState, grid: OccupancyGrid, task: Task, pose: np.ndarray
) -> tuple[MapState, OccupancyGrid, np.ndarray, np.ndarray]:
    """Map and grid once a view is taken, the rows and the unexplored cells that it shows."""
    T = jnp.asarray(pose, dtype=jnp.float32)
    cells = visible_unexplored(state, grid, task.camera, T, task.config)
    after, shown = simulate_view(state, task.camera, T, task.config)
    rows, edges = (np.flatnonzero(np.asarray(mask)) for mask in (shown, cells))
    return after, grid.ignoring(cells), rows, edges


def _suggestion(
    pose: np.ndarray,
    gain: float,
    cells: np.ndarray,
    shown: np.ndarray,
    now: Diagnosis,
    after: Diagnosis,
) -> Suggestion:
    bad = shown[now.is_seen[shown] & (now.value[shown] < FINE)]
    counts = np.bincount(now.cause[bad], minlength=len(CAUSES))
    return Suggestion(
        pose=pose,
        gain=gain,
        cells=cells,
        shown=shown,
        num_mended=int((after.value[bad] >= FINE).sum()),
        causes={name: int(n) for name, n in zip(CAUSES, counts, strict=True) if n},
        mean_after=after.mean,
        fine_after=after.fine_share,
    )


def _random(
    state: MapState, task: Task, places: np.ndarray, num: int, seed: int
) -> tuple[float, ...]:
    """Mean renderability after each of `num` views from random places in random directions."""
    if not num:
        return ()
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num, 3)) * [1.0, 1.0, 0.3]  # as people look: mostly level
    poses = poses_along(places[rng.integers(len(places), size=num)], directions)
    means: list[float] = []
    for pose in poses:
        T = jnp.asarray(pose, dtype=jnp.float32)
        state, _ = simulate_view(state, task.camera, T, task.config)
        means.append(task.evaluate(state)[1].mean)
    return tuple(means)
