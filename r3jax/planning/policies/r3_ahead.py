"""R3-Ahead: takes the first view of the best path of several views through all reachable space.

Candidates are those of R3-Pano (local ones and views of the frontier), and positions spread over
all reachable space. A beam search finds paths of `horizon` views among them, each view scored as if
those before it had been taken (`scoring.simulated`). The first view of the best path is taken; then
everything is planned again. So the robot leaves a finished room for an unfinished one, however far,
if no nearer view is worth its time. # words: ok

Paths are compared by their utility per second:

    rate = sum of the utility of each view after those before it
           / sum over its views of (seconds of a view + of the path and the turn)

The robot's motion gives the times of paths and turns and the allowed views; a flying camera moves
at 1 m/s, and its turns take no time.

Each path of the beam is extended by the positions with the highest initial panorama scores, which
are upper bounds, and by its last position in another direction. Extensions must differ in position
or direction: a hundred views of one corner are one choice. On the host; scores are jitted.

Shape symbols: C positions.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import shortest_path

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels.calls import Cells
from r3jax.kernels.native.platform import num_cores
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import (
    Candidates,
    best_views,
    candidates_at,
    draw_positions,
    path_lengths,
    poses_along,
    spread,
)
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import Drawn, GreedyPolicy, Scored
from r3jax.planning.policy import Situation
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.travel import Travel
from r3jax.scoring.batch import cache_positions_near, score_cached_near
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.panorama import PanoramaCache
from r3jax.scoring.simulated import simulate_view_near

_NEIGHBORS = 8
"""Number of nearest positions to which straight paths are tried."""

_APART = 0.7
"""Views from positions this far apart are different choices [m]."""

SPEED = 1.0
"""Speed if the motion sets none [m/s]."""

_TURNED = 0.5
"""Views from one position are different choices if the cosine between their directions is below
this."""


@dataclass(frozen=True)
class AheadConfig(PlannerConfig):
    """Settings of the beam search, beside those that all policies share."""

    horizon: int = 4
    """Number of views of a path."""

    num_spread: int = 40
    """Number of candidates spread over all reachable space."""

    beam: int = 4
    """Width of the beam: paths kept for each further view."""

    branching: int = 6
    """Number of positions tried for the next view of each path."""

    view_seconds: float = 4.0
    """Time charged for a view, beside the path to it [s]. With 1 s, paths are shorter, nearby
    surfaces are viewed again, and 60 views of the office are 1 dB worse."""

    def __post_init__(self) -> None:
        """Refuses invalid settings."""
        super().__post_init__()
        if self.refine:
            raise InputError("r3-ahead has no refinement: leave refine at 0, or take r3-pano")
        for name, least in (("horizon", 1), ("num_spread", 0), ("beam", 1), ("branching", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not (math.isfinite(self.view_seconds) and self.view_seconds >= 0.0):
            raise InputError(f"view_seconds must be a finite number >= 0, got {self.view_seconds}")


@dataclass(frozen=True)
class R3Ahead(GreedyPolicy):
    """The first view of the best path of several views, each as if those before it were taken."""

    config: AheadConfig = field(default_factory=AheadConfig)

    name = "r3-ahead"
    source = "look-ahead on r3-pano, this project"
    Config = AheadConfig

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws positions as `r3` does, and some spread over all reachable space.

        Directions are chosen later.
        """
        travel = situation.travel
        num = self.config.num_candidates
        # At least one is drawn as `r3` does: settings with fewer are refused.
        num_spread = min(self.config.num_spread, num - 1)
        num_own = num - num_spread
        # The total is that of every policy, so that comparisons are at equal cost.
        own = replace(
            self.config,
            num_candidates=num_own,
            num_frontier=min(self.config.num_frontier, num_own),
        )
        positions, _ = draw_positions(travel, situation.scoring_grid, own, key=key)
        stops = travel.stops(np.argwhere(travel.goals))
        if len(positions) == 0 or len(stops) == 0:
            return Drawn(candidates_at(stops[:0]), situation.memory)
        wide = stops[spread(stops, num_spread)] if num_spread else stops[:0]
        drawn = candidates_at(np.concatenate([positions, wide]))
        return Drawn(drawn.padded(num), situation.memory)

    def score(self, situation: Situation, candidates: Candidates, *, key: Array) -> Scored:
        """Finds every position's best direction and its utility.

        `ahead` is the rate of the best path that begins there.

        A position from which no path of the beam begins has no rate: -inf.
        """
        del key
        scoring, travel = self.config.scoring, situation.travel
        positions = candidates.position
        places = jnp.asarray(positions, dtype=jnp.float32)
        voxels, cells, _ = gather_in_range(
            situation.map_state, situation.scoring_grid, places, scoring
        )
        allowed = situation.limits.allowed_axes(positions, scoring.panorama_bins)
        start = (voxels, cells)
        panorama, kept = cache_positions_near(*start, situation.camera, places, scoring, allowed)
        turned, utility = best_views(candidates, panorama)
        turned = situation.limits.project_to_feasible(turned)
        problem = BeamProblem(
            turned,
            utility,
            path_lengths(travel, turned),
            lengths_between(travel, turned.position),
            kept,
            start,
            situation.camera,
            self.config,
            situation.limits,
        )
        # Positions at which no path of the beam begins must not be chosen.
        rate = np.full(len(positions), -np.inf)
        for path in search(problem):
            rate[path.places[0]] = max(rate[path.places[0]], path.rate)
        return turned, {"utility": utility, "ahead": rate}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the rate of the best path, which already includes the path."""
        return utilities["ahead"]

    def weigh_far(self, near: dict[str, np.ndarray], far: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the rates of paths; of a goal far away, that of its view alone."""
        seconds = far["path"] / (self.config.motion.speed or SPEED) + self.config.view_seconds
        rate = far["utility"] / np.maximum(seconds, 1e-9)
        return np.concatenate([self.weigh(near) if near else np.zeros(0), rate])


