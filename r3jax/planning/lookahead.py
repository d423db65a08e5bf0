"""Paths of several views, searched by a beam: each view as if those before it had been taken.

A path is worth what its views add (`scoring.foresight`) over what it costs, in seconds:

    rate = sum of the utility of each view after those before it
           / sum over its views of (seconds of a view + of the way and the turn)

The carrier's motion says how long ways and turns take and which views there are; a camera that
flies goes 1 m/s and turns in no time.

The beam holds the paths of the greatest rate. From each, some places are tried whose panorama was
worth most when nothing else had been seen, which bounds what it can be worth now, and the last
place once more, in another direction. What is tried lies apart, in place or direction: a hundred
views of one corner are one choice. On the host; scores are jitted.

Shape symbols: C places.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import shortest_path

from r3jax.geometry.cameras import Camera, angle_between
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import best_views
from r3jax.planning.config import PlannerConfig
from r3jax.planning.limits import Limits
from r3jax.planning.travel import Travel, segment_is_inside
from r3jax.scoring.batch import score_cached_near
from r3jax.scoring.cells import Cells
from r3jax.scoring.panorama_cache import PanoramaCache
from r3jax.scoring.simulated import simulate_view_near

_NEIGHBORS = 8
"""Straight ways are looked for to so many of the nearest places."""

_APART = 0.7
"""Views from places this far apart are two choices [m]."""

SPEED = 1.0
"""Of a carrier whose motion does not say [m/s]."""

_TURNED = 0.5
"""Cosine between the axes of two views from one place, below which they are two choices."""


@dataclass(frozen=True)
class AheadConfig(PlannerConfig):
    """How far `ours-ahead` looks, beside what all policies share."""

    horizon: int = 4
    """Views of the paths that are compared."""

    num_spread: int = 40
    """How many of the candidates of it are spread over all reachable space."""

    beam: int = 4
    """Paths that it keeps for every further view."""

    branching: int = 6
    """Places that it tries for the next view of each path."""

    view_seconds: float = 4.0
    """What it counts for a view, beside the way to it [s]. With 1 it saves meters, looks
    at what is near once more, and 60 views of an office come out 1 dB worse."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        for name, least in (("horizon", 1), ("num_spread", 0), ("beam", 1), ("branching", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not (math.isfinite(self.view_seconds) and self.view_seconds >= 0.0):
            raise ValueError(f"view_seconds must be a finite number >= 0, got {self.view_seconds}")


@dataclass(frozen=True)
class Path:
    """Views one after the other, and what is known once they are taken."""

    places: tuple[int, ...]
    """Numbers of the places, in order."""

    poses: tuple[np.ndarray, ...]
    """The views, [4, 4] each."""

    gains: tuple[float, ...]
    """What each adds."""

    seconds: float
    """Of all of it."""

    voxels: MapState
    """Before the last view."""

    cells: Cells
    """Before the last view."""

    @property
    def rate(self) -> float:
        """Gain per second."""
        return sum(self.gains) / max(self.seconds, 1e-9)


@dataclass(frozen=True)
class BeamProblem:
    """What the search knows of the places."""

    poses: np.ndarray
    """The best view from each, [C, 4, 4], if it were the first."""

    utility: np.ndarray
    """What that is worth, [C]: a bound on what it is worth later."""

    lengths: np.ndarray
    """Of the way to each from where the robot is, [C] [m]; inf: there is none."""

    between: np.ndarray
    """Of the ways between them, [C, C] [m]."""

    kept: PanoramaCache
    """The panorama of each."""

    start: tuple[MapState, Cells]
    """What is known: surfaces and unexplored space at hand (`scoring.gather.gather_in_range`)."""

    camera: Camera
    config: AheadConfig

    limits: Limits = field(default_factory=Limits)
    """Of the carrier, where it is."""

    @property
    def speed(self) -> float:
        """Of the carrier [m/s]."""
        return self.limits.motion.speed or SPEED


def search(problem: BeamProblem) -> list[Path]:
    """The paths of the greatest rate, best first; none if no place can be reached."""
    config = problem.config
    ways = problem.limits.path_costs(problem.lengths, problem.poses)
    cost = config.view_seconds + ways / problem.speed
    reachable = np.flatnonzero(np.isfinite(cost))
    rate = problem.utility[reachable] / np.maximum(cost[reachable], 1e-9)
    ranked = reachable[np.argsort(-rate, kind="stable")]
    beam = [
        Path(
            (i,), (problem.poses[i],), (float(problem.utility[i]),), float(cost[i]), *problem.start
        )
        for i in _apart(ranked.tolist(), problem.poses, (), config.beam)
    ]
    for _ in range(config.horizon - 1):
        children = [child for path in beam for child in _expanded(path, problem)]
        beam = _best(children, config.beam)
    return beam


