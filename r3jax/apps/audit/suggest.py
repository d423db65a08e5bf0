"""Suggests the most useful further views, one after another; each is simulated before the next.

Candidates: for every place where a person could stand, a panorama (arXiv 2601.07484) gives the
utility of all directions at once, and the best directions become candidate views. Where a building
has more places than are searched, those come first around which most is lacking. Views that show
too little known surface are left out. The gain in renderability over all surfaces is computed
exactly, after `simulate_view`:

    gain(view) = sum over voxels of mean over the standpoints that see it of (R after - R before)
                 + the utility of the unexplored cells that the view shows

The unit is a voxel: a gain of 1 is a voxel that goes from not renderable at all to perfect. Only
voxels in view can change, and only those with a deficit can gain.

The candidate with the largest gain is chosen (by `LazyGreedy`, the policy that `decide` calls).
The map is then updated as if the view had been taken, the unexplored cells in its view no longer
count, and the other candidates are evaluated again by lazy greedy (Minoux 1978). Other views hardly
ever increase a gain, so an old gain serves as an upper bound: only candidates whose old gain
exceeds the best new one are evaluated again.

The same number of random views from the same places serves as a baseline, which shows how much of
the gain is due to the selection.

The simulated share of surfaces seen well enough is corrected by a measured shortfall (`promise`):
pictures are taken slightly beside the suggested pose, and they show surfaces that no picture had
shown before, which count as new gaps. The shortfall was measured by taking ten suggested pictures
in embedded scenes and auditing again (`python -m experiments.audit_promise`); a test compares these
numbers with its result.

Shape symbols: p places or standpoints; B bins of the panorama; C candidates; N rows of the map.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from r3jax.apps.audit.diagnosis import (
    CAUSES,
    FINE,
    Demand,
    Diagnosis,
    StandpointScores,
    diagnose,
    score_from_standpoints,
    score_pairs,
)
from r3jax.captures.standpoints import Places
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.geometry.selection import for_selected
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import OccupancyGrid, centers_on_host
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import poses_along
from r3jax.planning.lazy_greedy import renew_best
from r3jax.planning.planner import Planner, decide
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.batch import map_over_devices, score_positions
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import simulate_view
from r3jax.scoring.utility import visible_unexplored
from r3jax.visibility.views import pinhole_view

_ENOUGH = 0.95
"""Voxels with at least this mean renderability have hardly anything to gain."""


def view_gains(
    state: MapState,
    grid: OccupancyGrid,
    demand: Demand,
    answers: StandpointScores,
    camera: Camera,
    poses: np.ndarray,
    config: ScoringConfig,
) -> np.ndarray:
    """Computes the gain of every view, [C] [voxels].

    Args:
        state: the map.
        grid: the grid; each unexplored cell counts `config.lambda1`.
        demand: the standpoints, and the voxels that each sees.
        answers: their scores of the current map.
        camera: camera of the views.
        poses: candidate poses, [C, 4, 4] [audit units].
        config: settings of all scores.
    """
    T = jnp.asarray(poses, dtype=jnp.float32)
    part = functools.partial(_gains, state, grid, demand, answers, camera, config)
    return np.asarray(map_over_devices(part, T), np.float64)


def view_coverage(
    state: MapState, camera: Camera, poses: np.ndarray, config: ScoringConfig
) -> np.ndarray:
    """Computes the share of the pixels of every view that show a voxel, [C].

    Arguments as in `view_gains`.
    """
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
        rows = rows_in_pixels(state, view, config)
        return jnp.mean(rows < state.capacity, dtype=jnp.float32)

    return jax.vmap(share)(poses)


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
    lacks = (demand.num_seen > 0.0) & (weight * answers.total < _ENOUGH)

    def gain(pose: Float[Array, "4 4"]) -> Float[Array, ""]:
        after, shown = simulate_view(state, camera, pose, config)
        changed = (shown & lacks).at[demand.row].get(mode="fill", fill_value=False)

        def add(
            pairs: Int[Array, " K"], valid: Bool[Array, " K"], total: Float[Array, ""]
        ) -> Float[Array, ""]:
            row = jnp.where(valid, demand.row[pairs], state.capacity)
            standpoint = demand.standpoint[pairs]
            terms = score_pairs(after, demand.position, row, standpoint, camera.focal, config)
            change = jnp.where(valid, terms.value - answers.value[pairs], 0.0)
            return total + jnp.sum(change * weight.at[row].get(mode="fill", fill_value=0.0))

        surfaces = for_selected(changed, add, jnp.zeros(()))
        cells = visible_unexplored(state, grid, camera, pose, config)
        return surfaces + config.lambda1 * jnp.sum(cells, dtype=jnp.float32)

    return jax.lax.map(gain, poses)


DIRECTIONS = 6
"""Number of candidate directions at each place."""

_APART = 40.0
"""Minimum angle between the directions of one place [deg]."""

OVERLAP = 0.4
"""Minimum share of a view's pixels that must show known surfaces: without overlap the image cannot
be registered with the others."""

_BATCH = 8
"""Number of candidates evaluated again in one batch."""

_LEAST_GAIN = 1.0
"""Minimum gain of a suggested view: one voxel."""


@dataclass(frozen=True)
class Suggestion:
    """One view to take."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64 [audit units]."""

    gain: float
    """Gain when it was chosen [voxels]; see `view_gains`."""

    cells: np.ndarray
    """Unseen edge cells in view, as flat indices of the grid."""

    shown: np.ndarray
    """Rows of the voxels in view."""

    num_mended: int
    """Number of voxels that become fine, from where a person would stand, through this view."""

    causes: dict[str, int]
    """Number of voxels in view that were not fine, by cause."""

    mean_after: float
    """Mean renderability of all surfaces after this view."""

    fine_after: float
    """Share of the surfaces that are fine after this view."""

    rank: int
    """Order of selection, 1 for the first; the numbers after a view include all of lower rank."""

    feet: np.ndarray
    """Place on the floor where a person stands to take it, [3] [audit units]; NaN if not known."""

    is_over: bool
    """True if the camera must be held out at arm's length from there."""


