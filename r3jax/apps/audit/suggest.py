"""Which further views would help most: one after the other, each imagined before the next.

Candidates: every place where somebody could stand gets its panorama (arXiv 2601.07484), the utility
of all directions at once, and looks along its best directions; views that show too little of what
is known are left out. What a view would add to the renderability of all surfaces is computed
exactly, after `simulate_view`:

    gain(view) = sum over voxels of mean over the standpoints that see it of (R after - R before)
                 + the utility of the unexplored cells that the view shows

in voxels: 1 is a voxel that could not be rendered at all, and then perfectly. Only voxels that the
view shows can change, and only those with a deficit can gain.

Of all candidates the one with the largest gain is taken (`LazyGreedy`, the policy that `decide`
asks), the map goes on as if it had been, the unexplored cells that it shows count no longer, and
the others are asked again: lazy greedy (Minoux 1978). A gain hardly ever grows by other views, so
an old one is as good as an upper bound, and only candidates whose old gain is above the best new
one are asked again.

Beside it, as many views at random from the same places say how much of the gain is owed to the
choice.

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

from r3jax.apps.audit.diagnosis import (
    CAUSES,
    FINE,
    Demand,
    Diagnosis,
    StandpointScores,
    diagnose,
    score_from_standpoints,
)
from r3jax.captures.standpoints import Places
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.geometry.selection import for_selected
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import poses_along
from r3jax.planning.lazy_greedy import renew_best
from r3jax.planning.planner import Planner, decide
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.batch import map_over_devices, score_positions
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.simulated import simulate_view
from r3jax.scoring.terms import score_voxels
from r3jax.scoring.utility import visible_unexplored
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
    """Computes the gain of every view, [C] [voxels].

    Args:
        state: the map.
        grid: whose unexplored cells count, `config.lambda1` each.
        demand: the standpoints, and the voxels that each sees.
        answers: their scores of the map as it is.
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

        surfaces = for_selected(shown & lacks, add, jnp.zeros(()))
        cells = visible_unexplored(state, grid, camera, pose, config)
        return surfaces + config.lambda1 * jnp.sum(cells, dtype=jnp.float32)

    return jax.lax.map(gain, poses)


DIRECTIONS = 6
"""Directions in which a candidate looks from every place."""

_APART = 40.0
"""Between the directions of one place [deg]."""