def lengths_between(travel: Travel, positions: np.ndarray) -> np.ndarray:
    """Lengths of ways between positions [C, 3] that the robot can come to, [C, C] [m].

    Over straight lines between near ones, each safe throughout, or back past the robot: no
    shorter than the shortest way. Unreachable positions are infinitely far from all others.
    """
    num = len(positions)
    gap = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    scaled = travel.scaled(positions)
    direct = np.zeros((num, num))
    nearest = np.argsort(gap, axis=1, kind="stable")[:, 1 : _NEIGHBORS + 1]
    for i in range(num):
        for j in nearest[i]:
            if direct[i, j] == 0.0 and segment_is_inside(travel.usable, scaled[i], scaled[j]):
                direct[i, j] = direct[j, i] = max(gap[i, j], 1e-6)  # 0 means "no edge" to SciPy
    over = shortest_path(csr_matrix(direct), directed=False)
    own = travel.lengths(positions)
    ways = np.minimum(over, own[:, None] + own[None, :])
    np.fill_diagonal(ways, 0.0)
    return ways


def _expanded(path: Path, problem: BeamProblem) -> list[Path]:
    """The path with one more view, once for each place that is tried."""
    config, last = problem.config, path.places[-1]
    limits = replace(problem.limits, T_world_camera=path.poses[-1])
    cost = config.view_seconds + problem.between[last] / problem.speed
    bound = (sum(path.gains) + problem.utility) / np.maximum(path.seconds + cost, 1e-9)
    bound[~np.isfinite(problem.lengths) | ~np.isfinite(cost)] = -np.inf
    ranked = [int(i) for i in np.argsort(-bound, kind="stable") if bound[i] > -np.inf]
    tried = [last, *_apart(ranked, problem.poses, path.poses, config.branching - 1)]
    padded = [tried[i % len(tried)] for i in range(config.branching)]  # compiles once
    T = jnp.asarray(path.poses[-1], dtype=jnp.float32)
    voxels, cells = simulate_view_near(path.voxels, path.cells, problem.camera, T, config.scoring)
    positions = problem.poses[padded, :3, 3]
    places = jnp.asarray(positions, dtype=jnp.float32)
    allowed = limits.allowed_axes(positions, config.scoring.panorama_bins)
    kept, now = problem.kept.at(jnp.asarray(padded)), (voxels, cells)
    panorama = score_cached_near(
        kept, problem.start, now, problem.camera, places, config.scoring, allowed
    )
    poses, gains = best_views(positions, panorama)
    poses = limits.project_to_feasible(poses)
    turning = [limits.motion.turning(angle_between(path.poses[-1], pose)) for pose in poses]
    return [
        Path(
            places=(*path.places, i),
            poses=(*path.poses, poses[k]),
            gains=(*path.gains, float(gains[k])),
            seconds=path.seconds + float(cost[i]) + turning[k],
            voxels=voxels,
            cells=cells,
        )
        for k, i in enumerate(tried)
    ]


def _best(paths: list[Path], num: int) -> list[Path]:
    """The `num` paths of the greatest rate; of those through the same places, the first."""
    kept: dict[frozenset[tuple[int, bytes]], Path] = {}
    for path in sorted(paths, key=lambda path: -path.rate):
        views = zip(path.places, path.poses, strict=True)
        kept.setdefault(frozenset((i, pose[:3, 2].tobytes()) for i, pose in views), path)
    return list(kept.values())[:num]


def _apart(
    ranked: Sequence[int], poses: np.ndarray, taken: Sequence[np.ndarray], num: int
) -> list[int]:
    """Up to `num` of the views, in order, each apart from those before it and those taken."""
    chosen: list[int] = []
    others = list(taken)
    for i in ranked:
        if len(chosen) == num:
            break
        if all(_are_apart(poses[i], other) for other in others):
            chosen.append(i)
            others.append(poses[i])
    return chosen


def _are_apart(first: np.ndarray, second: np.ndarray) -> bool:
    is_far = float(np.linalg.norm(first[:3, 3] - second[:3, 3])) >= _APART
    return is_far or float(first[:3, 2] @ second[:3, 2]) < _TURNED