@dataclass(frozen=True)
class SuggestedViews:
    """The suggested views and their expected gain."""

    views: tuple[Suggestion, ...]
    """The views, in walking order."""

    before: Diagnosis
    """Diagnosis of the current capture."""

    after: Diagnosis
    """Predicted diagnosis after all views."""

    random_mean: tuple[float, ...]
    """Mean renderability of all surfaces after each of the same number of random views."""

    random_fine: tuple[float, ...]
    """Share of the surfaces that are fine after each random view."""

    num_searched: int
    """Number of places that were searched."""

    @property
    def ranked(self) -> tuple[Suggestion, ...]:
        """The views in the order in which they were chosen: the most useful first."""
        return tuple(sorted(self.views, key=lambda view: view.rank))


@dataclass(frozen=True)
class Task:
    """Inputs that stay the same for all views."""

    camera: Camera
    """Camera of the views, with the focal length in the map's unit."""

    demand: Demand
    """Standpoints from which the result will be viewed."""

    config: ScoringConfig
    """Settings of all scores."""

    def evaluate(self, state: MapState) -> tuple[StandpointScores, Diagnosis]:
        """Scores a map from the standpoints, and diagnoses the scores."""
        answers = score_from_standpoints(state, self.demand, self.camera.focal, self.config)
        return answers, diagnose(state, self.demand, answers)


@dataclass(frozen=True)
class Memory:
    """State kept from one suggestion to the next."""

    gains: np.ndarray
    """Latest computed gain of every candidate, inf before the first, [C] [voxels]."""

    diagnosis: Diagnosis | None = None
    """Diagnosis of the map on which the latest view was chosen; None before the first."""