OVERLAP = 0.4
"""Share of a view's pixels that must show what is known already: an image of nothing but the
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
    """Voxels that were not fine from where a person would stand, and are fine after it."""

    causes: dict[str, int]
    """Number of voxels that it shows and that were not fine, by cause."""

    mean_after: float
    """Mean renderability of all surfaces once it is taken."""

    fine_after: float
    """Share of the surfaces that are fine once it is taken."""

    rank: int
    """1 for the view that was chosen first; the numbers after it count those of lower rank."""

    feet: np.ndarray
    """Where one stands to take it, [3] [audit units]; NaN: not known."""

    is_over: bool
    """True if the camera is held out from there with an arm."""


@dataclass(frozen=True)
class SuggestedViews:
    """The suggested views, and what they promise."""

    views: tuple[Suggestion, ...]
    """In the order of a walk."""

    before: Diagnosis
    """Diagnosis of the capture as it is."""

    after: Diagnosis
    """Diagnosis once all views are taken, as far as it can be predicted."""

    random_mean: tuple[float, ...]
    """Mean renderability of all surfaces after each of as many random views."""

    random_fine: tuple[float, ...]
    """Share of the surfaces that are fine after each of these."""

    @property
    def ranked(self) -> tuple[Suggestion, ...]:
        """The views in the order in which they were chosen: the most useful first."""
        return tuple(sorted(self.views, key=lambda view: view.rank))


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
        """Scores a map from the standpoints, and diagnoses the scores."""
        answers = score_from_standpoints(state, self.demand, self.camera.focal, self.config)
        return answers, diagnose(state, self.demand, answers)


@dataclass(frozen=True)
class Memory:
    """What is remembered from one suggestion to the next."""

    gains: np.ndarray
    """Gain of every candidate when it was last asked, inf before that, [C] [voxels]."""

    diagnosis: Diagnosis | None = None
    """Diagnosis of the map that the latest view was chosen on; None before the first."""


@dataclass(frozen=True, eq=False)
class LazyGreedy:
    """Policy of an audit: of all candidates, the view that gains most (see the module)."""

    task: Task

    poses: np.ndarray
    """Candidates, [C, 4, 4] [audit units]."""

    name = "audit"

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> Memory:
        """Knows no gain yet."""
        del camera, grid, key
        return Memory(np.full(len(self.poses), np.inf))

    def observe(self, state: Memory, map_state: MapState, frame: Frame) -> Memory:
        """Forgets all gains: what was really seen may raise them, unlike what is imagined."""
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
        del key  # nothing is drawn
        gains, num = state.gains.copy(), len(self.poses)
        answers, diagnosis = self.task.evaluate(map_state)
        best = _best(gains, map_state, grid, self.task, answers, self.poses)
        memory = Memory(gains, diagnosis)
        if best is None:
            return None, memory, PlanInfo(DecisionOutcome.NO_CANDIDATE, num, num)
        pose = self.poses[best]
        # A person finds the way: it costs nothing, and leads straight.
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
        """Remembers nothing of a path."""
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
    seed: int = 0,
    on_view: Callable[[], None] = lambda: None,
) -> SuggestedViews:
    """Chooses up to `num` views, and puts them in the order of a walk.

    Args:
        state: the map.
        grid: whose unexplored cells count: those that somebody could ever see.
        task: camera, standpoints, settings.
        places: where a view may be taken.
        num: views wanted; fewer come where nothing is left to be gained.
        start: where the walk begins, [3] [audit units].
        seed: of the random views.
        on_view: called after each view.
    """
    greedy = LazyGreedy(task, candidate_poses(state, grid, task, places.eyes) if num else _NO_POSES)
    key = jax.random.key(seed)
    memory = greedy.init(task.camera, grid, key=key)
    planner = Planner(state, grid, memory, greedy, MappingConfig())
    diagnoses, taken, here = list[Diagnosis](), list[_Taken](), np.eye(4)
    for _ in range(num):
        decision, planner, _ = decide(planner, here, key)
        if decision is None:
            break
        diagnoses.append(planner.policy_state.diagnosis)
        planner, view = _imagine(planner, task, decision)
        taken.append(view)
        here = decision.T_world_camera
        on_view()
    diagnoses.append(task.evaluate(planner.map_state)[1])
    steps = zip(taken, diagnoses[:-1], diagnoses[1:], strict=True)
    views = [
        _suggestion(rank, view, now, after, places)
        for rank, (view, now, after) in enumerate(steps, start=1)
    ]
    drawn = _random(state, task, places.eyes, len(views), seed)
    means, shares = (tuple(getattr(d, name) for d in drawn) for name in ("mean", "fine_share"))
    eyes = np.array([view.pose[:3, 3] for view in views]).reshape(-1, 3)
    walk = tuple(views[i] for i in walking_order(eyes, start))
    return SuggestedViews(walk, diagnoses[0], diagnoses[-1], means, shares)


def walking_order(eyes: np.ndarray, start: np.ndarray) -> list[int]:
    """Orders views so that one walks little: always to the nearest one that is left.

    Args:
        eyes: positions, [k, 3].
        start: where one is, [3].
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
    # Where the map has gaps everywhere, the fullest half of the views is full enough.
    return poses[known >= min(OVERLAP, float(np.median(known)))]


def _apart(scores: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Returns indices of the best directions at a place, at least `_APART` degrees apart."""
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
    """Finds the candidate with the largest gain now, updating `gains` as far as needed.

    Returns None if no candidate gains enough.
    """

    def renew(ids: np.ndarray) -> np.ndarray:
        return view_gains(state, grid, task.demand, answers, task.camera, poses[ids], task.config)

    return renew_best(gains, np.zeros(len(gains), dtype=bool), renew, _BATCH, _LEAST_GAIN)


class _Taken(NamedTuple):
    """A view that was chosen, and what it shows."""

    decision: Decision
    shown: np.ndarray
    """Rows of the voxels, as in `Suggestion`."""
    cells: np.ndarray
    """Unexplored cells, as in `Suggestion`."""


def _imagine(planner: Planner, task: Task, decision: Decision) -> tuple[Planner, _Taken]:
    """Simulates taking a view: returns the planner after it, and what the view shows."""
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
    """Draws views at random places, in directions as people look: mostly level, [num, 4, 4]."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num, 3)) * [1.0, 1.0, 0.3]
    return poses_along(places[rng.integers(len(places), size=num)], directions)


def _random(
    state: MapState, task: Task, places: np.ndarray, num: int, seed: int
) -> list[Diagnosis]:
    """Diagnoses the map after each of `num` random views."""
    found: list[Diagnosis] = []
    for pose in random_poses(places, num, seed) if num else _NO_POSES:
        T = jnp.asarray(pose, dtype=jnp.float32)
        state, _ = simulate_view(state, task.camera, T, task.config)
        found.append(task.evaluate(state)[1])
    return found
