"""Far places: tiles, goals there, and paths to them.

A planner that was started without bounds, or with `MappingConfig(tiles=True)`, holds a block of
tiles (`mapping.tiles`): policies draw and score in it as in a house, and depend on nothing else.
Goals lie so far within it that all that they may see is at hand. Two kinds of goals lie elsewhere:
views that were scored and not taken, and frontiers (`planning.far_paths`). Both are scored when
they leave the block, and nothing changes there until it comes back. Each decision weighs them
against the views on offer, with the lengths of the shortest paths through all tiles, as the policy
weighs. A robot that takes one goes to the place from which it can be seen; the next decision has
all of it at hand.

Shape symbols: n cells; m columns; v views; X Y Z cells at hand.
"""

import contextlib
import ctypes
import functools
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
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
    Layers,
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
from r3jax.planning.columns import Plane, cells_of, pixel_columns, polygon_columns
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import RECONSIDERED, GreedyPolicy, PlannerState, look_round
from r3jax.planning.far_paths import (
    Coarse,
    Lengths,
    cell_of,
    clearance_of,
    coarse_arrays,
    connected_within,
    known_cells,
    lengths_from,
    path_along,
    refreshed,
    with_closed,
    with_summaries,
)
from r3jax.planning.policy import Decision, LivesOutside, Policy
from r3jax.planning.robot.limits import Limits, angles_along, rotations

_ASIDE = ThreadPoolExecutor(1, thread_name_prefix="tiles")
"""The thread that scores what blocks leave behind, one block after the other: each one may wait for
the one before."""

_BLOCK = 1.0
"""Of views so close together [m] the best is kept."""

_RETURN = 1.0
"""A robot that stands at most this far from a cell that it has come through [m] came from there."""


_ARRIVED = 0.5
"""A robot at most this far from the goal that it went to [m] has arrived."""

_LIMITS = 30.0, np.inf
"""Paths are searched for up to these lengths in turn [m], until enough goals are found: a search
over a whole building takes ten times as long."""

_KINDS = {"log_odds": "<f4", "looks": "<i4", "memory": "|b1"}
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

    @property
    def position(self) -> np.ndarray:
        """Where the camera would be, [v, 3] [m]."""
        return self.pose[:, :3, 3]

    def take(self, which: np.ndarray) -> "Views":
        """Gathers views by index or mask."""
        values = {name: x[which] for name, x in self.values.items()}
        return Views(self.pose[which], self.place[which], self.path[which], values)


NO_VIEWS = Views(np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0), {})