@dataclass(frozen=True)
class Path:
    """A sequence of views, and the predicted voxels and cells after it."""

    places: tuple[int, ...]
    """Numbers of the positions, in order."""

    directions: tuple[np.ndarray, ...]
    """Viewing directions, [3] each."""

    gains: tuple[float, ...]
    """Utility that each view adds."""

    seconds: float
    """Time of the whole path [s]."""

    voxels: MapState
    """Before the last view."""

    cells: Cells
    """Before the last view."""

    @property
    def rate(self) -> float:
        """Gain per second."""
        # With `view_seconds` 0, a turn in place may take no time.
        return sum(self.gains) / max(self.seconds, 1e-9)


@dataclass(frozen=True)
class BeamProblem:
    """The input of the search."""

    views: Candidates
    """The best first view from each position."""

    utility: np.ndarray
    """Its utility, [C]: an upper bound of its utility later in a path."""

    lengths: np.ndarray
    """Path lengths from the robot to each, [C] [m]; inf: no path."""

    between: np.ndarray
    """Path lengths between them, [C, C] [m]."""

    kept: PanoramaCache
    """The panorama of each."""

    start: tuple[MapState, Cells]
    """Surfaces and unexplored space in range (`scoring.gather.gather_in_range`)."""

    camera: Camera
    config: AheadConfig

    limits: Limits = field(default_factory=Limits)
    """Limits of the robot at its pose."""

    @property
    def speed(self) -> float:
        """Speed of the robot [m/s]."""
        return self.limits.motion.speed or SPEED


def search(problem: BeamProblem) -> list[Path]:
    """Searches the paths of the greatest rate, best first; none if nothing can be reached."""
    config = problem.config
    views = problem.views
    ways = problem.limits.path_costs(problem.lengths, views.direction)
    cost = config.view_seconds + ways / problem.speed
    reachable = np.flatnonzero(np.isfinite(cost))
    # Gain per second, not gain: otherwise the longest path would always win.
    rate = problem.utility[reachable] / np.maximum(cost[reachable], 1e-9)
    ranked = reachable[np.argsort(-rate, kind="stable")]
    beam = [
        Path(
            places=(i,),
            directions=(views.direction[i],),
            gains=(float(problem.utility[i]),),
            seconds=float(cost[i]),
            voxels=problem.start[0],
            cells=problem.start[1],
        )
        for i in _apart(ranked.tolist(), views, (), config.beam)
    ]
    # One path per core: a few milliseconds of work are not worth splitting. # words: ok
    with ThreadPoolExecutor(num_cores()) as pool:
        for _ in range(config.horizon - 1):
            # Parents leave the beam: rates are compared among paths with equal numbers of views.
            children = pool.map(lambda path: _expanded(path, problem), beam)
            beam = _best([child for some in children for child in some], config.beam)
    return beam