@dataclass(frozen=True, eq=False)
class LazyGreedy:
    """Policy of an audit: chooses the candidate with the largest gain (see the module)."""

    task: Task

    poses: np.ndarray
    """Candidates, [C, 4, 4] [audit units]."""

    name = "audit"

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Memory:
        """Creates a memory without any gains."""
        del camera, grid, key
        return Memory(np.full(len(self.poses), np.inf))

    def observe(self, state: Memory, map_state: MapState, frame: Frame) -> Memory:
        """Resets all gains: unlike a simulated view, a real frame may increase them."""
        del state, map_state, frame
        return Memory(np.full(len(self.poses), np.inf))

    def decide(
        self,
        state: Memory,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        *,
        key: Array,
    ) -> tuple[Decision | None, Memory, PlanInfo]:
        """Chooses the candidate with the largest gain, or None if none gains a voxel."""
        del key  # no randomness
        gains, num = state.gains.copy(), len(self.poses)
        answers, diagnosis = self.task.evaluate(map_state)
        best = _best(gains, map_state, grid, self.task, answers, self.poses)
        memory = Memory(gains, diagnosis)
        if best is None:
            return None, memory, PlanInfo(DecisionOutcome.NO_CANDIDATE, num, num)
        pose = self.poses[best]
        # A person finds the way: the path is straight and free.
        way = np.stack([T_world_camera[:3, 3], pose[:3, 3]])
        length = float(np.linalg.norm(way[1] - way[0]))
        utilities = {"total": gains, "path": np.zeros(num)}
        decision = Decision(pose, way, length, float(gains[best]), self.poses, utilities)
        return decision, memory, PlanInfo(DecisionOutcome.MOVED, num, num)

    def follow(
        self,
        state: Memory,
        map_state: MapState,
        grid: OccupancyGrid,
        T_world_camera: np.ndarray,
        waypoints: np.ndarray,
    ) -> Memory:
        """Returns the memory unchanged: paths do not matter here."""
        del map_state, grid, T_world_camera, waypoints
        return state


def suggest(
    state: MapState,
    grid: OccupancyGrid,
    task: Task,
    places: Places,
    num: int,
    *,
    start: np.ndarray,
    most_places: int,
    seed: int = 0,
    on_view: Callable[[], None] = lambda: None,
) -> SuggestedViews:
    """Chooses up to `num` views, and puts them in the order of a walk.

    Args:
        state: the map.
        grid: the grid; its unexplored cells are those that could be seen at all.
        task: camera, standpoints, settings.
        places: positions at which a view may be taken.
        num: number of views; fewer are returned if no candidate gains enough.
        start: start of the walk, [3] [audit units].
        most_places: number of places that are searched.
        seed: random seed of the random views.
        on_view: called after each view.
    """
    searched = places.eyes
    if num and len(searched) > most_places:
        searched = searched[_lacking(state, grid, task, searched, most_places)]
    greedy = LazyGreedy(task, candidate_poses(state, grid, task, searched) if num else _NO_POSES)
    key = jax.random.key(seed)
    memory = greedy.init(task.camera, grid, key=key)
    planner = Planner(state, grid, memory, greedy, MappingConfig())
    views, here = list[Suggestion](), np.eye(4)
    before: Diagnosis | None = None
    # Of the diagnoses only the last one is kept: each takes as much memory as a map.
    last: tuple[_Taken, Diagnosis] | None = None
    for _ in range(num):
        decision, planner, _ = decide(planner, here, key)
        if decision is None:
            break
        now: Diagnosis = planner.policy_state.diagnosis
        before = now if before is None else before
        if last is not None:
            views.append(_suggestion(len(views) + 1, *last, now, places))
        planner, view = _imagine(planner, task, decision)
        last = view, now
        here = decision.T_world_camera
        on_view()
    after = task.evaluate(planner.map_state)[1]
    if last is not None:
        views.append(_suggestion(len(views) + 1, *last, after, places))
    drawn = _random(state, task, places.eyes, len(views), seed)
    means, shares = (tuple(values) for values in zip(*drawn, strict=True)) if drawn else ((), ())
    eyes = np.array([view.pose[:3, 3] for view in views]).reshape(-1, 3)
    walk = tuple(views[i] for i in walking_order(eyes, start))
    return SuggestedViews(walk, after if before is None else before, after, means, shares,
                          len(searched))  # fmt: skip