def _joined(a: Views, b: Views) -> Views:
    """Joins views; numbers that only some of them have are 0 for the others."""
    if not len(a.path) or not len(b.path):
        return a if len(a.path) else b
    none = np.zeros(len(a.path)), np.zeros(len(b.path))
    names = dict.fromkeys([*a.values, *b.values])
    values = {
        name: np.concatenate([x.values.get(name, y) for x, y in zip((a, b), none, strict=True)])
        for name in names
    }
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

    coarse: Coarse
    """The graph of all open cells. Near tiles as of the latest decision."""

    views: Views = NO_VIEWS
    """Views left for later."""

    trails: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    """Cells that the robot has come through, counted from tile (0, 0, 0), [n, 3]."""

    columns: Mapping[int, np.ndarray] = field(default_factory=dict[int, np.ndarray])
    """Columns of cells that zones and a costmap close or vouch for, counted from tile (0, 0, 0),
    [k, 2] int64 each; by mark (`KEEP_OUT`, `COSTMAP`, `TRUSTED`)."""

    refused: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """Goals that could not be reached, and the radii round them, [k, 4] [m]."""

    goal: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    """Where the robot is going to, and the view that it seeks there, [0 or 1, 6] [m]."""

    tried: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Far goals at which the robot has arrived, [k, 3] [m]."""

    left: "Future[tuple[Coarse, Views]] | None" = None
    """What the block has left behind, while it is still computed: takes the place of `coarse` and
    `views` in `settled`."""

    @property
    def settled(self) -> "Far":
        """The same, when all that the block has left behind is computed."""
        if self.left is None:
            return self
        coarse, views = self.left.result()
        return replace(self, coarse=coarse, views=views, left=None)

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

    @property
    def plane(self) -> Plane:
        """The lattice of columns, counted from tile (0, 0, 0), within the box."""
        lattice = self.tiles.lattice
        return Plane(np.array(lattice.origin)[:2], lattice.cell_size, self.box_cells[:, :2])

    def grid(self, log_odds: np.ndarray) -> OccupancyGrid:
        """Makes the grid at hand of its cells: with the limits and marks that lie in it."""
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
        grid = grid.marked(~stops, REFUSED)
        for mark, columns in self.columns.items():
            cells = cells_of(columns - self.first_cell[:2], lattice.shape)
            grid = grid.marked(cells, mark)
        return grid


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
    capacity = max(capacity_for(lattice, config.voxel_size), config.capacity)
    scoring = getattr(getattr(policy, "config", None), "scoring", None)
    sees = config.max_range if scoring is None else float(scoring.max_range)
    border = sees + config.cell_size
    if border + config.cell_size > _least_half(lattice):
        raise InputError(
            f"the policy scores views up to {sees:g} m, but tiles at hand may end "
            f"{_least_half(lattice):g} m from the robot: give its scoring a shorter max_range"
        )
    return Far(Tiles(lattice, (x, y, z), capacity), box, border, Coarse(lattice))


def _least_half(lattice: Lattice) -> float:
    """Finds how far the block reaches at least, to each side of the robot [m]."""
    cut = lattice.edge[np.array(lattice.num) > 1]
    return float((ACROSS // 2) * cut.min() - HYSTERESIS) if len(cut) else np.inf


def check_policy(policy: Policy, policy_state: Any) -> None:
    """Refuses policies that keep their own picture of the map: it would not move with the tiles.

    Raises:
        ValueError: names the policy, and what to do.
    """
    kind, state = type(policy), policy_state
    is_plain = isinstance(state, PlannerState) and (
        not jax.tree.leaves(state.memory) or getattr(kind, "memory_by_cell", False)
    )
    weighs = getattr(kind, "weigh", None) is GreedyPolicy.weigh
    weighs |= getattr(kind, "weigh_far", None) is not GreedyPolicy.weigh_far
    if not is_plain or not weighs or isinstance(policy, LivesOutside):
        raise InputError(
            f"the policy {policy.name!r} has a memory or a measure of its own for the whole place, "
            "which cannot be cut into tiles: give finite bounds and no tiles, or use r3, r3-pano, "
            "r3-ahead or frontier"
        )


Known = tuple[MapState, OccupancyGrid, PlannerState, Far]
"""What a planner holds: rows, cells and a policy's memory at hand, and all else."""


def moved_to(known: Known, policy: GreedyPolicy, position: np.ndarray) -> Known:
    """Moves the block to a position [3] [m]; unchanged if that lies in its middle."""
    map_state, grid, memory, far = known
    if middle_for(far.tiles, position) == far.tiles.middle:
        return known
    after, layers, tiles = page(map_state, layers_of(grid, memory), far.tiles, position)
    # Takes seconds in a large block, and no frame needs it: the next decision may wait for it.
    left = _ASIDE.submit(_left_behind, known, policy, tiles.middle, position)
    _ASIDE.submit(_give_back_memory)
    far = replace(far, tiles=tiles, left=left)
    return after, far.grid(layers["log_odds"]), with_layers(memory, layers, far), far


def _left_behind(
    known: Known, policy: GreedyPolicy, middle: Tile, position: np.ndarray
) -> tuple[Coarse, Views]:
    """Computes the coarse level and the views that a block leaves behind; arguments: `_renewed`."""
    map_state, grid, memory, far = known
    far = with_coarse(far.settled, grid, memory, policy.config)
    # Before they are out of hand: what they promise stays true until the robot comes back.
    return far.coarse, _renewed((map_state, grid, memory, far), policy, middle, position)


