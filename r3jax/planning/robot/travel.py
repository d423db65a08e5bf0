"""Path lengths and waypoints through known free space. On the host: NumPy and Numba.

A cell is *safe* if the ball of the safety margin round its center touches known free cells only;
unknown space is an obstacle. With 0.2 m cells and 0.3 m margin these are the cells whose 26
neighbors are free, so that every point of a path keeps at least one cell's width from anything that
is not known to be free. The robot's own cell is always usable.

For a robot with a footprint (`body.Body`) a cell is safe if the footprint fits somewhere in it, by
the plan that `room.room_for` draws. Paths and straight lines are then checked on that plan.

Paths run over the 26-connected graph of usable cells. A diagonal step needs every cell of the
block it crosses, so that it cannot squeeze between two corners. `skimage.graph.MCP_Geometric`
cannot express that rule (tests compare the two), and SciPy's Dijkstra, for which the graph would
have to be spelled out, takes five to nine times as long.

Shape symbols: X Y Z cells along the axes; n cells or points; K waypoints.
"""

import functools
import itertools
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from r3jax.errors import InputError
from r3jax.kernels.robot.shortest_paths import shortest_paths
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.robot.motion import UNLIMITED, check_height
from r3jax.planning.robot.room import Room

_INSET = 1e-2
"""A camera at a fixed height on the border of layers is moved by this distance into its own layer
[cells], so that the next layer does not count."""

NEW_PLACE = 1.0
"""A place this far from all others [m] is a new one."""

_TOUCH = 1e-3
"""Tolerance [cells]: a height this close to a border of layers belongs to the upper layer, and a
body this close to a surface touches it."""