def lengths_between(travel: Travel, positions: np.ndarray) -> np.ndarray:
    """Computes path lengths between positions [C, 3] that the robot can reach, [C, C] [m].

    Over safe straight lines between near ones, or past the robot's position: an upper bound of the
    shortest path. Unreachable positions are infinitely far from all others.
    """
    num = len(positions)
    # All pairs at once: a hundred positions are few.
    gap = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    direct = np.zeros((num, num))
    # Column 0 is the position itself, or a repeat of it.
    nearest = np.argsort(gap, axis=1, kind="stable")[:, 1 : _NEIGHBORS + 1]
    for i in range(num):
        for j in nearest[i]:
            if direct[i, j] == 0.0 and travel.in_reach(positions[i], positions[j][None])[0]:
                direct[i, j] = direct[j, i] = max(gap[i, j], 1e-6)  # 0 means "no edge" to SciPy
    over = shortest_path(csr_matrix(direct), directed=False)
    # The path past the robot's position always exists, though it is rarely short.
    own = travel.lengths(positions)
    ways = np.minimum(over, own[:, None] + own[None, :])
    np.fill_diagonal(ways, 0.0)
    return ways


def _expanded(path: Path, problem: BeamProblem) -> list[Path]:
    """Extends the path by one view, for each position that is tried."""
    config, last, views = problem.config, path.places[-1], problem.views
    (pose,) = poses_along(views.position[[last]], path.directions[-1][None])
    # Turns count from the last view of the path, not from the robot's current one.
    limits = replace(problem.limits, T_world_camera=pose)
    # Without the turn, whose direction is not known yet: a lower cost keeps the bound valid.
    cost = config.view_seconds + problem.between[last] / problem.speed
    # The first panorama is an upper bound: views only reduce utilities.
    bound = (sum(path.gains) + problem.utility) / np.maximum(path.seconds + cost, 1e-9)
    bound[~np.isfinite(problem.lengths) | ~np.isfinite(cost)] = -np.inf
    ranked = [int(i) for i in np.argsort(-bound, kind="stable") if bound[i] > -np.inf]
    taken = [(views.position[i], d) for i, d in zip(path.places, path.directions, strict=True)]
    # The last position in any case: another direction there needs no path.
    tried = [last, *_apart(ranked, views, taken, config.branching - 1)]
    offered = views.take(np.array(tried)).padded(config.branching)  # compiles once
    T = jnp.asarray(pose, dtype=jnp.float32)
    voxels, cells = simulate_view_near(path.voxels, path.cells, problem.camera, T, config.scoring)
    places = jnp.asarray(offered.position, dtype=jnp.float32)
    allowed = limits.allowed_axes(offered.position, config.scoring.panorama_bins)
    rows = np.array([tried[i % len(tried)] for i in range(config.branching)], dtype=np.int32)
    kept, now = problem.kept.at(rows), (voxels, cells)
    panorama = score_cached_near(
        kept, problem.start, now, problem.camera, places, config.scoring, allowed, threads=1
    )
    turned, gains = best_views(offered, panorama)
    turned = limits.project_to_feasible(turned)
    turning = [limits.motion.turning(float(angle)) for angle in limits.turns(turned.direction)]
    return [
        Path(
            places=(*path.places, i),
            directions=(*path.directions, turned.direction[k]),
            gains=(*path.gains, float(gains[k])),
            seconds=path.seconds + float(cost[i]) + turning[k],
            voxels=voxels,
            cells=cells,
        )
        for k, i in enumerate(tried)
    ]


def _best(paths: list[Path], num: int) -> list[Path]:
    """Selects the `num` paths of the greatest rate; of those through the same places, the first."""
    kept: dict[frozenset[tuple[int, bytes]], Path] = {}
    # The same views in another order give the same map: only the fastest order is kept.
    for path in sorted(paths, key=lambda path: -path.rate):
        views = zip(path.places, path.directions, strict=True)
        kept.setdefault(frozenset((i, direction.tobytes()) for i, direction in views), path)
    return list(kept.values())[:num]


_Sight = tuple[np.ndarray, np.ndarray]
"""A position and a viewing direction, [3] each."""


def _apart(
    ranked: Sequence[int], views: Candidates, taken: Sequence[_Sight], num: int
) -> list[int]:
    """Selects up to `num` views, in order, each different from those before it and those taken."""
    chosen: list[int] = []
    is_left = np.ones(len(views.position), dtype=bool)
    for other in taken:
        is_left &= _are_apart(views, other)
    for i in ranked:
        if len(chosen) == num:
            break
        if is_left[i]:
            chosen.append(i)
            is_left &= _are_apart(views, (views.position[i], views.direction[i]))
    return chosen


def _are_apart(views: Candidates, other: _Sight) -> np.ndarray:
    """Finds the views that differ enough from one view, [C]."""
    position, direction = other
    is_far = np.linalg.norm(views.position - position, axis=1) >= _APART
    # Directions have any length: multiplying the other side avoids a division.
    lengths = np.linalg.norm(views.direction, axis=1) * np.linalg.norm(direction)
    return is_far | (views.direction @ direction < _TURNED * lengths)