def _give_back_memory() -> None:
    """Returns freed memory to the system, where glibc would keep it.

    A decision allocates and frees some hundred megabytes, and what lives on lies scattered between
    them: without this a process grows by half a gigabyte in a thousand frames. Takes 10 ms.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def layers_of(grid: OccupancyGrid, memory: PlannerState) -> Layers:
    """Lists what is kept of the cells at hand when they are paged out."""
    layers = {"log_odds": np.asarray(grid.log_odds), "looks": memory.looks}
    return layers if memory.memory is None else layers | {"memory": memory.memory}


def with_layers(memory: PlannerState, layers: Layers, far: Far) -> PlannerState:
    """Replaces what a policy remembers of cells by that of the cells at hand."""
    by_cell = layers.get("memory", memory.memory)
    return replace(memory, looks=layers["looks"], trail=far.trail, memory=by_cell)


def known_round(
    map_state: MapState, grid: OccupancyGrid, far: Far, position: np.ndarray
) -> tuple[MapState, OccupancyGrid]:
    """Returns the rows and the cells of the block round any position [3] [m]."""
    lattice = far.tiles.lattice
    layers = {name: np.zeros(lattice.shape, kind) for name, kind in _KINDS.items()}
    layers["log_odds"] = np.asarray(grid.log_odds)
    state, layers, tiles = page(map_state, layers, far.tiles, position)
    return state, replace(far, tiles=tiles).grid(layers["log_odds"])


def with_coarse(far: Far, grid: OccupancyGrid, memory: PlannerState, config: PlannerConfig) -> Far:
    """Brings the coarse level up to date with the cells at hand."""
    start = None if memory.start_height is None else float(memory.start_height)
    if start is not None and np.isnan(start):
        return far  # no decision yet: the robot's heights are not known
    lattice, size = far.tiles.lattice, np.array(far.tiles.lattice.cells)
    cells = known_cells(np.asarray(grid.log_odds), memory.looks, memory.memory)
    now: dict[Tile, np.ndarray] = {}
    for tile in lattice.block(far.tiles.middle):
        low = np.array(tile) * size - far.first_cell
        now[tile] = cells[tuple(slice(a, a + n) for a, n in zip(low, size, strict=True))]
    clearance = clearance_of(config, start)
    if far.coarse.tiles and far.coarse.clearance != clearance:  # a fork with another robot
        far = replace(far, coarse=replace(far.coarse, tiles={}, links={}))
    # Of a planner that was merged, or where zones have changed.
    for tile in far.tiles.cells.keys() - far.coarse.tiles.keys():
        layers = far.tiles.cells[tile]
        none = np.zeros(lattice.cells, np.float32)
        found = {name: unpacked_layer(x, lattice.cells) for name, x in layers.items()}
        now[tile] = known_cells(
            found.get("log_odds", none), found.get("looks", none), found.get("memory")
        )
    return replace(far, coarse=refreshed(far.coarse, now, far.trails, clearance, far.box))


def _at_hand(far: Far, positions: np.ndarray, middle: Tile) -> np.ndarray:
    """Finds which positions [v, 3] goals may have in the block round a tile, [v] bool."""
    lattice = far.tiles.lattice
    low = lattice.corner(middle)
    is_in = (positions > low + far.border) & (positions < low + lattice.size - far.border)
    return np.all(is_in | (np.array(lattice.num) == 1), axis=1)


def _renewed(known: Known, policy: GreedyPolicy, middle: Tile, position: np.ndarray) -> Views:
    """Scores views and frontiers that are at hand, and will not be round another tile.

    Args:
        known: before the block moves.
        policy: which scores.
        middle: where the block moves to.
        position: of the robot, [3] [m].
    """
    map_state, grid, memory, far = known
    most, views = policy.config.num_candidates, far.views
    after = functools.partial(_at_hand, far, middle=middle)
    leaves = _at_hand(far, views.position, far.tiles.middle) & ~after(views.position)
    old = views.take(np.flatnonzero(leaves)[:most])
    kept = views.take(~leaves) if len(old.path) else views
    goals = _frontier_goals(far, policy)
    is_new = _in_block(far, goals.place) & ~after(goals.place)
    goals = goals.take(np.flatnonzero(is_new)[: most - len(old.path)])
    both = _joined(old, goals)
    if not len(both.path):
        return views
    here, lattice = np.eye(4), far.tiles.lattice
    center = lattice.corner(far.tiles.middle) + 0.5 * lattice.size
    if len(old.path) or not _in_block(far, position[None])[0]:
        position = both.place[np.argmin(np.linalg.norm(both.place - center, axis=1))]
    here[:3, 3] = position
    try:
        _, situation = look_round(memory, map_state, grid, here, policy.config)
    except InputError:  # that place lies out of the heights that are allowed now
        return kept
    parts: list[Views] = []
    for i in range(0, len(both.path), RECONSIDERED):
        some = both.take(np.arange(i, min(i + RECONSIDERED, len(both.path))))
        offered = candidates_along(some.position, some.pose[:, :3, 2]).padded(RECONSIDERED)
        scored, values = policy.score(situation, offered, key=jax.random.key(0))
        if "utility" not in values:
            return views
        num = len(some.path)
        renewed = {name: np.asarray(x)[:num] for name, x in values.items()}
        fresh = Views(scored.T_world_camera[:num], some.place, some.path, renewed)
        parts.append(fresh.take(scored.valid[:num] & (renewed["utility"] > 0.0)))
    return functools.reduce(_joined, parts, kept)


def _in_block(far: Far, positions: np.ndarray) -> np.ndarray:
    """Finds which positions [v, 3] lie in the block at hand, [v] bool."""
    cells = cell_of(far.tiles.lattice, positions) - far.first_cell
    return np.all((cells >= 0) & (cells < far.tiles.lattice.shape), axis=1)


def _frontier_goals(far: Far, policy: GreedyPolicy) -> Views:
    """Lists places that see a frontier, where no view was scored and the robot has not gone to.

    Their utility is that of as many unexplored cells as there are frontier cells: less than a view
    would show.
    """
    lattice, goals, motion = far.tiles.lattice, far.coarse.goals, policy.config.motion
    center = lambda cells: np.array(lattice.origin) + (cells + 0.5) * lattice.cell_size
    place = center(goals.place)
    place[:, 2] = np.clip(place[:, 2], *far.coarse.clearance.heights)
    is_new = ~_are_near(place, far.tried) & ~_are_near(place, far.views.position)
    place, aim = place[is_new], center(goals.aim)[is_new]
    pose = np.tile(np.eye(4), (len(place), 1, 1))
    pose[:, :3, 3] = place
    pose[:, :3, :3] = rotations(*Limits(motion).clipped(*angles_along(aim - place)))
    utility = float(policy.config.scoring.lambda1) * goals.num[is_new]
    values = {"utility": utility, "exploration": utility}
    return Views(pose, place, np.zeros(len(place)), values)


def _are_near(places: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Finds places [v, 3] within `_BLOCK` of others [k, 3], [v] bool."""
    from scipy.spatial import KDTree

    if not len(places) or not len(others):
        return np.zeros(len(places), bool)
    gap, _ = KDTree(others).query(places, distance_upper_bound=_BLOCK)
    return np.isfinite(gap)


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
    """Weighs far goals against a decision; returns the better one.

    Args:
        far: record of far places, with a coarse level that is up to date.
        policy: which weighs.
        decision: decision within the block; None if there is no goal.
        T_here: pose of the robot, [4, 4].
    """
    here = T_here[:3, 3]
    views, lengths = _goals_by_path(far, policy, here)
    if lengths is None:
        return decision, far
    near = {} if decision is None else decision.utilities
    values = dict(views.values) | {"path": views.path}
    num = 0 if decision is None else len(decision.candidates)
    is_reached = np.isfinite(np.concatenate([near["path"] if near else [], views.path]))
    total = np.where(is_reached, policy.weigh_far(near, values), -np.inf)
    best = int(np.argmax(total))
    if best < num:
        return decision, far
    pose, place = views.pose[best - num].copy(), views.place[best - num]
    goal = np.concatenate([place, pose[:3, 3]])[None]
    pose[:3, 3] = place
    waypoints = path_along(far.coarse, lengths, here, place)
    poses = views.pose if decision is None else np.concatenate([decision.candidates, views.pose])
    poses = np.array(poses)
    poses[best] = pose
    if near:
        none = np.zeros(len(views.path))
        values = {name: np.concatenate([x, values.get(name, none)]) for name, x in near.items()}
    walk = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    seconds = Limits(policy.config.motion, T_here).seconds(walk, pose[:3, 2])
    taken = Decision(pose, waypoints, walk, float(total[best]), poses,
                     values | {"total": total}, seconds)  # fmt: skip
    return taken, replace(far, goal=goal)