_CUBE = 1.0
"""Edge of the cubes in which what is lacking is counted [audit units]."""


def _lacking(
    state: MapState, grid: OccupancyGrid, task: Task, places: np.ndarray, num: int
) -> np.ndarray:
    """Finds the places around which most is lacking, behind walls too, as indices [num].

    The deficit of a voxel is 1 less its mean renderability; that of an unexplored cell its weight.
    """
    diagnosis = task.evaluate(state)[1]
    seen, cells = np.flatnonzero(diagnosis.is_seen), np.argwhere(np.asarray(grid.unexplored))
    surfaces = np.asarray(state.center, np.float64)[:, seen].T
    points = np.concatenate([surfaces, centers_on_host(grid, cells)])
    weight = np.full(len(points), float(task.config.lambda1))
    weight[: len(seen)] = 1.0 - diagnosis.value[seen]
    cubes, number = np.unique(np.floor(points / _CUBE).astype(np.int64), axis=0,
                              return_inverse=True)  # fmt: skip
    total = np.bincount(number.ravel(), weight, minlength=len(cubes))
    near = KDTree((cubes + 0.5) * _CUBE).query_ball_point(places, float(task.config.max_range))
    lacks = np.array([total[each].sum() for each in near])
    return np.argsort(-lacks, kind="stable")[:num]


def walking_order(eyes: np.ndarray, start: np.ndarray) -> list[int]:
    """Orders views for a short walk by always choosing the nearest remaining one.

    Args:
        eyes: positions, [k, 3].
        start: start of the walk, [3].
    """
    left, here, order = list(range(len(eyes))), start, list[int]()
    while left:
        gaps = np.linalg.norm(eyes[left] - here, axis=1)
        order.append(left.pop(int(np.argmin(gaps))))
        here = eyes[order[-1]]
    return order


_NO_POSES = np.zeros((0, 4, 4))


def candidate_poses(
    state: MapState, grid: OccupancyGrid, task: Task, places: np.ndarray
) -> np.ndarray:
    """Finds the best directions at every place, as poses [C, 4, 4] float64.

    They are exactly rigid and without roll.
    """
    panoramas = score_positions(state, grid, task.camera, places, task.config)
    scores = np.asarray(panoramas.direction_scores)
    lattice = fibonacci_lattice(scores.shape[1])
    chosen = np.concatenate([lattice[_apart(line, lattice)] for line in scores])
    poses = poses_along(np.repeat(places, DIRECTIONS, axis=0), chosen)
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    known = view_coverage(state, task.camera, poses, task.config)
    # If the map has gaps everywhere, the half of the views with the most coverage is accepted.
    return poses[known >= min(OVERLAP, float(np.median(known)))]


