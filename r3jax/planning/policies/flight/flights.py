"""Flights over places near each other, and what all of their frames show together.

A frame looks where it adds most to those before it on its way. After looks from bins q of a voxel,
of which the one nearest to a direction has the cosine c with it, its R from there counts as

    max(R before, c^2)

so that ten frames of the same wall count little more than one; an unexplored cell counts once. All
flights are the shortest ways over one tree, and each place is looked at once for all that lie
behind it.

Shape symbols: C places; n voxels; B bins of the panorama; m places of the tree.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin_table
from r3jax.mapping.state import MapState
from r3jax.planning.robot.travel import Travel
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import bins_in_view
from r3jax.scoring.panorama_cache import PanoramaCache
from r3jax.scoring.terms import consistency

_NEIGHBORS = 10
"""Straight ways are looked for to so many of the nearest places."""


@dataclass(frozen=True)
class Sights:
    """What places see and what it is worth: the arrays that the kernels take."""

    lists: tuple[np.ndarray, ...]
    """Where each place's items begin, the items, their bins, R before and after a look."""

    num_items: int
    """Voxels and cells."""

    rest: tuple[Any, ...]
    """What `fly_tree` asks for after its mask."""


@dataclass(frozen=True)
class Tree:
    """The shortest ways from the robot over straight, safe ones between places."""

    order: np.ndarray
    """Places, depth first, [m]."""

    depth: np.ndarray
    """Places before each on its way, [m]."""

    steps: np.ndarray
    """Length of the last piece of each way [m], [m]."""

    lengths: np.ndarray
    """Length of the whole way [m], [m]."""


@functools.cache
def _directions(num_bins: int, own: int) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Tables of directions, squared cosines between both kinds of bins, bits of voxels' bins."""
    lattice = fibonacci_lattice(own).astype(np.float32)
    sphere = fibonacci_lattice(num_bins).astype(np.float32)
    table, own_table = (
        np.ascontiguousarray(nearest_bin_table(num).T, dtype=np.int32) for num in (num_bins, own)
    )
    # A voxel's bins point to the camera, those of a panorama away from it.
    cosines = np.maximum(-sphere @ lattice.T, np.float32(0.0))
    bits = np.uint64(1) << np.argmax(cosines, axis=1).astype(np.uint64)
    return (lattice, table, sphere, own_table), cosines**2, bits


def sights_of(
    kept: PanoramaCache,
    voxels: MapState,
    cells: Cells,
    places: np.ndarray,
    camera: Camera,
    scoring: ScoringConfig,
    *,
    every: int = 1,
    is_gain: bool = True,
) -> Sights:
    """Lists what places see, and what looks from there would make of it.

    Args:
        kept: panoramas of the places.
        voxels: at hand; no more than 64 bins.
        cells: at hand.
        places: [C, 3] [m].
        camera: of the frames.
        scoring: settings of the utility.
        every: one voxel and one cell of so many stands for all.
        is_gain: voxels count by what a look makes of R; else by 1 - R.
    """
    from r3jax.planning.policies.flight.kernels import list_seen, rate_seen

    num_voxels, num_cells = voxels.capacity, cells.x.shape[0]
    parts = [
        list_seen(np.asarray(bits), num, every, int(np.unpackbits(np.asarray(bits)).sum()))
        for bits, num in ((kept.voxels, num_voxels), (kept.cells, num_cells))
    ]
    (begin, seen), (cell_begin, empty) = parts
    item = np.concatenate(
        [
            part
            for k in range(len(places))
            for part in (
                seen[begin[k] : begin[k + 1]],
                empty[cell_begin[k] : cell_begin[k + 1]] + np.int32(num_voxels),
            )
        ]
    )
    points = [np.asarray(voxels.center), np.stack([cells.x, cells.y, cells.z])]
    tables, squares, bits = _directions(scoring.panorama_bins, voxels.num_bins)
    bins, low, high = rate_seen(
        places.astype(np.float32), begin + cell_begin, item, np.concatenate(points, axis=1),
        _known(voxels, scoring), np.float32(camera.focal), is_gain, tables,
    )  # fmt: skip
    in_view = np.asarray(bins_in_view(camera, scoring.panorama_bins)) > 0.0
    starts = np.concatenate([[0], np.cumsum(in_view.sum(axis=1))]).astype(np.int64)
    view = np.nonzero(in_view)[1].astype(np.int32), starts, in_view
    worths = np.float32(every), np.float32(every * float(scoring.lambda1))
    rest = squares, worths, num_voxels, view, bits
    return Sights((begin + cell_begin, item, bins, low, high), num_voxels + num_cells, rest)


def _known(voxels: MapState, scoring: ScoringConfig) -> tuple[Any, ...]:
    """What R of the voxels depends on."""
    if voxels.num_bins > 64:  # looks of a flight are kept in one word
        raise ValueError(f"flights are planned on maps of at most 64 bins, got {voxels.num_bins}")
    words = np.zeros((2, voxels.capacity), np.uint64)
    words[: len(voxels.visited)] = np.asarray(voxels.visited)
    visited = (words[0] | (words[1] << np.uint64(32)))[None]
    delta = np.array(consistency(voxels.count, voxels.m2, scoring.delta))
    log_delta = np.full_like(delta, -np.inf)
    np.log2(delta, where=delta > 0.0, out=log_delta)
    return visited, delta, log_delta, np.array(voxels.resolution), scoring.kappa == "one"


def flights_to(travel: Travel, places: np.ndarray) -> Tree:
    """Finds the ways from the robot to places [C, 3]; those without one are left out."""
    from r3jax.planning.robot.cells import segments_are_inside

    num, points = len(places), np.concatenate([places, travel.start[None]])
    gap = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = np.argsort(gap, axis=1, kind="stable")[:, 1 : _NEIGHBORS + 1]
    scaled, edges = travel.scaled(points), np.zeros_like(gap)
    for i, others in enumerate(nearest):
        is_safe = segments_are_inside(travel.usable, scaled[i], scaled[others])
        edges[i, others[is_safe]] = np.maximum(gap[i, others[is_safe]], 1e-6)  # 0 means "no edge"
    ways = dijkstra(csr_matrix(edges), directed=False, indices=num, return_predecessors=True)
    lengths, before = ways[0], ways[1]
    children: dict[int, list[int]] = {}
    for k in np.flatnonzero(before[:num] >= 0):
        children.setdefault(int(before[k]), []).append(int(k))
    order, depth = list[int](), list[int]()
    stack = [(k, 0) for k in children.get(num, [])]
    while stack:
        k, d = stack.pop()
        order.append(k)
        depth.append(d)
        stack += [(child, d + 1) for child in children.get(k, [])]
    index = np.array(order, dtype=np.int64)
    steps = lengths[index] - lengths[before[index]]
    return Tree(index, np.array(depth, dtype=np.int64), steps, lengths[index])


def fly(sights: Sights, tree: Tree, look_every: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the flight to each place of a tree shows, the axis of its last look, and what that adds.

    Args:
        sights: what the places see.
        tree: the flights.
        look_every: frames lie so far apart [m].

    Returns:
        [m] each.
    """
    from r3jax.planning.policies.flight.kernels import fly_tree

    # Whole pieces since the last place: a way has as many frames however many places it passes.
    pieces = np.floor(tree.lengths / look_every + 1e-6)
    before = np.floor((tree.lengths - tree.steps) / look_every + 1e-6)
    looks = (pieces - before).astype(np.int64)
    mask = np.zeros(sights.num_items, np.uint64)
    return fly_tree(tree.order, tree.depth, looks, sights.lists, mask, *sights.rest)