def _goals_by_path(
    far: Far, policy: GreedyPolicy, here: np.ndarray
) -> tuple[Views, Lengths | None]:
    """Finds the nearest goals that are not at hand, or to which no path within the block leads.

    Returns:
        Goals, with whole paths; and the paths to all places, None without a goal.
    """
    lattice, coarse = far.tiles.lattice, far.coarse
    views = _joined(far.views, _frontier_goals(far, policy))
    if not len(views.path):
        return NO_VIEWS, None
    start, cells = cell_of(lattice, here), cell_of(lattice, views.place)
    is_far = ~_at_hand(far, views.position, far.tiles.middle)
    inside = np.flatnonzero(~is_far)
    block = lattice.block(far.tiles.middle)
    is_far[inside] = ~connected_within(coarse, block, start, cells[inside])
    for goal in far.refused:
        is_far &= np.linalg.norm(views.place - goal[:3], axis=1) > goal[3]
    views, cells = views.take(is_far), cells[is_far]
    if not len(views.path):
        return NO_VIEWS, None
    node, steps = coarse.nodes(cells)
    most, size = max(policy.config.num_frontier, 1), lattice.cell_size
    lengths, path, nearest = None, views.path, np.arange(0)
    for limit in _LIMITS:
        lengths = lengths_from(coarse, start, limit / size)
        if lengths is None:
            return NO_VIEWS, None
        path = np.where(node < 0, np.inf, lengths.cost[node] + steps) * size + views.path
        nearest = np.argsort(path, kind="stable")[:most]
        if len(nearest) == most and path[nearest[-1]] <= limit:
            break
    nearest = nearest[np.isfinite(path[nearest])]
    views = views.take(nearest)._replace(path=path[nearest])
    return views, lengths if len(nearest) else None