def _apart(scores: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Selects the best directions at a place, at least `_APART` degrees apart, as indices."""
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
    """Finds the candidate with the largest current gain, updating `gains` as far as needed.

    Returns None if no candidate gains enough.
    """

    def renew(ids: np.ndarray) -> np.ndarray:
        return view_gains(state, grid, task.demand, answers, task.camera, poses[ids], task.config)

    return renew_best(gains, np.zeros(len(gains), dtype=bool), renew, _BATCH, _LEAST_GAIN)


class _Taken(NamedTuple):
    """A chosen view and the voxels and cells in view."""

    decision: Decision
    shown: np.ndarray
    """Rows of the voxels, as in `Suggestion`."""
    cells: np.ndarray
    """Unexplored cells, as in `Suggestion`."""


def _imagine(planner: Planner, task: Task, decision: Decision) -> tuple[Planner, _Taken]:
    """Simulates taking a view; returns the updated planner and the voxels and cells in view."""
    T = jnp.asarray(decision.T_world_camera, dtype=jnp.float32)
    cells = visible_unexplored(planner.map_state, planner.grid, task.camera, T, task.config)
    after, shown = simulate_view(planner.map_state, task.camera, T, task.config)
    rows, edges = (np.flatnonzero(np.asarray(mask)) for mask in (shown, cells))
    imagined = replace(planner, map_state=after, grid=planner.grid.ignoring(cells))
    return imagined, _Taken(decision, rows, edges)


def _suggestion(
    rank: int, view: _Taken, now: Diagnosis, after: Diagnosis, places: Places
) -> Suggestion:
    shown = view.shown
    eye = view.decision.T_world_camera[:3, 3]
    place = int(np.argmin(np.linalg.norm(places.eyes - eye, axis=1)))
    bad = shown[now.is_seen[shown] & (now.value[shown] < FINE)]
    counts = np.bincount(now.cause[bad], minlength=len(CAUSES))
    return Suggestion(
        pose=view.decision.T_world_camera,
        gain=view.decision.score,
        cells=view.cells,
        shown=shown,
        num_mended=int((after.value[bad] >= FINE).sum()),
        causes={name: int(n) for name, n in zip(CAUSES, counts, strict=True) if n},
        mean_after=after.mean,
        fine_after=after.fine_share,
        rank=rank,
        feet=places.feet[place],
        is_over=place >= places.num_standing,
    )


def random_poses(places: np.ndarray, num: int, seed: int) -> np.ndarray:
    """Draws views at random places, mostly level as people look, [num, 4, 4]."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num, 3)) * [1.0, 1.0, 0.3]
    return poses_along(places[rng.integers(len(places), size=num)], directions)


def _random(
    state: MapState, task: Task, places: np.ndarray, num: int, seed: int
) -> list[tuple[float, float]]:
    """Computes mean renderability and share of fine surfaces after each of `num` random views."""
    found: list[tuple[float, float]] = []
    for pose in random_poses(places, num, seed) if num else _NO_POSES:
        T = jnp.asarray(pose, dtype=jnp.float32)
        state, _ = simulate_view(state, task.camera, T, task.config)
        diagnosis = task.evaluate(state)[1]
        found.append((diagnosis.mean, diagnosis.fine_share))
    return found


LOSS = (0.037, 0.063, 0.105)
"""Shortfall of the simulated share: 10th percentile, median and 90th percentile."""

LOSS_RANDOM = (0.038, 0.060, 0.126)
"""The same for pictures at random places and in random directions."""

_MEASURED = 10
"""Pictures taken in the experiment; with fewer, the shortfall is proportionally smaller."""


class Promise(NamedTuple):
    """Expected shares of the surface that are seen well enough after more pictures."""

    low: float
    middle: float
    high: float


def promise(plan: SuggestedViews) -> Promise:
    """Computes the interval that contained most captures of the experiment after the pictures."""
    return expected(plan.after.fine_share, len(plan.views), LOSS)


def random_promise(plan: SuggestedViews) -> Promise:
    """Computes the same for pictures at random places."""
    return expected(plan.random_fine[-1], len(plan.views), LOSS_RANDOM)


def expected(simulated: float, pictures: int, loss: tuple[float, float, float]) -> Promise:
    """Subtracts the expected shortfall from a simulated share.

    Args:
        simulated: share seen well enough after the pictures, as simulated.
        pictures: number of pictures.
        loss: percentiles of the shortfall, ascending.
    """
    part = min(1.0, pictures / _MEASURED)
    low, middle, high = np.clip([simulated - part * x for x in reversed(loss)], 0.0, 1.0)
    return Promise(float(low), float(middle), float(high))
