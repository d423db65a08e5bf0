"""R3-Ahead: the first view of the best path of several, through all reachable space.

Candidates are those of R3-Pano, local ones and some in sight of the frontier, and places that are
spread over all space that the robot can reach. A beam searches paths of `horizon` views among
them, each view scored as if those before it had been taken (`scoring.simulated`). The best path's
first view is taken; then all is planned again. A room that is done is left for one that is not,
however far, if nothing nearer justifies its time.

A path is compared by what its views add over what it costs, in seconds:

    rate = sum of the utility of each view after those before it
           / sum over its views of (seconds of a view + of the path and the turn)

The robot's motion says how long paths and turns take and which views there are; a camera that
flies goes 1 m/s and turns in no time.

From each path of the beam, some places are tried whose panorama scored most when nothing else had
been seen, which bounds what it can score now, and the last place once more, in another direction.
What is tried lies apart, in place or direction: a hundred views of one corner are one choice. On
the host; scores are jitted.

Shape symbols: C places.
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
from r3jax.scoring.panorama_cache import PanoramaCache
from r3jax.scoring.simulated import simulate_view_near

_NEIGHBORS = 8
"""Number of nearest places to which straight paths are tried."""

_APART = 0.7
"""Views from places this far apart are two choices [m]."""

SPEED = 1.0
"""Speed of a robot whose motion does not say [m/s]."""

_TURNED = 0.5
"""Cosine between the axes of two views from one place, below which they are two choices."""


@dataclass(frozen=True)
class AheadConfig(PlannerConfig):
    """How far `r3-ahead` looks, beside what all policies share."""

    horizon: int = 4
    """Views of the paths that are compared."""

    num_spread: int = 40
    """How many of the candidates of it are spread over all reachable space."""

    beam: int = 4
    """Paths that it keeps for every further view."""

    branching: int = 6
    """Places that it tries for the next view of each path."""

    view_seconds: float = 4.0
    """What it counts for a view, beside the path to it [s]. With 1 it saves meters, looks
    at what is near once more, and 60 views of an office come out 1 dB worse."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
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
    """The first view of the best path of several, each as if those before it had been taken."""

    config: AheadConfig = field(default_factory=AheadConfig)

    name = "r3-ahead"
    source = "look-ahead on r3-pano, this project"
    Config = AheadConfig

    def draw(self, situation: Situation, *, key: Array) -> Drawn:
        """Draws positions as `r3` does, and some spread over all reachable space.

        They have no directions yet.
        """
        travel = situation.travel
        num = self.config.num_candidates
        # One at least is drawn as `r3` draws it: settings with fewer would be refused.
        num_spread = min(self.config.num_spread, num - 1)
        num_own = num - num_spread
        # The shares add up to what every policy scores: comparisons are at equal cost.
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
        # Places where no path of the beam begins were beaten: they must not be chosen.
        rate = np.full(len(positions), -np.inf)
        for path in search(problem):
            rate[path.places[0]] = max(rate[path.places[0]], path.rate)
        return turned, {"utility": utility, "ahead": rate}

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Returns the rate of the best path, which already includes the path."""
        return utilities["ahead"]


@dataclass(frozen=True)
class Path:
    """Views one after the other, and what is known once they are taken."""

    places: tuple[int, ...]
    """Numbers of the places, in order."""

    directions: tuple[np.ndarray, ...]
    """Lines of sight there, [3] each."""

    gains: tuple[float, ...]
    """Utility that each view adds."""

    seconds: float
    """Time that the whole path takes [s]."""

    voxels: MapState
    """Before the last view."""

    cells: Cells
    """Before the last view."""

    @property
    def rate(self) -> float:
        """Gain per second."""
        # With `view_seconds` 0, a turn on the spot may take no time at all.
        return sum(self.gains) / max(self.seconds, 1e-9)


@dataclass(frozen=True)
class BeamProblem:
    """What the search knows of the places."""

    views: Candidates
    """The best view from each, if it were the first."""

    utility: np.ndarray
    """What that is worth, [C]: a bound on what it is worth later."""

    lengths: np.ndarray
    """Path lengths to each from where the robot is, [C] [m]; inf: there is none."""

    between: np.ndarray
    """Path lengths between them, [C, C] [m]."""

    kept: PanoramaCache
    """The panorama of each."""

    start: tuple[MapState, Cells]
    """What is known: surfaces and unexplored space at hand (`scoring.gather.gather_in_range`)."""

    camera: Camera
    config: AheadConfig

    limits: Limits = field(default_factory=Limits)
    """Limits of the robot where it is."""

    @property
    def speed(self) -> float:
        """Speed of the robot [m/s]."""
        return self.limits.motion.speed or SPEED


def search(problem: BeamProblem) -> list[Path]:
    """Searches the paths of the greatest rate, best first; none if no place can be reached."""
    config = problem.config
    views = problem.views
    ways = problem.limits.path_costs(problem.lengths, views.direction)
    cost = config.view_seconds + ways / problem.speed
    reachable = np.flatnonzero(np.isfinite(cost))
    # Gain per second, not gain: else the longest path would always win.
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
    # One path per core: a few milliseconds of work are not split further.
    with ThreadPoolExecutor(num_cores()) as pool:
        for _ in range(config.horizon - 1):
            # Parents leave the beam: only paths of as many views compare their rates.
            children = pool.map(lambda path: _expanded(path, problem), beam)
            beam = _best([child for some in children for child in some], config.beam)
    return beam


def lengths_between(travel: Travel, positions: np.ndarray) -> np.ndarray:
    """Computes path lengths between positions [C, 3] that the robot can reach, [C, C] [m].

    Over straight lines between near ones, each safe throughout, or back past the robot: no
    shorter than the shortest way. Unreachable positions are infinitely far from all others.
    """
    num = len(positions)
    # All pairs at once: a hundred positions are few.
    gap = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    direct = np.zeros((num, num))
    # Column 0 is the place itself, or a repeat of it.
    nearest = np.argsort(gap, axis=1, kind="stable")[:, 1 : _NEIGHBORS + 1]
    for i in range(num):
        for j in nearest[i]:
            if direct[i, j] == 0.0 and travel.in_reach(positions[i], positions[j][None])[0]:
                direct[i, j] = direct[j, i] = max(gap[i, j], 1e-6)  # 0 means "no edge" to SciPy
    over = shortest_path(csr_matrix(direct), directed=False)
    # Back past the robot is always a way, though rarely a short one.
    own = travel.lengths(positions)
    ways = np.minimum(over, own[:, None] + own[None, :])
    np.fill_diagonal(ways, 0.0)
    return ways


def _expanded(path: Path, problem: BeamProblem) -> list[Path]:
    """Extends the path by one more view, once for each place that is tried."""
    config, last, views = problem.config, path.places[-1], problem.views
    (pose,) = poses_along(views.position[[last]], path.directions[-1][None])
    # Turns count from the last view of the path, not from where the robot is now.
    limits = replace(problem.limits, T_world_camera=pose)
    # Without the turn, whose direction is not known yet: with a cost too low it stays a bound.
    cost = config.view_seconds + problem.between[last] / problem.speed
    # The first panorama bounds what a place can still add: views only take away.
    bound = (sum(path.gains) + problem.utility) / np.maximum(path.seconds + cost, 1e-9)
    bound[~np.isfinite(problem.lengths) | ~np.isfinite(cost)] = -np.inf
    ranked = [int(i) for i in np.argsort(-bound, kind="stable") if bound[i] > -np.inf]
    taken = [(views.position[i], d) for i, d in zip(path.places, path.directions, strict=True)]
    # The last place whatever its bound: another direction there takes no way.
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
    # The same views in another order know the same: only the fastest order is kept.
    for path in sorted(paths, key=lambda path: -path.rate):
        views = zip(path.places, path.directions, strict=True)
        kept.setdefault(frozenset((i, direction.tobytes()) for i, direction in views), path)
    return list(kept.values())[:num]


_Sight = tuple[np.ndarray, np.ndarray]
"""A position and a line of sight, [3] each."""


def _apart(
    ranked: Sequence[int], views: Candidates, taken: Sequence[_Sight], num: int
) -> list[int]:
    """Selects up to `num` views, in order, each apart from those before it and those taken."""
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
    """Finds the views that differ enough from one view to be another choice, [C]."""
    position, direction = other
    is_far = np.linalg.norm(views.position - position, axis=1) >= _APART
    # Directions have any length: a product on the other side saves dividing by it.
    lengths = np.linalg.norm(views.direction, axis=1) * np.linalg.norm(direction)
    return is_far | (views.direction @ direction < _TURNED * lengths)