def arrived(far: Far, here: np.ndarray) -> Far:
    """Records the robot's own place.

    It joins the trails, with the line to the nearest cell of them if that is near. A goal at which
    the robot has arrived is none any more: views of it are drawn again.
    """
    if len(far.goal) and np.linalg.norm(far.goal[0, :3] - here) <= _ARRIVED:
        place, views = far.goal[:, :3], far.views
        sought = np.concatenate([views.place, views.position], axis=1)
        is_left = np.any(np.abs(sought - far.goal) > 1e-6, axis=1)
        tried = np.concatenate([far.tried, place])
        far = replace(far, views=views.take(is_left), tried=tried, goal=far.goal[:0])
    lattice = far.tiles.lattice
    cell = cell_of(lattice, here)
    cells = [cell]
    if len(far.trails):
        gap = np.linalg.norm(far.trails - cell, axis=1)
        nearest = int(np.argmin(gap))
        if gap[nearest] == 0.0:
            return far
        if gap[nearest] * lattice.cell_size <= _RETURN:
            # Over faces, as all paths are.
            for axis in range(3):
                while cells[-1][axis] != far.trails[nearest][axis]:
                    step = np.zeros(3, np.int64)
                    step[axis] = np.sign(far.trails[nearest][axis] - cells[-1][axis])
                    cells.append(cells[-1] + step)
            cells.pop()  # the nearest is on them already
    return replace(far, trails=np.concatenate([far.trails, np.array(cells)]))


def with_columns(far: Far, columns: Mapping[int, np.ndarray]) -> Far:
    """Replaces the columns of some marks, and closes theirs on the coarse level."""
    far, columns = far.settled, {**far.columns, **columns}
    none = np.zeros((0, 2), np.int64)
    closed = np.concatenate([columns.get(mark, none) for mark in (KEEP_OUT, COSTMAP)])
    return replace(far, columns=columns, coarse=with_closed(far.coarse, closed))


