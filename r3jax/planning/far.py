"""Far places: tiles, paths back to them, and views left for later.

A planner that was started without bounds, or with `MappingConfig(tiles=True)`, holds a block of
tiles (`mapping.tiles`): policies draw and score in it as in a house, and depend on nothing else.
Goals lie so far within it that all that they may see is at hand. Views that were scored and not
taken are kept when the robot goes away: they are scored once more when they leave the block, and
nothing changes there until it comes back. Each decision weighs them against the views on offer,
with the length of the paths to them, as the policy weighs. A robot that takes one goes back, over
cells that it has come through, to where the view was found; the next decision has the place at
hand.

Shape symbols: n cells; v views; X Y Z cells at hand.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import check_near_origin
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import (
    COSTMAP,
    KEEP_OUT,
    MAX_CELLS,
    REFUSED,
    OccupancyGrid,
    squared_distance,
)
from r3jax.mapping.state import MapState
from r3jax.mapping.tiles import (
    ACROSS,
    HYSTERESIS,
    Lattice,
    Tile,
    Tiles,
    arrays_of,
    capacity_for,
    lattice_for,
    middle_for,
    page,
    unpacked_layer,
    with_arrays,
)
from r3jax.planning.candidates import candidates_along
from r3jax.planning.decide import GreedyPolicy, PlannerState, look_round
from r3jax.planning.policy import Decision, LivesOutside, Policy
from r3jax.planning.robot.limits import Limits

_BLOCK = 1.0
"""Of views so close together [m] the best is kept."""

_RETURN = 1.0
"""A robot that stands at most this far from a cell that it has come through [m] came from there."""


_KINDS = {"log_odds": "<f4", "looks": "<i4"}
"""Stored fields of cells, and their types."""


class Views(NamedTuple):
    """Views that were scored and not taken."""

    pose: np.ndarray
    """[v, 4, 4] float64."""

    place: np.ndarray
    """Where the robot stood when it saw that they can be reached, [v, 3] [m]."""

    path: np.ndarray
    """Length of the path from there to the view [m], [v]."""

    values: Mapping[str, np.ndarray]
    """Numbers of the policy, by name, [v] each."""

    def take(self, which: np.ndarray) -> "Views":
        """Gathers views by index or mask."""
        values = {name: x[which] for name, x in self.values.items()}
        return Views(self.pose[which], self.place[which], self.path[which], values)


NO_VIEWS = Views(np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0), {})


def _joined(a: Views, b: Views) -> Views:
    if not len(a.path) or not len(b.path):
        return a if len(a.path) else b
    values = {name: np.concatenate([a.values[name], x]) for name, x in b.values.items()}
    pose, place, path = (np.concatenate([x, y]) for x, y in zip(a[:3], b[:3], strict=True))
    return Views(pose, place, path, values)


@dataclass(frozen=True, eq=False)
class Far:
    """The world beyond the block at hand, and the marks that are drawn into each block."""

    tiles: Tiles
    """Voxels and cells of all other tiles."""

    box: np.ndarray
    """Lower and upper corner of the space to explore, [2, 3] [m]; infinite where it has no end."""

    border: float
    """Goals keep this far from the block's faces, so that what they may see is at hand [m]."""

    views: Views = NO_VIEWS
    """Views left for later."""

    trails: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    """Cells that the robot has come through, counted from tile (0, 0, 0), [n, 3]."""

    zones: tuple[np.ndarray, ...] = ()
    """Polygons that no robot may enter, [k, 2] each [m]."""

    costs: tuple[np.ndarray, float] = (np.zeros((0, 2)), 0.0)
    """Lower corners of a costmap's closed pixels, [k, 2] [m], and their edge [m]."""

    refused: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """Goals that could not be reached, and the radii round them, [k, 4] [m]."""

    @property
    def first_cell(self) -> np.ndarray:
        """The first cell at hand, counted from tile (0, 0, 0), [3]."""
        lattice = self.tiles.lattice
        return (np.array(self.tiles.middle) - np.array(lattice.num) // 2) * np.array(lattice.cells)

    @property
    def trail(self) -> np.ndarray:
        """Cells at hand that the robot has come through, [X, Y, Z] bool."""
        trail = np.zeros(self.tiles.lattice.shape, bool)
        cells = self.trails - self.first_cell
        cells = cells[np.all((cells >= 0) & (cells < trail.shape), axis=1)]
        trail[tuple(cells.T)] = True
        return trail

    def with_trail(self, trail: np.ndarray) -> "Far":
        """Adds cells at hand, [X, Y, Z] bool, to the trails."""
        new = np.argwhere(trail & ~self.trail) + self.first_cell
        return replace(self, trails=np.concatenate([self.trails, new])) if len(new) else self

    def is_at_hand(self, position: np.ndarray) -> bool:
        """Returns True if all that may be seen from a position [3] [m] is at hand."""
        return bool(_at_hand(self, position[None], self.tiles.middle)[0])

    def whole_grid(self, grid: OccupancyGrid) -> OccupancyGrid:
        """Joins the cells at hand and those of all tiles, without marks.

        It covers the box, or along axes without end all tiles of which anything is known.

        Args:
            grid: the cells at hand.

        Raises:
            ValueError: more cells than a grid may have.
        """
        lattice = self.tiles.lattice
        edge = np.array(lattice.cells)
        corners = np.array([*self.tiles.cells, self.first_cell // edge]) * edge
        block = self.first_cell + np.array(lattice.shape)
        known = np.array([corners.min(axis=0), np.maximum(corners.max(axis=0) + edge, block)])
        box = self.box_cells
        first, last = np.where(np.isfinite(box), box, known).astype(np.int64)
        num = float(np.prod((last - first).astype(float)))
        if num > MAX_CELLS:
            raise InputError(
                f"the place has {num:.2g} cells, more than the {MAX_CELLS:.0e} of one grid: larger "
                "cells (cell_size) are fewer"
            )
        log_odds = np.zeros(last - first, np.float32)

        def put(values: np.ndarray, at: np.ndarray) -> None:
            low = np.maximum(at, first)
            high = np.minimum(at + values.shape, last)
            if np.all(low < high):
                to, of = (tuple(map(slice, low - x, high - x)) for x in (first, at))
                log_odds[to] = values[of]

        for tile, layers in self.tiles.cells.items():
            if "log_odds" in layers:
                put(unpacked_layer(layers["log_odds"], lattice.cells), np.array(tile) * edge)
        put(np.asarray(grid.log_odds), self.first_cell)
        return OccupancyGrid(
            log_odds=jnp.asarray(log_odds),
            origin=jnp.asarray(np.array(lattice.origin) + first * lattice.cell_size, jnp.float32),
            cell_size=grid.cell_size,
        )

    @property
    def box_cells(self) -> np.ndarray:
        """First cell of the box, and the first one beyond it, counted from tile (0, 0, 0), [2, 3].

        A cell more on every side, as in a grid of the box; infinite where it has no end.
        """
        lattice = self.tiles.lattice
        box = (self.box - np.array(lattice.origin)) / lattice.cell_size
        # The cells whose centers lie within; the tolerance keeps faces on cells' borders exact.
        ends = np.array([np.floor(box[0] - 0.5 + 1e-6), np.ceil(box[1] + 0.5 - 1e-6)])
        return np.where(np.array(lattice.num) > 1, ends, [np.zeros(3), np.array(lattice.cells)])

    def grid(self, log_odds: np.ndarray) -> OccupancyGrid:
        """Makes the grid at hand of its cells: with the limits, zones and marks that lie in it."""
        lattice = self.tiles.lattice
        corner = lattice.corner(self.tiles.middle)
        grid = OccupancyGrid(
            log_odds=jnp.asarray(log_odds),
            origin=jnp.asarray(corner, jnp.float32),
            cell_size=jnp.asarray(lattice.cell_size, jnp.float32),
        )
        inside, stops = np.ones((2, *lattice.shape), bool)
        is_cut = np.array(lattice.num) > 1
        for axis in range(3):
            if not is_cut[axis]:
                continue
            place = corner[axis] + (np.arange(lattice.shape[axis]) + 0.5) * lattice.cell_size
            low, high = self.box[:, axis] + [-lattice.cell_size, lattice.cell_size]
            shape = [-1 if i == axis else 1 for i in range(3)]
            inside &= ((place > low) & (place < high)).reshape(shape)
            last = corner[axis] + lattice.shape[axis] * lattice.cell_size - self.border
            stops &= ((place > corner[axis] + self.border) & (place < last)).reshape(shape)
        for x, y, z, radius in self.refused:
            center = jnp.asarray([x, y, z], jnp.float32)
            stops &= np.asarray(squared_distance(grid, center)) > radius**2
        # One structure for all blocks: another one would be compiled for.
        if np.isfinite(self.box[:, is_cut]).any():
            grid = replace(grid, explorable=jnp.asarray(inside))
        columns = np.zeros(lattice.shape[:2], bool)
        for zone in self.zones:
            columns |= columns_in(grid, zone)
        fill = lambda columns: np.broadcast_to(columns[:, :, None], lattice.shape)
        grid = grid.marked(~stops, REFUSED).marked(fill(columns), KEEP_OUT)
        return grid.marked(fill(pixel_columns(grid, *self.costs)), COSTMAP)


def first_far(
    config: MappingConfig,
    policy: Policy,
    camera: Camera,
    box: np.ndarray,
    starts: Sequence[np.ndarray] = (),
) -> Far:
    """Makes an empty record of far places, before the first frame."""
    if box.shape != (2, 3) or not np.all(box[1] > box[0]):  # NaN, too
        raise InputError(
            "bounds are a lower and an upper corner, [2, 3] in meters, each upper value above the "
            f"lower one; got {box.tolist()}"
        )
    check_near_origin("bounds", np.where(np.isfinite(box), box, 0.0))
    lattice = lattice_for(config, camera, box)
    middle = np.nan_to_num(np.clip(0.0, *box))
    start = np.asarray(starts[0], np.float64)[:3, 3] if starts else middle
    x, y, z = (int(i) for i in lattice.tiles_of(start[:, None])[:, 0])
    capacity = capacity_for(lattice, config.voxel_size)
    scoring = getattr(getattr(policy, "config", None), "scoring", None)
    sees = config.max_range if scoring is None else float(scoring.max_range)
    border = sees + config.cell_size
    if border + config.cell_size > _least_half(lattice):
        raise InputError(
            f"the policy scores views up to {sees:g} m, but tiles at hand may end "
            f"{_least_half(lattice):g} m from the robot: give its scoring a shorter max_range"
        )
    return Far(Tiles(lattice, (x, y, z), capacity), box, border)


def _least_half(lattice: Lattice) -> float:
    """Finds how far the block reaches at least, to each side of the robot [m]."""
    cut = lattice.edge[np.array(lattice.num) > 1]
    return float((ACROSS // 2) * cut.min() - HYSTERESIS) if len(cut) else np.inf


def check_policy(policy: Policy, policy_state: Any) -> None:
    """Refuses policies that keep their own picture of the map: it would not move with the tiles.

    Raises:
        ValueError: names the policy, and what to do.
    """
    is_plain = isinstance(policy_state, PlannerState) and not jax.tree.leaves(policy_state.memory)
    weighs = getattr(type(policy), "weigh", None) is GreedyPolicy.weigh
    if not is_plain or not weighs or isinstance(policy, LivesOutside):
        raise InputError(
            f"the policy {policy.name!r} has a memory or a measure of its own for the whole place, "
            "which cannot be cut into tiles: give finite bounds and no tiles, or use r3 or r3-pano"
        )


Known = tuple[MapState, OccupancyGrid, PlannerState, Far]
"""What a planner holds: rows, cells and a policy's memory at hand, and all else."""


def moved_to(known: Known, policy: GreedyPolicy, position: np.ndarray) -> Known:
    """Moves the block to a position [3] [m]; unchanged if that lies in its middle."""
    map_state, grid, memory, far = known
    if middle_for(far.tiles, position) == far.tiles.middle:
        return known
    layers = {"log_odds": np.asarray(grid.log_odds), "looks": memory.looks}
    after, layers, tiles = page(map_state, layers, far.tiles, position)
    # Before they are out of hand: what they promise stays true until the robot comes back.
    views = _renewed(known, policy, tiles.middle)
    far = replace(far, tiles=tiles, views=views)
    memory = replace(memory, looks=layers["looks"], trail=far.trail)
    return after, far.grid(layers["log_odds"]), memory, far


def known_round(
    map_state: MapState, grid: OccupancyGrid, far: Far, position: np.ndarray
) -> tuple[MapState, OccupancyGrid]:
    """Returns the rows and the cells of the block round any position [3] [m]."""
    lattice = far.tiles.lattice
    layers = {name: np.zeros(lattice.shape, kind) for name, kind in _KINDS.items()}
    layers["log_odds"] = np.asarray(grid.log_odds)
    state, layers, tiles = page(map_state, layers, far.tiles, position)
    return state, replace(far, tiles=tiles).grid(layers["log_odds"])


def _at_hand(far: Far, positions: np.ndarray, middle: Tile) -> np.ndarray:
    """Finds which positions [v, 3] goals may have in the block round a tile, [v] bool."""
    lattice = far.tiles.lattice
    low = lattice.corner(middle)
    size = np.array(lattice.shape) * lattice.cell_size
    is_in = (positions > low + far.border) & (positions < low + size - far.border)
    return np.all(is_in | (np.array(lattice.num) == 1), axis=1)


def _renewed(known: Known, policy: GreedyPolicy, middle: Tile) -> Views:
    """Scores those views again that are at hand, and will not be round another tile."""
    map_state, grid, memory, far = known
    views, position = far.views, far.views.pose[:, :3, 3]
    leaves = _at_hand(far, position, far.tiles.middle) & ~_at_hand(far, position, middle)
    old = views.take(np.flatnonzero(leaves)[: policy.config.num_candidates])
    if not len(old.path):
        return views
    kept = views.take(~leaves)
    here, lattice = np.eye(4), far.tiles.lattice
    center = lattice.corner(far.tiles.middle) + 0.5 * np.array(lattice.shape) * lattice.cell_size
    here[:3, 3] = old.place[np.argmin(np.linalg.norm(old.place - center, axis=1))]
    try:
        _, situation = look_round(memory, map_state, grid, here, policy.config)
    except InputError:  # that place lies out of the heights that are allowed now
        return kept
    offered = candidates_along(old.pose[:, :3, 3], old.pose[:, :3, 2])
    padded = offered.padded(policy.config.num_candidates)
    scored, values = policy.score(situation, padded, key=jax.random.key(0))
    num = len(old.path)
    pose = scored.T_world_camera[:num]
    renewed = {name: np.asarray(values[name])[:num] for name in old.values if name in values}
    fresh = Views(pose, old.place, old.path, renewed)
    return _joined(kept, fresh.take(scored.valid[:num] & (renewed["utility"] > 0.0)))


def with_views(far: Far, decision: Decision, here: np.ndarray, radius: float) -> Far:
    """Keeps the views of a decision that lie farther away than `radius` [m].

    They take the place of older ones near them.
    """
    position = decision.candidates[:, :3, 3]
    gap = np.linalg.norm(position - here, axis=1)
    path = decision.utilities["path"]
    values = {n: x for n, x in decision.utilities.items() if n not in ("path", "total")}
    if "utility" not in values:
        return far
    is_kept = np.isfinite(path) & (gap > max(radius, _BLOCK)) & (values["utility"] > 0.0)
    new = Views(decision.candidates, np.tile(here, (len(path), 1)), path, values).take(is_kept)
    order = np.argsort(-new.values["utility"], kind="stable")
    both = _joined(new.take(order), far.views)
    if not len(both.path):
        return far
    block = np.floor(both.pose[:, :3, 3] / _BLOCK).astype(np.int64)
    _, first = np.unique(block, axis=0, return_index=True)
    return replace(far, views=both.take(np.sort(first)))


def weigh_far(
    far: Far, policy: GreedyPolicy, decision: Decision | None, T_here: np.ndarray
) -> tuple[Decision | None, Far]:
    """Weighs views left for later against a decision; returns the better one.

    Args:
        far: record of far places, including the path to here.
        policy: which weighs.
        decision: decision within the block; None if there is no goal.
        T_here: pose of the robot, [4, 4].
    """
    here = T_here[:3, 3]
    is_far = ~_at_hand(far, far.views.pose[:, :3, 3], far.tiles.middle)
    if not is_far.any():
        return decision, far
    index = np.flatnonzero(is_far)
    views = far.views.take(index)
    length, previous = _lengths(far, here)
    path = length[_nodes(far, views.place)] + views.path
    for goal in far.refused:
        path[np.linalg.norm(views.place - goal[:3], axis=1) <= goal[3]] = np.inf
    near = np.argsort(path, kind="stable")[: max(policy.config.num_frontier, 1)]
    near = near[np.isfinite(path[near])]
    if not len(near):
        return decision, far
    views, path, index = views.take(near), path[near], index[near]
    values = dict(views.values) | {"path": path}
    num = 0
    if decision is not None:
        num = len(decision.candidates)
        values = {name: np.concatenate([decision.utilities[name], x])
                  for name, x in values.items() if name in decision.utilities}  # fmt: skip
    total = np.where(np.isfinite(values["path"]), policy.weigh(values), -np.inf)
    best = int(np.argmax(total))
    if best < num:
        return decision, far
    chosen = best - num
    pose = views.pose[chosen].copy()
    pose[:3, 3] = views.place[chosen]
    waypoints = _path_back(far, previous, here, pose[:3, 3])
    poses = views.pose if decision is None else np.concatenate([decision.candidates, views.pose])
    poses = np.array(poses)
    poses[best] = pose
    kept = np.ones(len(far.views.path), bool)
    kept[index[chosen]] = False  # once it is at hand again, it is drawn again if it still promises
    walk = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    seconds = Limits(policy.config.motion, T_here).seconds(walk, pose[:3, 2])
    taken = Decision(pose, waypoints, walk, float(total[best]), poses,
                     values | {"total": total}, seconds)  # fmt: skip
    return taken, replace(far, views=far.views.take(kept))


def arrived(far: Far, here: np.ndarray) -> Far:
    """Adds the robot's own place to the trails, and the line to the nearest cell if it is near."""
    lattice = far.tiles.lattice
    cell = np.floor((here - np.array(lattice.origin)) / lattice.cell_size).astype(np.int64)
    cells = [cell]
    if len(far.trails):
        gap = np.linalg.norm(far.trails - cell, axis=1)
        nearest = int(np.argmin(gap))
        if gap[nearest] == 0.0:
            return far
        if gap[nearest] * lattice.cell_size <= _RETURN:
            steps = np.linspace(far.trails[nearest], cell, 2 * int(np.ceil(gap[nearest])) + 1)
            line = np.unique(np.round(steps).astype(np.int64), axis=0)
            cells = [c for c in line if not np.all(far.trails == c, axis=1).any()]
    return replace(far, trails=np.concatenate([far.trails, np.array(cells)]))


def _nodes(far: Far, places: np.ndarray) -> np.ndarray:
    """Finds the number of the trails' cell nearest to each place [v, 3], [v]."""
    from scipy.spatial import KDTree

    lattice = far.tiles.lattice
    cells = (places - np.array(lattice.origin)) / lattice.cell_size - 0.5
    return np.asarray(KDTree(far.trails).query(cells)[1])


def _lengths(far: Far, here: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the shortest paths from here to all cells of the trails: lengths [m], cells before."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import KDTree

    # The 26 neighbors; all cells of the trails are safe, so that no step cuts a corner.
    pairs = KDTree(far.trails).query_pairs(1.8, output_type="ndarray")
    pairs = pairs[~_closed(far)[pairs].any(axis=1)]
    length = np.linalg.norm(far.trails[pairs[:, 0]] - far.trails[pairs[:, 1]], axis=1)
    num = len(far.trails)
    graph = coo_array((length, (pairs[:, 0], pairs[:, 1])), shape=(num, num)).tocsr()
    start = int(_nodes(far, here[None])[0])
    cost, previous = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    return cost * far.tiles.lattice.cell_size, previous


def _closed(far: Far) -> np.ndarray:
    """Finds the cells of the trails that lie in zones or in a costmap's obstacles, [n] bool."""
    lattice, is_closed = far.tiles.lattice, np.zeros(len(far.trails), bool)
    origin, size = np.array(lattice.origin), lattice.cell_size
    corners, edge = far.costs
    areas: list[tuple[np.ndarray, Callable[[OccupancyGrid], np.ndarray]]]
    areas = [(zone, functools.partial(columns_in, corners=zone)) for zone in far.zones]
    if len(corners):
        columns_of = functools.partial(pixel_columns, corners=corners, resolution=edge)
        areas.append((np.concatenate([corners, corners + edge]), columns_of))
    for points, columns_of in areas:
        low = np.floor((points.min(axis=0) - origin[:2]) / size).astype(np.int64)
        num = np.ceil((points.max(axis=0) - origin[:2]) / size).astype(np.int64) - low
        grid = OccupancyGrid(
            jnp.asarray(np.zeros((*num, 1), np.float32)),
            jnp.asarray(origin + np.append(low, 0) * size, jnp.float32),
            jnp.asarray(size, jnp.float32),
        )
        column = far.trails[:, :2] - low
        is_in = np.all((column >= 0) & (column < num), axis=1)
        is_closed[is_in] |= columns_of(grid)[tuple(column[is_in].T)]
    return is_closed


def _path_back(far: Far, previous: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Follows a path from here to there: its corners, [K, 3] [m]."""
    node = int(_nodes(far, there[None])[0])
    cells: list[np.ndarray] = []
    while node >= 0:
        cells.append(far.trails[node])
        node = int(previous[node])
    path = np.array(cells[::-1])
    turns = np.any(np.diff(path[1:], axis=0) != np.diff(path[:-1], axis=0), axis=1)
    path = path[np.r_[True, turns, True]] if len(path) > 2 else path
    lattice = far.tiles.lattice
    middle = np.array(lattice.origin) + (path + 0.5) * lattice.cell_size
    return np.concatenate([here[None], middle[1:-1], there[None]])


def columns_in(grid: OccupancyGrid, corners: np.ndarray) -> np.ndarray:
    """Finds the columns of cells that a polygon [k, 2] [m] overlaps, [X, Y] bool."""
    size, origin = float(grid.cell_size), np.asarray(grid.origin, np.float64)
    num = 4  # zones thinner than a quarter of a cell may be missed
    x, y = (
        origin[i] + size / num * (np.arange(num * grid.log_odds.shape[i]) + 0.5) for i in range(2)
    )
    inside = np.zeros((len(x), len(y)), bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if ay != by:  # the even-odd rule: each edge to the right of a point flips its state
            crosses = (ay > y) != (by > y)
            inside ^= crosses & (x[:, None] < ax + (y - ay) * (bx - ax) / (by - ay))
    return np.asarray(inside.reshape(len(x) // num, num, len(y) // num, num).any(axis=(1, 3)))


def pixel_columns(grid: OccupancyGrid, corners: np.ndarray, resolution: float) -> np.ndarray:
    """Finds the columns of cells, [X, Y] bool, that pixels overlap, by lower corners [k, 2] [m]."""
    columns = np.zeros(grid.log_odds.shape[:2], bool)
    size, low = float(grid.cell_size), np.asarray(grid.origin, np.float64)[:2]
    # Both edges of a pixel: every cell that it overlaps is closed.
    for offset in ((0.01, 0.01), (0.01, 0.99), (0.99, 0.01), (0.99, 0.99)):
        places = corners + resolution * np.array(offset)
        cells = np.floor((places - low) / size).astype(np.int64)
        cells = cells[np.all((cells >= 0) & (cells < columns.shape), axis=1)]
        columns[tuple(cells.T)] = True
    return columns


def far_arrays(far: Far) -> dict[str, np.ndarray]:
    """Lists all that is known of far places as arrays, to be stored."""
    arrays = {f"tiles.{name}": x for name, x in arrays_of(far.tiles).items()}
    arrays |= {"box": far.box, "border": np.array(far.border), "trails": far.trails,
               "refused": far.refused, "costs.corner": far.costs[0],
               "costs.edge": np.array(far.costs[1])}  # fmt: skip
    views = far.views
    arrays |= {"views.pose": views.pose, "views.place": views.place, "views.path": views.path}
    arrays |= {f"values.{name}": x for name, x in views.values.items()}
    return arrays | {f"zones.{i}": zone for i, zone in enumerate(far.zones)}


def far_of(arrays: Mapping[str, np.ndarray], config: MappingConfig, camera: Camera) -> Far:
    """Restores what `far_arrays` has listed.

    Raises:
        KeyError: an array is missing.
        ValueError: arrays that do not fit together.
    """
    under = lambda prefix: {
        name.removeprefix(prefix): x for name, x in arrays.items() if name.startswith(prefix)
    }
    empty = Tiles(lattice_for(config, camera, arrays["box"]), (0, 0, 0), config.capacity)
    zones = under("zones.")
    return Far(
        tiles=with_arrays(empty, under("tiles."), _KINDS),
        box=arrays["box"],
        border=float(arrays["border"]),
        views=Views(*(arrays[f"views.{name}"] for name in ("pose", "place", "path")),
                    values=under("values.")),
        trails=arrays["trails"],
        zones=tuple(zones[name] for name in sorted(zones, key=int)),
        costs=(arrays["costs.corner"], float(arrays["costs.edge"])),
        refused=arrays["refused"],
    )  # fmt: skip


def merged_far(fars: Sequence[Far], tiles: Tiles) -> Far:
    """Joins what several planners know of far places, round the first one's block.

    Args:
        fars: of planners with the same lattice.
        tiles: of all of them.
    """
    first = fars[0]
    return replace(
        first,
        tiles=tiles,
        views=functools.reduce(_joined, (far.views for far in fars)),
        trails=np.unique(np.concatenate([far.trails for far in fars]), axis=0),
        zones=tuple(zone for far in fars for zone in far.zones),
        refused=np.unique(np.concatenate([far.refused for far in fars]), axis=0),
    )