@dataclass(frozen=True)
class Travel:
    """Reachable space from one position, with path lengths and paths. Made by `plan_travel`."""

    start: np.ndarray
    """The robot's position, [3] float64 [m]."""

    start_cell: tuple[int, int, int]
    """The cell that holds it."""

    origin: np.ndarray
    """Lower corner of cell (0, 0, 0), [3] float64 [m]."""

    cell_size: float
    """Edge of a cell [m]."""

    free: np.ndarray
    """Cells known to be free, [X, Y, Z] bool."""

    safe: np.ndarray
    """Cells that keep the margin and in which the robot may be, [X, Y, Z] bool."""

    usable: np.ndarray
    """Cells that paths may cross: safe cells and the robot's own, [X, Y, Z] bool."""

    cost: np.ndarray
    """Length of the shortest way between the centers of the robot's cell and of each cell [m],
    [X, Y, Z] float64; inf where there is none."""

    previous: np.ndarray
    """Flat index of the cell before each on that way, [X, Y, Z] int64; -1 at its start. Empty
    where the room has the paths."""

    heights: tuple[float, float] = UNLIMITED
    """Lowest and highest place of the camera [m]: all waypoints lie between them."""

    refused: np.ndarray | None = None
    """Cells round goals that could not be reached, [X, Y, Z] bool; None: there are none."""

    room: Room | None = None
    """The plan in which a footprint moves; None: a sphere, for which `usable` is all there is."""

    fresh: np.ndarray | None = None
    """Columns of cells that are `NEW_PLACE` from wherever a footprint has been, round obstacles,
    [X, Y] bool; None: it does not matter."""

    def is_fresh(self, positions: np.ndarray) -> np.ndarray:
        """Checks if positions [n, 3] [m] lie in columns where the robot has not been, [n] bool."""
        if self.fresh is None:
            return np.ones(len(positions), bool)
        cells = np.floor((positions[:, :2] - self.origin[:2]) / self.cell_size).astype(np.int64)
        x, y = np.clip(cells, 0, np.array(self.fresh.shape) - 1).T
        return self.fresh[x, y]

    @functools.cached_property
    def reachable(self) -> np.ndarray:
        """Cells to which a way leads, [X, Y, Z] bool."""
        return np.isfinite(self.cost)

    @functools.cached_property
    def goals(self) -> np.ndarray:
        """Cells where the robot may stop: safe and reachable, and its own if that is free."""
        goals = self.reachable & self.safe
        if self.contains(self.start_cell) and self.free[self.start_cell]:
            goals[self.start_cell] = True
        if self.refused is not None:
            goals = goals & ~self.refused
        return goals

    def contains(self, cell: tuple[int, int, int]) -> bool:
        """Returns True if the grid has that cell."""
        return all(0 <= i < n for i, n in zip(cell, self.usable.shape, strict=True))

    def cell_of(self, position: np.ndarray) -> tuple[int, int, int]:
        """Finds the cell that holds a position [m]; it may lie outside the grid."""
        # float64 throughout: in float32 points on a border could be in either cell.
        x, y, z = np.floor((np.asarray(position, np.float64) - self.origin) / self.cell_size)
        return int(x), int(y), int(z)

    def centers(self, cells: np.ndarray) -> np.ndarray:
        """Computes the centers [m] of cells given by index, [n, 3]."""
        return self.origin + (np.asarray(cells) + 0.5) * self.cell_size

    def stops(self, cells: np.ndarray) -> np.ndarray:
        """Computes the stop positions in cells given by index, [n, 3] [m], at allowed heights."""
        places = self.centers(cells)
        if self.room is not None:
            x, y = np.moveaxis(np.asarray(cells)[..., :2], -1, 0)
            stop = self.room.stop[x, y]
            # Pixel 0 replaces missing stops, and is not used.
            middles = self.room.places(np.asarray(np.maximum(stop, 0)))
            places[..., :2] = np.where((stop >= 0)[..., None], middles, places[..., :2])
        places[..., 2] = np.clip(places[..., 2], *self.heights)
        return places

    def distance(self, cell: np.ndarray | tuple[int, int, int]) -> float:
        """Computes the length of the path from the robot to its stop in a cell [m].

        It is inf if there is no path.
        """
        x, y, z = (int(i) for i in np.asarray(cell))
        if not self.contains((x, y, z)):
            return float("inf")
        first = self.stops(np.array(self.start_cell))
        return float(np.linalg.norm(first - self.start) + self.cost[x, y, z])

    def lengths(self, positions: np.ndarray) -> np.ndarray:
        """Computes path lengths [m] to positions [n, 3]; inf without a path.

        The straight line if it is safe, else the path over the cells' centers, an upper bound of
        the length of `path`.
        """
        cells = np.floor((positions - self.origin) / self.cell_size).astype(np.int64)
        is_inside = np.all((cells >= 0) & (cells < self.usable.shape), axis=1)
        # Positions outside use cell 0: a negative index would read from the far side.
        cells = np.where(is_inside[:, None], cells, 0)
        x, y, z = cells.T
        from_start = np.linalg.norm(self.stops(np.array(self.start_cell)) - self.start)
        if self.room is not None:
            from_start = 0.0  # the search began at the robot, not at the center of its cell
        last = np.linalg.norm(positions - self.stops(cells), axis=1)
        lengths = np.where(is_inside, from_start + self.cost[x, y, z] + last, np.inf)
        if self.room is not None:
            # A footprint that fits somewhere in a cell may not fit everywhere.
            stops = self.stops(cells)
            for i in np.flatnonzero(np.isfinite(lengths)):
                if not self.room.fits_along(stops[i], positions[i : i + 1])[0]:
                    lengths[i] = np.inf
            # Turning in place has no path.
            lengths[np.linalg.norm(positions - self.start, axis=1) < 1e-6] = 0.0
        # The straight line if it is safe: the shortest path, which `path` also takes.
        near = np.flatnonzero(np.isfinite(lengths))
        straight = near[self.in_reach(self.start, positions[near])]
        lengths[straight] = np.linalg.norm(positions[straight] - self.start, axis=1)
        return lengths

    def path(self, position: np.ndarray) -> np.ndarray:
        """Plans waypoints [K, 3] [m] from the robot to a position; all of the path is safe.

        Raises:
            ValueError: there is no path; check `lengths` first.
        """
        goal = np.asarray(position, dtype=np.float64)
        cell = self.cell_of(goal)
        if not (self.contains(cell) and self.reachable[cell]):
            raise InputError(f"no safe path leads from {self.start} to {goal} (cell {cell})")
        if self.room is not None:
            # It turns on the spot, or drives straight where its own cell has no room to spare.
            is_here = np.linalg.norm(goal - self.start) < 1e-6 or self.room.stop[cell[:2]] < 0
            middle = np.zeros((0, 2)) if is_here else self.room.path(cell[:2])[1:]
            middle = np.column_stack([middle, np.full(len(middle), goal[2])])
            return self._shortcut(np.concatenate([self.start[None], middle, goal[None]]))
        # From the goal back to the robot: each cell stores the one before it.
        way = [int(np.ravel_multi_index(cell, self.usable.shape))]
        previous = self.previous.reshape(-1)
        while previous[way[-1]] >= 0:
            way.append(int(previous[way[-1]]))
        cells = np.stack(np.unravel_index(way[::-1], self.usable.shape), axis=1)
        return self._shortcut(np.concatenate([self.start[None], self.stops(cells), goal[None]]))

    def cells_along(self, waypoints: np.ndarray) -> np.ndarray:
        """Finds the cells that the path over waypoints [K, 3] [m] crosses, [X, Y, Z] bool."""
        from r3jax.kernels.robot.cells import segment_cells

        swept = np.zeros(self.usable.shape, dtype=bool)
        for a, b in itertools.pairwise(waypoints):
            cells = segment_cells(*self._in_cells(a, b))
            # Cells that a line only touches may lie outside the grid.
            cells = cells[np.all((cells >= 0) & (cells < swept.shape), axis=1)]
            swept[tuple(cells.T)] = True
        return swept

    def _shortcut(self, points: np.ndarray) -> np.ndarray:
        """Removes waypoints if the straight line past them is safe."""
        last = len(points) - 1
        kept = [0]
        while kept[-1] < last:
            here = kept[-1]
            # The goal first: most paths in a room end with a straight line.
            if self._sees(points[here], points[last]):
                kept.append(last)
                break
            # Greedy from the front: each leg goes as far along the cells as it safely can.
            ahead = here + 1  # neighbors on the way always see each other
            while ahead + 1 < last and self._sees(points[here], points[ahead + 1]):
                ahead += 1
            kept.append(ahead)
        return points[kept]

    def in_reach(self, a: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Checks if straight lines from `a` [3] to ends [n, 3] [m] are safe, [n] bool."""
        from r3jax.kernels.robot.cells import segments_are_inside

        if self.room is not None:
            return self.room.fits_along(a, ends)
        return segments_are_inside(self.usable, self.scaled(a), self.scaled(ends))

    def _sees(self, a: np.ndarray, b: np.ndarray) -> bool:
        return bool(self.in_reach(a, b[None])[0])

    def _in_cells(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.scaled(a), self.scaled(b)

    def scaled(self, positions: np.ndarray) -> np.ndarray:
        """Converts positions [..., 3] to cells, kept off the borders of the allowed layers."""
        scaled = (positions - self.origin) / self.cell_size
        if self.heights != UNLIMITED:
            num = self.usable.shape[2]
            first, last = layers_between(self.heights, self.origin[2], self.cell_size, num)
            scaled[..., 2] = np.clip(scaled[..., 2], first + _INSET, last + 1.0 - _INSET)
        return scaled


def plan_travel(
    grid: OccupancyGrid,
    position: np.ndarray,
    safety_margin: float = 0.3,
    trail: np.ndarray | None = None,
    heights: tuple[float, float] = UNLIMITED,
    body: float = 0.0,
    room: Room | None = None,
) -> Travel:
    """Plans shortest paths from a position to all safe cells. Called once per decision.

    Args:
        grid: what is known.
        position: the robot's position in the world [m]. Outside the grid nothing is reachable.
        safety_margin: radius of the ball that must be known free [m].
        trail: cells that the robot has come through, [X, Y, Z] bool. If its present cell is not
            safe (a later frame showed an obstacle in the margin), it may return through them unless
            they are occupied; otherwise they have no effect.
        heights: lowest and highest camera position [m], world.
        body: length of the robot below the camera [m] (`cells_over_matter`).
        room: plan of a robot with a footprint, which replaces `safety_margin` and `body`.

    Raises:
        ValueError: a position that is not finite, or not at an allowed height.
    """
    # Copied to the host once per decision, for lookups of single cells.
    free = np.array(grid.free)
    cell_size = float(grid.cell_size)
    origin = np.asarray(grid.origin, dtype=np.float64)
    start = np.asarray(position, dtype=np.float64)
    if start.shape != (3,) or not np.all(np.isfinite(start)):
        raise InputError(f"the position must be three finite numbers [m], got {start}")
    check_height(float(start[2]), heights)
    if room is None:
        occupied = np.asarray(grid.occupied) if body > 0.0 else None
        safe = cells_for_ball(free, occupied, origin[2], cell_size, safety_margin, heights, body)
    else:
        safe = np.repeat(room.columns[:, :, None], free.shape[2], axis=2)
        _close_layers(safe, heights, origin[2], cell_size)
    if grid.closed is not None:
        safe &= ~grid.closed
    cell = tuple(int(i) for i in np.floor((start - origin) / cell_size))
    is_inside = all(0 <= i < n for i, n in zip(cell, free.shape, strict=True))
    usable = safe
    if room is not None:
        # Already searched on the plan; all open layers have the same paths.
        cost = np.where(safe, room.cost[:, :, None], np.inf)
        if is_inside:
            cost[cell] = 0.0
        usable, previous = safe | (cost == 0.0), np.zeros(0, np.int64)
        return Travel(start, (cell[0], cell[1], cell[2]), origin, cell_size, free, safe, usable,
                      cost, previous, heights, grid.refused, room)  # fmt: skip
    if is_inside and not safe[cell]:
        # Only a robot that is shut in gets more cells, and only those that it has passed.
        usable = safe.copy()
        if trail is not None:
            usable |= trail & ~np.asarray(grid.occupied)
        usable[cell] = True
    cost, previous = shortest_paths(usable, (cell[0], cell[1], cell[2]) if is_inside else None)
    return Travel(
        start=start,
        start_cell=(cell[0], cell[1], cell[2]),
        origin=origin,
        cell_size=cell_size,
        free=free,
        safe=safe,
        usable=usable,
        # The search counts in cells; from here on lengths are in meters.
        cost=cost * cell_size,
        previous=previous,
        heights=heights,
        refused=grid.refused,
    )


def fresh_columns(travel: Travel, trail: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Finds columns farther than `NEW_PLACE` from those where the robot has been, round obstacles.

    Args:
        travel: where it can go.
        trail: cells that it has come through, [X, Y, Z] bool.
        places: where it has stood, [V, 2] [m].

    Returns:
        [X, Y] bool.
    """
    is_open, near = np.any(travel.reachable, axis=2), np.any(trail, axis=2)
    cells = np.floor((places - travel.origin[:2]) / travel.cell_size).astype(np.int64)
    near[tuple(np.clip(cells, 0, np.array(near.shape) - 1).T)] = True
    near &= is_open
    for i in range(round(NEW_PLACE / travel.cell_size / 0.85)):  # crosses and squares in turn
        square = np.ones((3, 3), bool) if i % 2 else None
        near = np.asarray(ndimage.binary_dilation(near, square, mask=is_open), bool)
    return is_open & ~near


def cells_for_ball(
    free: np.ndarray,
    occupied: np.ndarray | None,
    origin: float,
    cell_size: float,
    margin: float,
    heights: tuple[float, float] = UNLIMITED,
    body: float = 0.0,
) -> np.ndarray:
    """Finds cells in which a flying camera may be: `safe_cells` within its heights.

    Args:
        free: cells known to be free, [X, Y, Z] bool.
        occupied: cells known to be occupied, [X, Y, Z] bool; only read if there is a body.
        origin: height of the lowest cell's lower face [m].
        cell_size: edge of a cell [m].
        margin: radius of the ball that must be free [m].
        heights: lowest and highest camera position [m].
        body: length of the robot below the camera [m] (`cells_over_matter`).
    """
    safe = safe_cells(free, cell_size, margin)
    _close_layers(safe, heights, origin, cell_size)
    if body > 0.0 and occupied is not None:
        safe &= ~cells_over_matter(occupied, body, margin, heights, origin, cell_size)
    return safe


def _close_layers(
    safe: np.ndarray, heights: tuple[float, float], origin: float, cell_size: float
) -> None:
    """Closes the layers of cells out of a range of heights, in place."""
    if heights != UNLIMITED:
        first, last = layers_between(heights, origin, cell_size, safe.shape[2])
        # Closed layers, not clipped paths: the search itself must stay within the heights.
        safe[:, :, : max(first, 0)] = False
        safe[:, :, last + 1 :] = False


def safe_cells(free: np.ndarray, cell_size: float, margin: float) -> np.ndarray:
    """Finds cells around whose center a ball of radius `margin` [m] touches only free cells.

    Args:
        free: cells known to be free, [X, Y, Z] bool; cells beyond the array are not.
        cell_size: edge of a cell [m].
        margin: radius of the ball [m].
    """
    # Cells farther away than this cannot touch the ball.
    reach = max(0, int(np.ceil(margin / cell_size + 0.5)) - 1)
    # Beyond the array nothing is known to be free: zeros close the border.
    padded = np.pad(free, reach)
    safe = free.copy()
    for offset in itertools.product(range(-reach, reach + 1), repeat=3):
        gap = np.maximum(np.abs(offset) - 0.5, 0.0) * cell_size
        # Touching is not overlapping: with 0.2 m cells, 0.3 m ends where the next cell begins.
        if np.linalg.norm(gap) < margin - 1e-6:
            window = tuple(
                slice(reach + o, reach + o + n) for o, n in zip(offset, free.shape, strict=True)
            )
            safe &= padded[window]
    return safe


def segment_is_inside(mask: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Checks whether a segment lies in cells of the mask only, touched corners included.

    Args:
        mask: [X, Y, Z] bool; beyond the array nothing is in the mask.
        a: one end, in cells (cell (0, 0, 0) spans 0 to 1), [3].
        b: the other end.
    """
    # Lazy import: Numba is only loaded when a path is planned.
    from r3jax.kernels.robot.cells import segments_are_inside

    return bool(segments_are_inside(mask, a, b[None])[0])


def layers_between(
    heights: tuple[float, float], origin: float, cell_size: float, num: int
) -> tuple[int, int]:
    """Finds the first and the last layer of cells with heights [m] in a range.

    Args:
        heights: lowest and highest, either may be infinite.
        origin: height of the lowest cell's lower face [m].
        cell_size: edge of a cell [m].
        num: number of layers.
    """
    # Clipped before they become integers: heights may be infinite.
    low, high = np.clip((np.array(heights) - origin) / cell_size, -1.0, float(num))
    return int(np.floor(low)), int(np.floor(high))


def cells_over_matter(
    occupied: np.ndarray,
    body: float,
    margin: float,
    heights: tuple[float, float],
    origin: float,
    cell_size: float,
) -> np.ndarray:
    """Finds cells in which the body below the camera would overlap occupied cells.

    The body is a cylinder below the camera, as wide as the safety margin; of a cell the lowest
    allowed height counts. Unknown cells are open: a camera that looks ahead never sees the floor at
    the robot's wheels.

    Args:
        occupied: cells known to be occupied, [X, Y, Z] bool.
        body: its length downwards [m]; 0: none.
        margin: its radius around the center of a cell [m].
        heights: the camera's lowest and highest height [m].
        origin: height of the lowest cell's lower face [m].
        cell_size: edge of a cell [m].

    Returns:
        [X, Y, Z] bool.
    """
    closed = np.zeros(occupied.shape, dtype=bool)
    if body == 0.0:
        return closed
    # Widened once for all layers: the body is as wide at every height.
    wide = _widened(occupied, margin / cell_size)
    first, last = layers_between(heights, origin, cell_size, occupied.shape[2])
    for layer in range(max(first, 0), min(last, occupied.shape[2] - 1) + 1):
        lowest = max(origin + layer * cell_size, heights[0])
        # The lowest allowed height of the layer is the worst case for obstacles below.
        foot = (lowest - body - origin) / cell_size
        below = max(0, int(np.floor(max(foot, -1.0) + _TOUCH)))
        # Up to the layer below: the margin covers the camera's own layer.
        closed[:, :, layer] = wide[:, :, below:layer].any(axis=2)
    return closed


def _widened(mask: np.ndarray, radius: float) -> np.ndarray:
    """Dilates a mask by a level disk of `radius` [cells] around the center of each cell."""
    reach = int(np.ceil(radius + 0.5)) - 1
    padded = np.pad(mask, ((reach, reach), (reach, reach), (0, 0)))
    wide = mask.copy()
    for x, y in itertools.product(range(-reach, reach + 1), repeat=2):
        gap = np.hypot(max(abs(x) - 0.5, 0.0), max(abs(y) - 0.5, 0.0))
        if gap < radius - _TOUCH:  # touching is not overlapping
            wide |= padded[
                reach + x : reach + x + mask.shape[0], reach + y : reach + y + mask.shape[1]
            ]
    return wide