def far_arrays(far: Far) -> dict[str, np.ndarray]:
    """Lists all that is known of far places as arrays, to be stored."""
    far = far.settled
    arrays = {f"tiles.{name}": x for name, x in arrays_of(far.tiles).items()}
    arrays |= {"box": far.box, "border": np.array(far.border), "trails": far.trails,
               "refused": far.refused, "goal": far.goal, "tried": far.tried}  # fmt: skip
    views = far.views
    arrays |= {"views.pose": views.pose, "views.place": views.place, "views.path": views.path}
    arrays |= {f"values.{name}": x for name, x in views.values.items()}
    arrays |= {f"coarse.{name}": x for name, x in coarse_arrays(far.coarse).items()}
    return arrays | {f"columns.{mark}": x for mark, x in far.columns.items()}


def far_of(arrays: Mapping[str, np.ndarray], config: MappingConfig, camera: Camera) -> Far:
    """Restores what `far_arrays` has listed.

    Raises:
        KeyError: an array is missing.
        ValueError: arrays that do not fit together.
    """
    under = lambda prefix: {
        name.removeprefix(prefix): x for name, x in arrays.items() if name.startswith(prefix)
    }
    lattice = lattice_for(config, camera, arrays["box"])
    far = Far(
        tiles=with_arrays(Tiles(lattice, (0, 0, 0), config.capacity), under("tiles."), _KINDS),
        box=arrays["box"],
        border=float(arrays["border"]),
        coarse=Coarse(lattice),
        views=Views(*(arrays[f"views.{name}"] for name in ("pose", "place", "path")),
                    values=under("values.")),
        trails=arrays["trails"],
        refused=arrays["refused"],
    )  # fmt: skip
    if "goal" in arrays:  # not in planners saved by earlier versions
        far = replace(far, goal=arrays["goal"], tried=arrays["tried"])
    columns = {int(mark): x for mark, x in under("columns.").items()}
    far = with_columns(far, columns | _earlier_columns(far, arrays, under("zones.").values()))
    if "coarse.tile" not in arrays:  # filled with the next decision
        return far
    return replace(far, coarse=with_summaries(far.coarse, under("coarse.")))


def _earlier_columns(
    far: Far, arrays: Mapping[str, np.ndarray], zones: Iterable[np.ndarray]
) -> dict[int, np.ndarray]:
    """Finds the columns that a planner saved by an earlier version has as polygons and pixels."""
    if "costs.corner" not in arrays:
        return {}
    pixels = lambda name: (
        pixel_columns(far.plane, arrays[f"{name}.corner"], float(arrays[f"{name}.edge"]))
        if f"{name}.corner" in arrays
        else np.zeros((0, 2), np.int64)
    )
    kept_out = [pixels("mask"), *(polygon_columns(far.plane, zone) for zone in zones)]
    return {KEEP_OUT: np.concatenate(kept_out), COSTMAP: pixels("costs")}


def merged_far(fars: Sequence[Far], tiles: Tiles) -> Far:
    """Joins what several planners know of far places, round the first one's block.

    Args:
        fars: of planners with the same lattice.
        tiles: of all of them.
    """
    fars = [far.settled for far in fars]
    first = fars[0]
    merged = replace(
        first,
        tiles=tiles,
        views=functools.reduce(_joined, (far.views for far in fars)),
        trails=np.unique(np.concatenate([far.trails for far in fars]), axis=0),
        refused=np.unique(np.concatenate([far.refused for far in fars]), axis=0),
        tried=np.concatenate([far.tried for far in fars]),
        coarse=Coarse(first.tiles.lattice),  # filled with the next decision
    )
    none = np.zeros((0, 2), np.int64)
    kept_out = np.concatenate([far.columns.get(KEEP_OUT, none) for far in fars])
    return with_columns(merged, {KEEP_OUT: np.unique(kept_out, axis=0)})
