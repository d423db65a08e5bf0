"""Paths through all tiles, on a coarse graph of their cells, and the frontiers that lie along them.

A cell is *open* if a flying camera keeps its margin there (`travel.cells_for_ball`), or if the
robot has come through it; not in zones, a costmap's obstacles or known matter. A robot with wheels
needs the floor under its footprint, which only a map at hand shows: for it, only cells that it has
come through are open.

Each tile is cut into coarse cells of about 1.7 m, 3 m high. The open cells of a coarse cell that
are connected over faces *within it* are a node of the graph; the one nearest to their mean is the
node's center. Two nodes are neighbors if open cells of theirs share a face. The length of an edge
counts the steps over faces from one center to the other, through these two nodes only.

So the coarse level is conservative: a path through the graph is one through open cells, of this
length; none is found where no open cells lead. And it is complete: any path through open cells
crosses a sequence of neighboring nodes. Steps over faces are longer than diagonal ones: in open
space by a factor of at most sqrt(2) on a level and sqrt(3) through space.

A tile is summarized again only if its cells, or those within the margin of its border, have
changed; so all of a building costs one search on the graph.

Shape symbols: X Y Z cells of a tile; T tiles; n nodes; e edges; g goals; v places.
"""

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from r3jax.mapping.occupancy import FREE_LOG_ODDS, OCCUPIED_LOG_ODDS
from r3jax.mapping.tiles import Lattice, Tile
from r3jax.planning.candidates import VIEW_DISTANCE
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import MAX_FAILED_LOOKS
from r3jax.planning.robot.body import Body
from r3jax.planning.robot.motion import UNLIMITED
from r3jax.planning.robot.travel import Travel, cells_for_ball

FREE, OCCUPIED, GIVEN_UP = 1, 2, 4
"""Bits of a cell: known to be free, known to be occupied; no longer a reason to go there."""

_EDGE = 1.7, 1.7, 3.0
"""Edges of a coarse cell [m], about: a tile has a whole number of them. With 1.25, 1.25 and 2.5 m a
search in a building of 200 x 200 x 12 m takes 90 ms, not 17."""

_MAX_STEPS = 250
"""Open cells that lie more steps from their node's center than this are left out."""

_MIN_FRONTIER = 4
"""Fewer frontier cells in a coarse cell are noise."""

_MAX_GOALS = 8
"""Frontier goals of a tile: the largest."""

_TRIED_STOPS = 16
"""Places from which the straight line to a frontier cell is tested."""

_LEG = 8.0
"""A path is made exact piece by piece, of about this extent [m]."""

_CELLS = "cells", "node", "steps"
"""Fields of a tile's summary that have a number for each cell."""

_BATCH = 64
"""Tiles that are summarized together."""


class Clearance(NamedTuple):
    """The space that the robot needs."""

    margin: float = 0.0
    """Radius of the ball that must be free [m]."""

    heights: tuple[float, float] = UNLIMITED
    """Lowest and highest camera position [m]."""

    body: float = 0.0
    """Length of the robot below the camera [m]."""

    only_trail: bool = False
    """True if nothing but the robot's own trail is open."""


def clearance_of(config: PlannerConfig, start_height: float | None) -> Clearance:
    """Finds the clearance of a robot that has started at a height [m]; None: it does not matter."""
    heights = config.motion.heights_from(0.0 if start_height is None else start_height)
    body = config.motion.body
    if not isinstance(body, Body):
        return Clearance(config.safety_margin, heights, body)
    is_flying = body.heights is None
    return Clearance(body.needed, heights if is_flying else UNLIMITED, only_trail=not is_flying)


class Edges(NamedTuple):
    """Edges between nodes."""

    ends: np.ndarray
    """Numbers of two nodes, [2, e]."""

    length: np.ndarray
    """Steps from center to center, [e]."""


class Goals(NamedTuple):
    """Where the frontier can be seen."""

    aim: np.ndarray
    """Frontier cells, [g, 3]."""

    num: np.ndarray
    """Number of frontier cells in the coarse cell around, [g]."""

    place: np.ndarray
    """Open cells from which they are in plain view, [g, 3]."""


_NO_GOALS = Goals(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.int64))


@dataclass(frozen=True, eq=False)
class CoarseTile:
    """The nodes of one tile."""

    cells: np.ndarray
    """`FREE`, `OCCUPIED` and `GIVEN_UP` of each cell, [X, Y, Z] uint8."""

    node: np.ndarray
    """Number of the node of each open cell, within the tile, [X, Y, Z] int16; -1: not open."""

    steps: np.ndarray
    """Steps from each open cell to its node's center, [X, Y, Z] uint8."""

    centers: np.ndarray
    """Cells at the nodes' centers, [n, 3]; as all cells, counted from tile (0, 0, 0)."""

    edges: Edges
    """Edges within the tile."""

    frontier: Goals
    """Frontier cells within the tile, one for each of its largest groups; not yet with a place."""

    goals: Goals
    """Those that can be seen from an open cell."""


