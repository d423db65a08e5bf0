"""Directions for all frames of a path together, by dynamic programming (Viterbi 1967).

A node is a place on the path and a direction there. Its value is that of the best chain of
directions that leads to it; a chain adds up what each frame adds as if those before it had been
taken (`scoring.simulated`):

    V_0(q) = gain of q
    V_k(q) = max over q' that can turn to q of V_k-1(q') + gain of q after the best chain to q'

That is exact for two frames, and for any number where what a frame adds depends on the one before
it alone: each node keeps its best chain and forgets the others, which might have left more to
those that follow. A node is one of a few directions of each place, those that add most by
themselves and lie apart; the straight turn from view to view is always among them, so that there
is a chain.

Shape symbols: n places; W directions of a place; B bins of a panorama.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.gaze.turning import Turning, axes_within, pose_towards, turn
from r3jax.scoring.batch import cache_positions_near
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.gather import gather_in_range
from r3jax.scoring.panorama_cache import PanoramaCache, panorama_from_cache
from r3jax.scoring.simulated import simulate_view_near

WIDTH = 12
"""Directions of each place that chains are made of."""

_APART = np.radians(20.0)
"""Directions nearer to each other than this are one choice."""

Known = tuple[MapState, Cells]
"""Voxels and cells at hand."""


@dataclass(frozen=True)
class GazePlan:
    """The best chain that was found."""

    directions: np.ndarray
    """Directions of the frames, [n, 2] [rad]."""

    gain: float
    """What they add together."""


@dataclass(frozen=True)
class _Choice:
    """The nodes of one place."""

    directions: np.ndarray
    """[W, 2] [rad]."""

    axes: np.ndarray
    """Number of the axis of the panorama whose score each has, [W]."""


def plan_gaze(
    map_state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    places: np.ndarray,
    turning: Turning,
    scoring: ScoringConfig,
    width: int = WIDTH,
) -> GazePlan:
    """Plans the directions of the frames on a path.

    Args:
        map_state: the map before the first of them.
        grid: whose unexplored cells count.
        camera: of the frames.
        places: where they are captured, [n, 3] [m].
        turning: what the camera can turn to; its last piece leads on to the chosen view.
        scoring: settings of the utility.
        width: directions of each place.
    """
    at = jnp.asarray(places, dtype=jnp.float32)
    voxels, cells, _ = gather_in_range(map_state, grid, at, scoring)
    found = [
        cache_positions_near(voxels, cells, camera, at[k : k + 1], scoring)
        for k in range(len(places))
    ]
    alone = [np.asarray(panorama.direction_scores[0], np.float64) for panorama, _ in found]
    evenly = turning.evenly()
    nodes = [_nodes(turning, scores, evenly[k], width) for k, scores in enumerate(alone)]
    can_begin = turn(turning.start, nodes[0].directions) <= turning.allowed[0] + 1e-6
    value = np.where(can_begin, alone[0][nodes[0].axes], -np.inf)
    start = (voxels, cells)
    history = jax.tree.map(lambda x: jnp.broadcast_to(x, (width, *jnp.shape(x))), start)
    pointers: list[np.ndarray] = []
    for k in range(1, len(places)):
        before, now = nodes[k - 1], nodes[k]
        poses = [pose_towards(places[k - 1], direction) for direction in before.directions]
        poses = jnp.asarray(np.stack(poses), dtype=jnp.float32)
        kept = jax.tree.map(lambda x: x[0], found[k][1])
        history, scores = _expand(start, history, poses, kept, camera, at[k], scoring)
        gains = np.asarray(scores, np.float64)[:, now.axes]
        turns = turn(before.directions[:, None], now.directions[None])
        total = np.where(turns <= turning.allowed[k] + 1e-6, value[:, None] + gains, -np.inf)
        back = np.argmax(total, axis=0)
        value = total[back, np.arange(width)]
        pointers.append(back)
        best = jnp.asarray(back)
        history = jax.tree.map(lambda x, best=best: x[best], history)
    can_end = turn(nodes[-1].directions, turning.end) <= turning.allowed[len(places) :].sum() + 1e-6
    value = np.where(can_end, value, -np.inf)
    chain = [int(np.argmax(value))]
    for back in reversed(pointers):
        chain.append(int(back[chain[-1]]))
    chain.reverse()
    directions = [choice.directions[i] for choice, i in zip(nodes, chain, strict=True)]
    return GazePlan(np.stack(directions), float(value.max()))


def _nodes(turning: Turning, scores: np.ndarray, evenly: np.ndarray, width: int) -> _Choice:
    """The straight turn first, then the best directions that lie apart; repeats fill up."""
    numbers, directions = axes_within(turning.elevations, len(scores))
    lattice = fibonacci_lattice(len(scores))
    nearest = int(np.argmax(lattice @ pose_towards(np.zeros(3), evenly)[:3, 2]))
    chosen, axes = [evenly], [nearest]
    units = lattice[numbers]
    is_left = np.ones(len(numbers), dtype=bool)
    ranked = np.where(is_left, scores[numbers], -np.inf)
    while len(chosen) < width and is_left.any():
        best = int(np.argmax(np.where(is_left, ranked, -np.inf)))
        chosen.append(directions[best])
        axes.append(int(numbers[best]))
        is_left &= units @ units[best] < np.cos(_APART)
    repeats = np.arange(width) % len(chosen)
    return _Choice(np.stack(chosen)[repeats], np.array(axes)[repeats])


@jax.jit
def _expand(
    start: Known,
    history: Known,
    poses: Float[Array, "W 4 4"],
    kept: PanoramaCache,
    camera: Camera,
    place: Float[Array, " 3"],
    scoring: ScoringConfig,
) -> tuple[Known, Float[Array, "W B"]]:
    """Takes the view of each node, and scores all directions of the next place after it.

    Args:
        start: what is known before the path.
        history: the same after the best chain before each node; leaves of shape [W, ...].
        poses: the nodes' views.
        kept: panorama of the next place at the start.
        camera: of the frames.
        place: the next place [m].
        scoring: settings of the utility.

    Returns:
        What is known after each node, and the next place's direction scores.
    """

    def one(node: tuple[Known, Float[Array, "4 4"]]) -> tuple[Known, Float[Array, " B"]]:
        after = simulate_view_near(*node[0], camera, node[1], scoring)
        panorama = panorama_from_cache(kept, start, after, camera, place, scoring)
        return after, panorama.direction_scores

    return jax.lax.map(one, (history, poses))