class Graph(NamedTuple):
    """All nodes and edges."""

    first: Mapping[Tile, int]
    """Number of the first node of each tile."""

    centers: np.ndarray
    """Cells at the nodes' centers, [n, 3]."""

    matrix: Any
    """Lengths of the edges [cells], a sparse [n, n]."""


@dataclass(frozen=True, eq=False)
class Coarse:
    """The coarse level of all tiles."""

    lattice: Lattice

    clearance: Clearance = field(default_factory=Clearance)
    """Of the robot, as of the latest update."""

    tiles: Mapping[Tile, CoarseTile] = field(default_factory=dict[Tile, CoarseTile])
    """Tiles of which anything is known."""

    links: Mapping[tuple[Tile, int], Edges] = field(default_factory=dict[tuple[Tile, int], Edges])
    """Edges from a tile to the next one along an axis."""

    closed: Mapping[tuple[int, int], np.ndarray] = field(
        default_factory=dict[tuple[int, int], np.ndarray]
    )
    """Columns of cells that are closed, [X, Y] bool, by the first two numbers of the tile."""

    @functools.cached_property
    def goals(self) -> Goals:
        """The goals of all tiles."""
        every = [_NO_GOALS, *(tile.goals for _, tile in sorted(self.tiles.items(), key=_name))]
        return Goals(*(np.concatenate(parts) for parts in zip(*every, strict=True)))

    @functools.cached_property
    def graph(self) -> Graph:
        """The graph of all tiles."""
        from scipy.sparse import coo_array

        # In one order, however it came about: ties are then broken alike.
        names, tiles = zip(*sorted(self.tiles.items(), key=_name), strict=True)
        begins = np.cumsum([0, *(len(tile.centers) for tile in tiles)])
        first = dict(zip(names, begins.tolist(), strict=False))
        inner = [tile.edges for tile in tiles]
        outer = sorted(self.links.items(), key=_name)
        shifts = [(first[tile], first[_next(tile, axis)]) for (tile, axis), _ in outer]
        edges = inner + [edges for _, edges in outer]
        shift = np.array([*((i, i) for i in begins[:-1]), *shifts]).reshape(-1, 2)
        num = [len(part.length) for part in edges]
        none = [Edges(np.zeros((2, 0), np.int64), np.zeros(0))]
        ends = np.concatenate([part.ends for part in edges + none], axis=1)
        ends = ends + np.repeat(shift.T, num, axis=1)
        length = np.concatenate([part.length for part in edges + none]).astype(np.float64)
        matrix = coo_array((length, tuple(ends)), shape=(begins[-1], begins[-1])).tocsr()
        centers = np.concatenate([np.zeros((0, 3), np.int64), *(tile.centers for tile in tiles)])
        return Graph(first, centers, matrix)

    def nodes(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Finds the node of each cell [v, 3], -1 where it is not open, and the steps to it."""
        node, steps = np.full(len(cells), -1), np.zeros(len(cells))
        for tile, rows, local in _by_tile(cells, self.lattice):
            if tile in self.tiles:
                at, own = tuple(local.T), self.tiles[tile]
                local_node = own.node[at].astype(np.int64)
                node[rows] = np.where(local_node < 0, -1, local_node + self.graph.first[tile])
                steps[rows] = own.steps[at]
        return node, steps

    def window(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Assembles the open and the free cells of a box [low, high), [X, Y, Z] bool each."""
        size = np.array(self.lattice.cells)
        is_open, free = np.zeros((2, *(high - low)), bool)
        ranges = (range(a, b) for a, b in zip(low // size, -(-high // size), strict=True))
        for x, y, z in itertools.product(*ranges):
            if (tile := (x, y, z)) in self.tiles:
                own, corner = self.tiles[tile], np.array(tile) * size
                begin, end = np.maximum(low, corner), np.minimum(high, corner + size)
                at, to = (tuple(slice(a, b) for a, b in zip(begin - o, end - o, strict=True))
                          for o in (corner, low))  # fmt: skip
                is_open[to] = own.node[at] >= 0
                free[to] = (own.cells[at] & FREE) > 0
        return is_open, free


def known_cells(
    log_odds: np.ndarray, looks: np.ndarray, viewed: np.ndarray | None = None
) -> np.ndarray:
    """Summarizes what is known of cells [X, Y, Z] as bits, uint8.

    Args:
        log_odds: of occupancy.
        looks: views that should have shown each cell while it was unexplored.
        viewed: frontier cells that the policy does not view again; None: none.
    """
    is_free = log_odds < FREE_LOG_ODDS
    is_over = (looks >= MAX_FAILED_LOOKS) & ~is_free
    if viewed is not None:
        is_over |= viewed
    cells = is_free * np.uint8(FREE) + (log_odds > OCCUPIED_LOG_ODDS) * np.uint8(OCCUPIED)
    return cells + is_over * np.uint8(GIVEN_UP)


def with_closed(coarse: Coarse, columns: np.ndarray) -> Coarse:
    """Closes columns of cells [m, 2], instead of those before.

    Tiles whose columns change are left out until `refreshed` is called with their cells.
    """
    x, y, _ = coarse.lattice.cells
    cells = np.column_stack([columns, np.zeros(len(columns), np.int64)])
    cells[:, 2] = 0
    closed: dict[tuple[int, int], np.ndarray] = {}
    for tile, _, local in _by_tile(cells, coarse.lattice):
        mask = closed.setdefault(tile[:2], np.zeros((x, y), bool))
        mask[tuple(local[:, :2].T)] = True
    none = np.zeros((x, y), bool)
    changed = {
        at
        for at in closed.keys() | coarse.closed.keys()
        if (closed.get(at, none) != coarse.closed.get(at, none)).any()
    }
    tiles = {tile: x for tile, x in coarse.tiles.items() if tile[:2] not in changed}
    links = {
        (tile, axis): edges
        for (tile, axis), edges in coarse.links.items()
        if tile in tiles and _next(tile, axis) in tiles
    }
    return replace(coarse, tiles=tiles, links=links, closed=closed)


def coarse_arrays(coarse: Coarse) -> dict[str, np.ndarray]:
    """Lists the coarse level as arrays, to be stored: the inverse of `with_summaries`."""
    names, links = sorted(coarse.tiles), sorted(coarse.links)
    tiles = [coarse.tiles[name] for name in names]
    edges = [coarse.links[name] for name in links]
    margin, heights, body, only_trail = coarse.clearance
    arrays = {"tile": np.array(names, np.int64).reshape(-1, 3),
              "link": np.array([(*tile, axis) for tile, axis in links], np.int64).reshape(-1, 4),
              "clearance": np.array([margin, *heights, body, only_trail])}  # fmt: skip
    if not tiles:
        return arrays
    arrays |= {name: np.stack([getattr(x, name) for x in tiles]) for name in _CELLS}
    parts = {"centers": [x.centers for x in tiles]}
    for name, some in (("edges", [x.edges for x in tiles]), ("links", edges)):
        parts |= {f"{name}.ends": [x.ends.T for x in some], f"{name}.length": [x[1] for x in some]}
    for name in ("frontier", "goals"):
        for i, field_name in enumerate(Goals._fields):
            parts[f"{name}.{field_name}"] = [getattr(x, name)[i] for x in tiles]
    for name, some in parts.items():
        if some:
            arrays |= {name: np.concatenate(some), f"{name}.num": np.array([len(x) for x in some])}
    return arrays


def with_summaries(coarse: Coarse, arrays: Mapping[str, np.ndarray]) -> Coarse:
    """Fills a coarse level, in which columns are closed already, with stored summaries."""
    if not len(arrays["tile"]):
        return coarse
    of = lambda name: np.split(arrays[name], np.cumsum(arrays[f"{name}.num"])[:-1])
    edges_of = lambda name: [
        Edges(ends.T, length) for ends, length in zip(of(f"{name}.ends"), of(f"{name}.length"),
                                                      strict=True)]  # fmt: skip
    goals_of = lambda name: map(Goals, *(of(f"{name}.{field}") for field in Goals._fields))
    parts = zip(*(arrays[name] for name in _CELLS), of("centers"), edges_of("edges"),
                goals_of("frontier"), goals_of("goals"), strict=True)  # fmt: skip
    names = [(x, y, z) for x, y, z in arrays["tile"].tolist()]
    links = [((x, y, z), axis) for x, y, z, axis in arrays["link"].tolist()]
    margin, low, high, body, only_trail = arrays["clearance"].tolist()
    return replace(
        coarse,
        clearance=Clearance(margin, (low, high), body, bool(only_trail)),
        tiles={name: CoarseTile(*part) for name, part in zip(names, parts, strict=True)},
        links=dict(zip(links, edges_of("links"), strict=True)) if links else {},
    )


def refreshed(
    coarse: Coarse,
    now: Mapping[Tile, np.ndarray],
    trails: np.ndarray,
    clearance: Clearance,
    box: np.ndarray,
) -> Coarse:
    """Summarizes the tiles that have changed.

    Args:
        coarse: before.
        now: cells of tiles that may have changed (`known_cells`), [X, Y, Z] each.
        trails: cells that the robot has come through, [n, 3].
        clearance: of the robot; the same at each call.
        box: of the space to explore, [2, 3] [m].
    """
    trail = _trails_in(trails, now, coarse.lattice)
    dirty = _changed(coarse, now, trail, _ring(coarse.lattice, clearance))
    if not dirty:
        return coarse
    cells_of = lambda tile: now[tile] if tile in now else _cells_of(coarse, tile)
    more = _trails_in(trails, dirty - now.keys(), coarse.lattice)
    tiles = dict(coarse.tiles)
    for _, level in itertools.groupby(sorted(dirty, key=lambda t: (t[2], t)), lambda t: t[2]):
        every = list(level)
        for i in range(0, len(every), _BATCH):
            part = every[i : i + _BATCH]
            tiles.update(_summarized(coarse, part, cells_of, trail | more, clearance, box))
    links = dict(coarse.links)
    for tile, axis in itertools.product(dirty, range(3)):
        for lower in (tile, _next(tile, axis, -1)):
            upper = _next(lower, axis)
            if lower in tiles and upper in tiles:
                links[lower, axis] = _linked(tiles[lower], tiles[upper], axis)
    after = replace(coarse, tiles=tiles, links=links, clearance=clearance)
    for tile in {other for part in dirty for other in _around(part) if other in tiles}:
        if len(tiles[tile].frontier.aim):
            tiles[tile] = replace(tiles[tile], goals=_goals(after, tile))
    return after


def _name(item: tuple[Any, Any]) -> Any:
    return item[0]


def _around(tile: Tile) -> Iterable[Tile]:
    x, y, z = (range(t - 1, t + 2) for t in tile)
    return itertools.product(x, y, z)


def _cells_of(coarse: Coarse, tile: Tile) -> np.ndarray | None:
    return coarse.tiles[tile].cells if tile in coarse.tiles else None


def _next(tile: Tile, axis: int, by: int = 1) -> Tile:
    x, y, z = (t + by * (i == axis) for i, t in enumerate(tile))
    return x, y, z


def _by_tile(cells: np.ndarray, lattice: Lattice) -> Iterable[tuple[Tile, np.ndarray, np.ndarray]]:
    """Groups cells [n, 3] by tile: the tile, the rows, and the cells within the tile."""
    size, is_whole = np.array(lattice.cells), np.array(lattice.num) == 1
    tile = np.where(is_whole, 0, np.floor_divide(cells, size))
    local = cells - tile * size
    rows = np.flatnonzero(np.all((local >= 0) & (local < size), axis=1))
    rows = rows[np.lexsort(tile[rows].T)]
    cuts = np.flatnonzero(np.any(np.diff(tile[rows], axis=0) != 0, axis=1)) + 1
    for part in np.split(rows, cuts) if len(rows) else []:
        x, y, z = tile[part[0]].tolist()
        yield (x, y, z), part, local[part]


def _trails_in(
    trails: np.ndarray, tiles: Iterable[Tile], lattice: Lattice
) -> dict[Tile, np.ndarray]:
    """Finds the trails' cells within some tiles: [n, 3] within each."""
    tiles = set(tiles)
    if not tiles or not len(trails):
        return {}
    size, every = np.array(lattice.cells), np.array(list(tiles))
    low, high = every.min(axis=0) * size, (every.max(axis=0) + 1) * size
    near = trails[np.all((trails >= low) & (trails < high), axis=1)]
    return {tile: local for tile, _, local in _by_tile(near, lattice) if tile in tiles}


def _ring(lattice: Lattice, clearance: Clearance) -> np.ndarray:
    """Computes how far around a cell others decide whether it is open, [3] [cells]."""
    size = lattice.cell_size
    reach = max(1, int(np.ceil(clearance.margin / size + 0.5)) - 1)
    below = int(np.ceil(clearance.body / size)) + 1 if clearance.body > 0.0 else 0
    return np.minimum([reach, reach, max(reach, below)], lattice.cells)


def _changed(
    coarse: Coarse,
    now: Mapping[Tile, np.ndarray],
    trail: Mapping[Tile, np.ndarray],
    ring: np.ndarray,
) -> set[Tile]:
    """Finds the tiles whose summary changes."""
    dirty: set[Tile] = set()
    for tile, cells in now.items():
        old = coarse.tiles.get(tile)
        if old is not None and np.array_equal(old.cells, cells):
            if tile in trail and _blocks_trail(coarse, tile, trail[tile]):
                dirty.add(tile)
            continue
        dirty.add(tile)
        before = np.zeros_like(cells) if old is None else old.cells
        moved = np.argwhere(((before ^ cells) & (FREE | OCCUPIED)) > 0)
        if not len(moved):
            continue
        near = [(moved[:, i] < ring[i], moved[:, i] >= cells.shape[i] - ring[i]) for i in range(3)]
        for other in _around(tile):
            if other in dirty or not (other in coarse.tiles or other in now):
                continue
            offset = [b - a for a, b in zip(tile, other, strict=True)]
            sides = [near[i][(o + 1) // 2] for i, o in enumerate(offset) if o]
            if np.any(np.logical_and.reduce(sides)):
                dirty.add(other)
    return dirty


def _blocks_trail(coarse: Coarse, tile: Tile, local: np.ndarray) -> bool:
    """Checks whether a tile's summary has closed cells that its robot has come through since."""
    own, at = coarse.tiles[tile], tuple(local.T)
    is_closed = own.node[at] < 0
    if tile[:2] in coarse.closed:
        is_closed &= ~coarse.closed[tile[:2]][at[:2]]
    return bool((is_closed & ((own.cells[at] & OCCUPIED) == 0)).any())


def _summarized(
    coarse: Coarse,
    tiles: Sequence[Tile],
    cells_of: Any,
    trail: Mapping[Tile, np.ndarray],
    clearance: Clearance,
    box: np.ndarray,
) -> dict[Tile, CoarseTile]:
    """Summarizes some tiles of one level."""
    lattice = coarse.lattice
    ring, size = _ring(lattice, clearance), np.array(lattice.cells)
    padded = np.zeros((len(tiles), *(size + 2 * ring)), np.uint8)
    middle = (slice(None), *(slice(r, -r) for r in ring.tolist()))
    for i, tile in enumerate(tiles):
        _fill(padded[i], tile, ring, cells_of)
    inner = np.ascontiguousarray(padded[middle])
    is_open = np.zeros(inner.shape, bool)
    free = (padded & FREE) > 0
    if not clearance.only_trail:
        low = _origin(lattice)[2] + (tiles[0][2] * size[2] - ring[2]) * lattice.cell_size
        # One behind the other: their rings keep them apart.
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        fits = cells_for_ball(flat(free), flat((padded & OCCUPIED) > 0), float(low),
                              lattice.cell_size, *clearance[:3])  # fmt: skip
        is_open = fits.reshape(padded.shape)[middle]
    for i, tile in enumerate(tiles):
        if tile in trail:
            at = tuple(trail[tile].T)
            is_open[i][at] |= (inner[i][at] & OCCUPIED) == 0
        if tile[:2] in coarse.closed:
            is_open[i] &= ~coarse.closed[tile[:2]][:, :, None]
    cuts = [_cuts(n, e / lattice.cell_size) for n, e in zip(lattice.cells, _EDGE, strict=True)]
    node, steps, centers, tile_of = _components(is_open, cuts)
    edges = _inner_edges(node, steps, cuts)
    frontier = _frontier(padded, tiles, ring, lattice, box)[middle]
    first = np.searchsorted(tile_of, np.arange(len(tiles) + 1))
    begins = np.searchsorted(edges.ends[0], first)
    found: dict[Tile, CoarseTile] = {}
    for i, tile in enumerate(tiles):
        own, part = slice(first[i], first[i + 1]), slice(begins[i], begins[i + 1])
        corner = np.array(tile) * size
        local = np.where(node[i] < 0, -1, node[i] - first[i]).astype(np.int16)
        found[tile] = CoarseTile(
            inner[i].copy(), local, steps[i].copy(), centers[own] + corner,
            Edges(edges.ends[:, part] - first[i], edges.length[part]),
            _grouped(frontier[i], cuts, corner), _NO_GOALS,
        )  # fmt: skip
    return found


def _fill(padded: np.ndarray, tile: Tile, ring: np.ndarray, cells_of: Any) -> None:
    """Fills in the cells of a tile, and those of its neighbors in the ring around."""
    for other in _around(tile):
        cells = cells_of(other)
        if cells is None:
            continue
        to: list[slice] = []
        of: list[slice] = []
        for o, r in zip(np.subtract(other, tile).tolist(), ring.tolist(), strict=True):
            to.append((slice(0, r), slice(r, -r), slice(-r, None))[o + 1])
            of.append((slice(-r, None), slice(None), slice(0, r))[o + 1])
        padded[tuple(to)] = cells[tuple(of)]


def _cuts(num: int, edge: float) -> np.ndarray:
    """Cuts `num` cells into pieces of about `edge` cells: where each begins, and the end."""
    parts = max(1, round(num / edge))
    return np.round(np.linspace(0, num, parts + 1)).astype(np.int64)


def _components(
    is_open: np.ndarray, cuts: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Finds the nodes of tiles [T, X, Y, Z].

    Returns:
        The node of each cell (-1: none) and the steps to its center, [T, X, Y, Z]; the nodes'
        centers, [n, 3], and their tiles in ascending order, [n].
    """
    # A gap after each coarse cell keeps them apart.
    at = [np.arange(c[-1]) + np.searchsorted(c[1:], np.arange(c[-1]), "right") for c in cuts]
    shape = (len(is_open), *(len(a) + len(c) - 1 for a, c in zip(at, cuts, strict=True)))
    spaced = (slice(None), at[0][:, None, None], at[1][None, :, None], at[2][None, None, :])
    mask = np.zeros(shape, bool)
    mask[spaced] = is_open
    flat = mask.reshape(-1, *shape[2:])
    found: Any = ndimage.label(flat)
    labels: np.ndarray = found[0]
    num = int(found[1])
    index = np.flatnonzero(labels)
    label = labels.reshape(-1)[index] - 1
    count = np.bincount(label, minlength=num)
    square = np.zeros(len(index))
    for x in np.unravel_index(index, flat.shape):
        mean = np.bincount(label, x, num) / np.maximum(count, 1)
        square += (x - mean[label]) ** 2
    key = np.round(16.0 * square).astype(np.int64) * flat.size + index
    best = np.full(num, np.iinfo(np.int64).max)
    np.minimum.at(best, label, key)
    center = best % flat.size
    # Numbered by tile, so that each has a range of numbers.
    order = np.argsort(center // (flat.size // len(is_open)), kind="stable")
    rank = np.argsort(order, kind="stable")
    steps, is_near = _steps(flat, center)
    node = np.full(flat.shape, -1, np.int32)
    node.reshape(-1)[index] = rank[label]
    node[~is_near] = -1
    tile, *cell = np.unravel_index(center[order], shape)
    cells = [np.searchsorted(a, x) for a, x in zip(at, cell, strict=True)]
    back = lambda x: x.reshape(shape)[spaced]
    return back(node), back(steps), np.stack(cells, axis=1), np.asarray(tile)


def _steps(mask: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts the steps over faces from each cell of a mask to the nearest center.

    Returns:
        Steps, uint8; and the cells from which it can be reached in `_MAX_STEPS`.
    """
    reached = np.zeros_like(mask)
    reached.reshape(-1)[centers] = True
    steps = (mask & ~reached).astype(np.uint8)
    for _ in range(_MAX_STEPS):
        grown = reached.copy()
        for axis in range(3):
            ahead, behind = np.moveaxis(grown, axis, 0), np.moveaxis(reached, axis, 0)
            ahead[1:] |= behind[:-1]
            ahead[:-1] |= behind[1:]
        grown &= mask
        left = mask ^ grown
        if np.array_equal(grown, reached):
            break
        reached = grown
        steps += left
    return steps, reached


def _inner_edges(node: np.ndarray, steps: np.ndarray, cuts: Sequence[np.ndarray]) -> Edges:
    """Finds the edges between coarse cells of one tile; of tiles [T, X, Y, Z]."""
    parts: list[np.ndarray] = []
    for axis in range(3):
        # The last layer of each coarse cell, and the first one of the next.
        last = cuts[axis][1:-1] - 1
        sides = [x.take(last + i, axis + 1).ravel() for i in (0, 1) for x in (node, steps)]
        parts.append(_pairs(*sides))
    return _shortest(np.concatenate(parts, axis=1))


def _linked(lower: CoarseTile, upper: CoarseTile, axis: int) -> Edges:
    """Finds the edges between two tiles."""
    a, b = (x.take(-1, axis).ravel() for x in (lower.node, lower.steps))
    c, d = (x.take(0, axis).ravel() for x in (upper.node, upper.steps))
    return _shortest(_pairs(a, b, c, d))


def _pairs(a: np.ndarray, steps_a: np.ndarray, b: np.ndarray, steps_b: np.ndarray) -> np.ndarray:
    """Lists pairs of open cells that share a face: both nodes, and the length, [3, e]."""
    both = np.flatnonzero((a >= 0) & (b >= 0))
    length = steps_a[both].astype(np.int64) + steps_b[both] + 1
    return np.stack([a[both].astype(np.int64), b[both].astype(np.int64), length])


def _shortest(pairs: np.ndarray) -> Edges:
    """Keeps the shortest of all edges between the same nodes, sorted by the first."""
    a, b, length = pairs
    order = np.lexsort((length, b, a))
    pairs = pairs[:, order]
    is_first = np.any(np.diff(pairs[:2], axis=1, prepend=-1) != 0, axis=0)
    return Edges(pairs[:2, is_first].astype(np.int32), pairs[2, is_first].astype(np.float32))


def _frontier(
    padded: np.ndarray, tiles: Sequence[Tile], ring: np.ndarray, lattice: Lattice, box: np.ndarray
) -> np.ndarray:
    """Finds free cells with a face neighbor that may be explored, in tiles with their rings."""
    unexplored, size = padded == 0, lattice.cell_size
    for axis in range(3):
        shape = [len(tiles), 1, 1, 1]
        shape[axis + 1] = padded.shape[axis + 1]
        cell = np.arange(shape[axis + 1]) - ring[axis] + np.zeros((len(tiles), 1))
        inside = (cell >= 0) & (cell < lattice.cells[axis])
        if lattice.num[axis] > 1:
            first = np.array([tile[axis] for tile in tiles])[:, None] * lattice.cells[axis]
            place = lattice.origin[axis] + (first + cell + 0.5) * size
            inside = (place > box[0, axis] - size) & (place < box[1, axis] + size)
        unexplored &= inside.reshape(shape)
    beside = np.zeros_like(unexplored)
    for axis in range(1, 4):
        ahead, behind = np.moveaxis(beside, axis, 0), np.moveaxis(unexplored, axis, 0)
        ahead[1:] |= behind[:-1]
        ahead[:-1] |= behind[1:]
    return beside & ((padded & (FREE | GIVEN_UP)) == FREE)


def _grouped(frontier: np.ndarray, cuts: Sequence[np.ndarray], corner: np.ndarray) -> Goals:
    """Finds the cell in the middle of the frontier of each coarse cell, of those with the most."""
    count = frontier.astype(np.int64)
    for axis in range(3):
        count = np.add.reduceat(count, cuts[axis][:-1], axis=axis)
    largest = np.argsort(-count, axis=None, kind="stable")[:_MAX_GOALS]
    largest = largest[count.reshape(-1)[largest] >= _MIN_FRONTIER]
    aims = np.zeros((len(largest), 3), np.int64)
    for k, block in enumerate(np.stack(np.unravel_index(largest, count.shape), axis=1).tolist()):
        low = np.array([c[i] for c, i in zip(cuts, block, strict=True)])
        part = tuple(slice(c[i], c[i + 1]) for c, i in zip(cuts, block, strict=True))
        cells = np.argwhere(frontier[part])
        middle = np.argmin(np.linalg.norm(cells - cells.mean(axis=0), axis=1))
        aims[k] = corner + low + cells[middle]
    return Goals(aims, count.reshape(-1)[largest], np.zeros((0, 3), np.int64))


def _goals(coarse: Coarse, tile: Tile) -> Goals:
    """Finds places from which the frontier of a tile is in plain view."""
    from r3jax.kernels.robot.cells import nearest_in_ring, segments_are_inside

    size, frontier = coarse.lattice.cell_size, coarse.tiles[tile].frontier
    reach = int(np.ceil(VIEW_DISTANCE[1] / size))
    low = np.array(tile) * np.array(coarse.lattice.cells) - reach
    is_open, free = coarse.window(low, low + 2 * reach + np.array(coarse.lattice.cells))
    places, found = np.zeros_like(frontier.aim), np.zeros(len(frontier.aim), bool)
    for i, aim in enumerate(frontier.aim - low):
        stops = nearest_in_ring(is_open, aim, reach, size, *VIEW_DISTANCE, 256)
        stops = stops[:: max(1, len(stops) // _TRIED_STOPS)]
        sees = segments_are_inside(free, aim + 0.5, stops + 0.5)
        if sees.any():
            places[i], found[i] = stops[np.argmax(sees)] + low, True
    return Goals(frontier.aim[found], frontier.num[found], places[found])


class Lengths(NamedTuple):
    """Shortest paths from one cell to all nodes."""

    cost: np.ndarray
    """Length to each node's center [cells], [n]; inf: none."""

    previous: np.ndarray
    """The node before, [n]; negative at the first."""


def connected_within(
    coarse: Coarse, tiles: Iterable[Tile], cell: np.ndarray, others: np.ndarray
) -> np.ndarray:
    """Finds which cells [v, 3] a path within some tiles joins to a cell [3], [v] bool."""
    from scipy.sparse.csgraph import connected_components

    some = {tile: coarse.tiles[tile] for tile in tiles if tile in coarse.tiles}
    links = {(tile, axis): coarse.links[tile, axis] for tile in some for axis in range(3)
             if _next(tile, axis) in some}  # fmt: skip
    part = replace(coarse, tiles=some, links=links)
    nodes, _ = part.nodes(np.concatenate([cell[None], others]))
    if nodes[0] < 0:
        return np.zeros(len(others), bool)
    _, label = connected_components(part.graph.matrix, directed=False)
    return (nodes[1:] >= 0) & (label[nodes[1:]] == label[nodes[0]])


def lengths_from(coarse: Coarse, cell: np.ndarray, limit: float = np.inf) -> Lengths | None:
    """Finds the shortest paths from a cell [3] to all nodes within `limit` [cells].

    None if that cell is not open.
    """
    from scipy.sparse.csgraph import dijkstra

    (start,), (steps,) = coarse.nodes(cell[None])
    if start < 0:
        return None
    cost, previous = dijkstra(
        coarse.graph.matrix, False, int(start), return_predecessors=True, limit=limit
    )
    return Lengths(cost + steps, previous)


def path_along(
    coarse: Coarse,
    lengths: Lengths,
    here: np.ndarray,
    there: np.ndarray,
) -> np.ndarray:
    """Follows a path through open cells, straightened: its corners, [K, 3] [m].

    Args:
        coarse: all tiles.
        lengths: from here.
        here: where the path begins, [3] [m].
        there: where it ends, at a finite length, [3] [m].
    """
    from r3jax.kernels.robot.shortest_paths import shortest_paths

    lattice = coarse.lattice
    origin, size = _origin(lattice), lattice.cell_size
    (node,), _ = coarse.nodes(cell_of(lattice, there)[None])
    nodes = [int(node)]
    while lengths.previous[nodes[-1]] >= 0:
        nodes.append(int(lengths.previous[nodes[-1]]))
    cells = coarse.graph.centers[nodes[::-1]]
    around = np.ceil(np.array(_EDGE) * 1.5 / size).astype(np.int64) + 1
    corners, i = [here], 0
    while True:
        # As far as a window holds; all of a node lies around its center.
        gap = np.abs(cells[i:] - cells[i]).max(axis=1) > _LEG / size
        j = i + int(np.argmax(gap)) if gap.any() else len(cells)
        ends = cells[i : min(j + 1, len(cells))]
        low, high = ends.min(axis=0) - around, ends.max(axis=0) + around + 1
        is_open, _ = coarse.window(low, high)
        begin = cell_of(lattice, corners[-1]) - low
        cost, previous = shortest_paths(is_open, (int(begin[0]), int(begin[1]), int(begin[2])))
        travel = Travel(
            corners[-1], (int(begin[0]), int(begin[1]), int(begin[2])), origin + low * size, size,
            is_open, is_open, is_open, cost * size, previous, coarse.clearance.heights,
        )  # fmt: skip
        is_last = j >= len(cells)
        end = there if is_last else travel.stops(cells[j] - low)
        corners += list(travel.path(end)[1:])
        if is_last:
            return _without_straight_corners(np.array(corners))
        i = j


def _without_straight_corners(path: np.ndarray) -> np.ndarray:
    """Drops corners at which a path [K, 3] goes straight on."""
    kept = [0]
    for i in range(1, len(path) - 1):
        before, after = path[i] - path[kept[-1]], path[i + 1] - path[i]
        if np.linalg.norm(np.cross(before, after)) > 1e-9 or before @ after < 0.0:
            kept.append(i)
    return path[[*kept, len(path) - 1]] if len(path) > 1 else path


def cell_of(lattice: Lattice, position: np.ndarray) -> np.ndarray:
    """Finds the cells that hold positions [..., 3] [m], counted from tile (0, 0, 0)."""
    return np.floor((position - _origin(lattice)) / lattice.cell_size).astype(np.int64)


def _origin(lattice: Lattice) -> np.ndarray:
    """Returns the lower corner of tile (0, 0, 0), [3] [m], a thousandth of a cell lower.

    A camera whose height is a border of layers is then in the upper one, however that is rounded.
    """
    return np.array(lattice.origin) - [0.0, 0.0, 1e-3 * lattice.cell_size]
