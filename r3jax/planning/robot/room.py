"""Finds where a body fits: a floor plan for a robot, a drone or a person.

A *sphere* round a flying camera must touch known free cells only (`travel.safe_cells`). A
*footprint* stands on the floor and reaches up to some height; for it `room_for` makes a plan from
above, like Nav2's obstacle layer, and computes the distance of each point to all obstacles:

- voxels of the map between a step above the floor and the top of the body. The floor is traced
  outwards from the robot, so that ramps and a noisy floor are not obstacles;
- occupied cells of the grid in which the map has no voxel (thin things, whose pixels lie on edges);
- keep-out zones and the obstacles of a costmap (`OccupancyGrid.closed`);
- what is not known. A column of cells is known if all that the body takes up of it is free, a
  pixel of it also if the floor was seen there: the voxels say what stands beside it. A voxel says
  nothing of the rest of its cell: behind the seen side of a wall is its other side. Where the robot
  has stood and driven is known, too, and what a trusted costmap holds for free.

Cells below the camera that it cannot see count as `unknown_below` says.

On the host: NumPy and SciPy. Shape symbols: X Y Z cells; x y pixels of the plan; n points.
"""

import functools
import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from r3jax.geometry.cameras import Camera
from r3jax.kernels.robot.shortest_paths import shortest_paths
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.robot.body import Body

PIXELS_PER_CELL = 4
"""Pixels of the plan per cell and axis; a pixel is 5 cm wide."""

_FLOOR_WITHIN = 3.0
"""The floor is searched for up to this distance from the robot [m]."""

_FLOOR_SHARE = 0.25
"""The floor is the lowest level with this share of the voxels of the fullest one."""

_FLOOR_AROUND = 5.0
"""Up to this distance otherwise [m]; within it hardly anything lies below the floor."""

_MAX_BELOW = 0.5
"""A level with this number of voxels below it, as a share of its own, is the top of a table or a
bed, and the floor has not been seen."""

_MAX_BLIND = 2.5
"""A camera that first shows the floor farther off than this [m] does not show what stands before
it, and has no blind spot that may be trusted."""

_AHEAD = 0.5
"""How far before the robot everything must be known that its camera can see [m]."""

_LEAVING = 0.3
"""Within this distance of the robot the margin is not required [m], as it is there already."""

_OVERLAP = 0.25
"""Layers of which the body takes less than this share of a cell need not be known [cells]."""


@dataclass(frozen=True)
class Room:
    """The plan for one body. Made by `room_for`."""

    distance: np.ndarray
    """Distance of each pixel's center to the nearest obstacle [m], [x, y]."""

    origin: np.ndarray
    """Lower corner of pixel (0, 0) [m], [2]."""

    pixel: float
    """Side of a pixel [m]."""

    needed: float
    """Minimum distance of the body's center [m]."""

    stop: np.ndarray
    """Flat index of the stop pixel in each column, [X, Y]; -1: none."""

    cost: np.ndarray
    """Length of the shortest path to each of these [m], [X, Y]; inf: no path."""

    previous: np.ndarray
    """Flat index of the pixel before each on that path, [x * y]; -1 at its start."""

    floor: np.ndarray
    """Height of the floor [m], [X, Y]."""

    counts: dict[str, int] = field(default_factory=dict[str, int])
    """Numbers of columns around the robot, by the reason why they are closed."""

    @property
    def columns(self) -> np.ndarray:
        """Columns of cells in which the body fits somewhere, [X, Y] bool."""
        return self.stop >= 0

    def places(self, pixels: np.ndarray) -> np.ndarray:
        """Computes the centers of pixels given by flat index [...], [..., 2] [m]."""
        index = np.stack(np.unravel_index(pixels, self.distance.shape), axis=-1)
        return self.origin + (index + 0.5) * self.pixel

    def path(self, column: tuple[int, int]) -> np.ndarray:
        """Lists the pixels' centers from the robot to its stop in a column, [K, 2] [m]."""
        pixels = [int(self.stop[column])]
        while self.previous[pixels[-1]] >= 0:
            pixels.append(int(self.previous[pixels[-1]]))
        return self.places(np.array(pixels[::-1]))

    def fits(self, points: np.ndarray) -> np.ndarray:
        """Checks if the body fits at points [..., 2 or 3] [m]."""
        index = (np.asarray(points)[..., :2] - self.origin) / self.pixel - 0.5
        # Between the centers of pixels: a distance read at the nearest one is half a pixel off.
        at = np.moveaxis(index, -1, 0)
        distance = ndimage.map_coordinates(self.distance, at, order=1, cval=0.0)
        return np.asarray(distance >= self.needed - 1e-9)

    def fits_along(self, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Checks if the body fits everywhere on the straight lines to ends [n, 3] [m], [n] bool."""
        gap = ends[:, :2] - start[:2]
        if not len(gap):
            return np.zeros(0, bool)
        # The start is not checked: the robot is there.
        num = max(int(np.ceil(np.linalg.norm(gap, axis=1).max() / (0.5 * self.pixel))), 1)
        shares = np.arange(1, num + 1) / num
        return np.asarray(self.fits(start[:2] + shares[:, None, None] * gap).all(axis=0))


@dataclass(frozen=True)
class Been:
    """Where a robot has been."""

    trail: np.ndarray | None = None
    """Cells that it has come through, [X, Y, Z] bool."""

    views: np.ndarray | None = None
    """Positions and directions of its views, the first one first, [V, 6] [m]; None: here only."""

    driven: np.ndarray | None = None
    """Pixels of the plan that it has driven over: their centers, [P, 2] [m]."""


def room_for(
    body: Body,
    grid: OccupancyGrid,
    voxels: np.ndarray,
    voxel_size: float,
    T_world_camera: np.ndarray,
    camera: Camera | None = None,
    been: Been = Been(),
) -> Room:
    """Makes the plan for a body with a footprint.

    Args:
        body: a body whose `heights` are not None.
        grid: the grid.
        voxels: centers of the map's voxels, [n, 3] [m].
        voxel_size: edge of a voxel [m].
        T_world_camera: where the camera is, [4, 4].
        camera: its lens, which tells how near it sees the floor; None: it does not.
        been: where the robot has been.
    """
    known = _Known.of(body, grid, voxels, voxel_size, T_world_camera, been.trail)
    low, pixel, position = known.origin[:2], known.pixel, known.position[:2]
    passable = known.passable(camera, T_world_camera, been.views)
    if grid.trusted is not None:
        passable |= known.by_pixel(np.any(grid.trusted, axis=2))
    own = np.hypot(*known.round_place(position)[1:])
    # Where the robot stands is known and open, whatever the cells say, unless a zone closes it.
    is_own = own <= body.needed + pixel
    thin = known.thin
    solid = known.by_pixel(thin) & ~is_own
    if grid.closed is not None:
        solid |= known.by_pixel(np.any(grid.closed, axis=2))
    # The robot is not inside of anything: what seems to be there is itself, or noise.
    places = known.obstacles[:, :2]
    places = places[np.linalg.norm(places - position, axis=1) > body.radius]
    clearance = functools.partial(
        _distances, obstacles=places, low=low, pixel=pixel, half=0.5 * voxel_size
    )
    distance = clearance(solid | ~(passable | is_own))
    way = np.zeros(solid.shape, bool)
    if been.driven is not None and len(been.driven):
        # It drove there: only what is measured can be in its way. So a doorway does not close
        # behind it, and no other pixel is taken for known: a path would creep into the unknown.
        index = np.floor((been.driven - low) / pixel).astype(int)
        way[tuple(index[np.all((index >= 0) & (index < way.shape), axis=1)].T)] = True
        way &= clearance(solid) >= body.radius
    stop, cost, previous = _search(distance, own, pixel, body, way)
    near = known.by_column(own <= body.needed + 0.5)
    hit_columns = thin.copy()
    hit_columns[tuple(np.floor((places - low) / known.size).astype(np.int64).T)] = True
    counts = {
        "near": int(near.sum()),
        "unknown": int((near & ~known.by_column(passable) & ~thin).sum()),
        "obstacle": int((near & hit_columns).sum()),
        "open": int((near & np.isfinite(cost)).sum()),
    }
    return Room(distance, low.copy(), pixel, body.needed, stop, cost, previous, known.floor, counts)


@dataclass(frozen=True)
class _Known:
    """Known cells and voxels in the range of heights of a body."""

    body: Body
    free: np.ndarray
    occupied: np.ndarray
    origin: np.ndarray
    size: float
    voxels: np.ndarray
    """Centers of voxels within the grid, [n, 3] [m]."""
    above: np.ndarray
    """Their heights above the floor of their columns, [n] [m]."""
    cells: np.ndarray
    """Their cells, [n, 3]."""
    voxel_size: float
    position: np.ndarray
    """Position of the camera, [3] [m]."""
    height: float
    """Height of the camera above the floor [m]."""
    floor: np.ndarray
    """Height of the floor, [X, Y] [m]."""
    within: np.ndarray
    """Cells that the body would take up, [X, Y, Z] bool."""
    low: float
    """Lowest part above the floor, at least a step [m]."""
    top: np.ndarray
    """Highest part, world, [X, Y] [m]."""
    been: np.ndarray
    """Columns that the robot has passed, including its own, [X, Y] bool."""

    @classmethod
    def of(
        cls, body: Body, grid: OccupancyGrid, voxels: np.ndarray, voxel_size: float,
        T_world_camera: np.ndarray, trail: np.ndarray | None,
    ) -> "_Known":  # fmt: skip
        """Finds the floor, and the cells that the body would take up above it."""
        assert body.heights is not None
        size, origin = float(grid.cell_size), np.asarray(grid.origin, np.float64)
        free, occupied = np.asarray(grid.free), np.asarray(grid.occupied)
        shape, position = free.shape, np.asarray(T_world_camera, np.float64)[:3, 3]
        # Voxels above the body are neither obstacles nor floor.
        tallest = position[2] + (body.heights[1] or 0.0) + size
        voxels = voxels[voxels[:, 2] < tallest]
        cells = np.floor((voxels - origin) / size).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < shape), axis=1)
        voxels, cells = voxels[inside], cells[inside]
        start = _floor_at(body, voxels, voxel_size, occupied, origin, size, position)
        floor = _floor_map(voxels, cells, voxel_size, shape, origin, size, position, start)
        x, y = np.clip(_column(position, origin, size), 0, np.array(shape[:2]) - 1)
        height = float(position[2] - floor[x, y])
        high = height if body.heights[1] is None else body.heights[1]
        low = max(body.heights[0], body.step)
        bottom, top = floor + low, floor + max(high, low + 0.5 * voxel_size)
        lower = origin[2] + size * np.arange(shape[2])
        overlap = np.minimum(lower + size, top[..., None]) - np.maximum(lower, bottom[..., None])
        # At least one layer counts, even for thin bodies.
        thickest = overlap.max(axis=2, keepdims=True)
        within = overlap > np.minimum(_OVERLAP * size, 0.99 * thickest)
        been = np.zeros(shape[:2], bool)
        if trail is not None:
            been |= np.asarray(trail).any(axis=2)
        own = _column(position, origin, size)
        if np.all((own >= 0) & (own < shape[:2])):
            been[tuple(own)] = True
        above = voxels[:, 2] - floor[cells[:, 0], cells[:, 1]]
        return cls(body, free, occupied, origin, size, voxels, above, cells, voxel_size, position,
                   height, floor, within, low, top, been)  # fmt: skip

    @property
    def pixel(self) -> float:
        """Side of a pixel [m]."""
        return self.size / PIXELS_PER_CELL

    def by_pixel(self, columns: np.ndarray) -> np.ndarray:
        """Spreads columns [X, Y] over their pixels, [x, y]."""
        return np.repeat(np.repeat(columns, PIXELS_PER_CELL, axis=0), PIXELS_PER_CELL, axis=1)

    def by_column(self, pixels: np.ndarray) -> np.ndarray:
        """Finds columns with one of these pixels [x, y] at least, [X, Y]."""
        x, y = self.free.shape[:2]
        by_cell = pixels.reshape(x, PIXELS_PER_CELL, y, PIXELS_PER_CELL)
        return np.any(by_cell, axis=(1, 3))

    def round_place(
        self, place: np.ndarray, reach: float = math.inf
    ) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
        """Measures from a place [2] to the centers of the pixels within reach [m].

        Returns:
            The window of these pixels [i, j], and the offsets along x [i, 1] and y [1, j] [m].
        """
        window, offsets = [], []
        for axis in (0, 1):
            num = PIXELS_PER_CELL * self.free.shape[axis]
            gap = self.origin[axis] + self.pixel * (np.arange(num) + 0.5) - place[axis]
            low, high = np.searchsorted(gap, (-reach, reach))
            window.append(slice(low, high))
            offsets.append(gap[low:high])
        return (window[0], window[1]), offsets[0][:, None], offsets[1][None, :]

    def passable(
        self, camera: Camera | None, T_world_camera: np.ndarray, views: np.ndarray | None
    ) -> np.ndarray:
        """Finds pixels that are known as far as the body takes them up, [x, y] bool.

        Args:
            camera: its lens; None: it shows no floor.
            T_world_camera: where it is, [4, 4].
            views: positions and directions of the views so far, [V, 6] [m].
        """
        T = np.asarray(T_world_camera, np.float64)
        views = np.zeros((0, 6)) if views is None else views.astype(np.float64)
        seen = self.seen_columns(_highest_seen(camera, T, self.height, self.body))
        floor = self.by_pixel(self.floor_columns()) | (self.seen_floor() & self.by_pixel(seen))
        reach = self.reach_above_floor(camera, T)
        if camera is not None and reach < _MAX_BLIND:
            now = np.concatenate([T[:3, 3], T[:3, 2]])[None]
            floor &= self.shown_within(camera, np.concatenate([now, views]), reach)
        known = self.by_pixel(self.columns()) | floor
        if self.body.unknown_below == "free":
            blind = _blind_radius(camera, T, self.height)
            first = views[0, :2] if len(views) else self.position[:2]
            known |= self.blind_spot(known, first, blind) & self.by_pixel(~self.thin)
        # Where the robot has stood is known, whatever the cells say.
        for place in views[:, :2]:
            window, x, y = self.round_place(place, self.body.needed)
            known[window] |= np.hypot(x, y) <= self.body.needed
        return known

    @functools.cached_property
    def obstacles(self) -> np.ndarray:
        """Centers of voxels that the body would touch, [n, 3] [m]."""
        top = self.top[self.cells[:, 0], self.cells[:, 1]]
        # A tolerance of a tenth of a voxel, the accuracy of the floor.
        is_above = self.above > self.low + 0.1 * self.voxel_size
        return self.voxels[is_above & (self.voxels[:, 2] - 0.5 * self.voxel_size < top)]

    def cells_with(self, voxels: np.ndarray) -> np.ndarray:
        """Finds cells into which voxels [n, 3] [m] reach, [X, Y, Z] bool."""
        found, last = np.zeros(self.free.shape, bool), np.array(self.free.shape) - 1
        low, high = (
            np.clip(np.floor((voxels + half - self.origin) / self.size), 0, last).astype(int)
            for half in (-0.5 * self.voxel_size, 0.5 * self.voxel_size)
        )
        for x, y, z in itertools.product((low, high), repeat=3):
            found[x[:, 0], y[:, 1], z[:, 2]] = True
        return found

    @functools.cached_property
    def thin(self) -> np.ndarray:
        """Columns with an occupied cell above the floor that no obstacle explains, [X, Y].

        The seat of a chair does not explain what was measured below it: that is a leg.
        """
        unexplained = self.occupied & ~self.cells_with(self.obstacles)
        thin = np.any(self.within & unexplained & ~self.holds_floor, axis=2)
        # In the floor's own cells a leg is not told from the floor. Of a body that is no taller
        # than they are, the cell above shows it.
        above = self.occupied & ~self.cells_with(self.voxels[self.above > self.low])
        first = self.holds_floor.shape[2] - np.argmax(self.holds_floor[..., ::-1], axis=2)
        first = np.minimum(first, above.shape[2] - 1)[..., None]
        is_low = ~np.any(self.within & ~self.holds_floor, axis=2)
        return thin | (is_low & np.take_along_axis(above, first, axis=2)[..., 0])

    @functools.cached_property
    def holds_floor(self) -> np.ndarray:
        """Cells in which the floor may be measured, [X, Y, Z] bool."""
        lower = self.origin[2] + self.size * np.arange(self.free.shape[2])
        floor, step = self.floor[..., None], self.body.step
        return (lower < floor + step) & (lower + self.size > floor - step)

    @functools.cached_property
    def is_floor(self) -> np.ndarray:
        """Which of the voxels are of the floor, [n] bool."""
        return np.abs(self.above) <= 1.3 * self.voxel_size

    @functools.cached_property
    def beside(self) -> np.ndarray:
        """Columns with an obstacle in them or in a column next to them, [X, Y] bool."""
        hit = np.floor((self.obstacles[:, :2] - self.origin[:2]) / self.size).astype(np.int64)
        beside = np.zeros(self.free.shape[:2], bool)
        beside[tuple(hit.T)] = True
        return np.asarray(ndimage.binary_dilation(beside, np.ones((3, 3), bool)), bool)

    def columns(self) -> np.ndarray:
        """Finds columns that are free as far as the body takes them up, [X, Y] bool.

        Those that the robot has come through are free, too.
        """
        return np.all(self.free | ~self.within, axis=2) | self.been

    def floor_columns(self) -> np.ndarray:
        """Finds columns where the floor was seen, and all above its own cell is free, [X, Y] bool.

        With nothing on it or beside them.
        """
        has_floor = np.zeros(self.free.shape[:2], bool)
        has_floor[tuple(self.cells[self.is_floor, :2].T)] = True
        above_floor = np.all(self.free | ~self.within | self.holds_floor, axis=2)
        return above_floor & has_floor & ~self.beside

    def seen_columns(self, blind: float) -> np.ndarray:
        """Finds columns in which nothing that the camera could see is unknown, [X, Y] bool.

        A cell is known by the voxels in it, too. `unknown_below` says if the lowest one may be
        unknown, and those that the image shows from nearby only.

        Args:
            blind: heights above this are out of the image's upper edge until the robot is there
                [m], above the floor.
        """
        voxels = self.voxels[self.above > self.low - self.size]  # the others lie below the body
        known = self.free | self.occupied | self.cells_with(voxels) | ~self.within
        if self.body.unknown_below == "free":
            middle = self.origin[2] + self.size * (np.arange(known.shape[2]) + 0.5)
            # A cell is free once its lower half was seen through.
            known |= middle - 0.25 * self.size - self.floor[..., None] > blind
            lowest = np.argmax(self.within, axis=2)[..., None]
            np.put_along_axis(known, lowest, True, axis=2)
        return np.all(known, axis=2)

    def seen_floor(self) -> np.ndarray:
        """Finds pixels at which the floor was seen, [x, y] bool."""
        num = PIXELS_PER_CELL
        shape = num * self.free.shape[0], num * self.free.shape[1]
        pixels = lambda voxels: tuple(
            np.clip((voxels[:, i] - self.origin[i]) * num / self.size, 0, shape[i] - 1).astype(int)
            for i in (0, 1)
        )
        seen = np.zeros(shape, bool)
        seen[pixels(self.voxels[self.is_floor])] = True
        seen[pixels(self.obstacles)] = False  # the lowest voxel of a wall is no floor
        # Gaps between voxels are filled, and between the rows of an image where nothing stands:
        # what hides in them would have to be narrower than they are.
        least = max(1.0, self.voxel_size * num / self.size)
        is_clear = self.by_pixel(~self.beside)
        return _closed(seen, least) | (_closed(seen, least + 1.0) & is_clear)

    def reach_above_floor(self, camera: Camera | None, T_world_camera: np.ndarray) -> float:
        """Computes up to where the image shows all that the body would run into [m].

        A camera that looks down shows the floor far off, and little above it: the floor below a
        desk, and not its edge.
        """
        slope = _upper_slope(camera, T_world_camera)
        if slope >= 0.0:
            return math.inf
        top = float((self.top - self.floor).max())
        needed = min(top, _highest_seen(camera, T_world_camera, self.height, self.body))
        return (self.height - max(needed, self.low)) / -slope

    def shown_within(self, camera: Camera, views: np.ndarray, reach: float) -> np.ndarray:
        """Finds pixels that a view had ahead of it within a distance, [x, y] bool.

        Args:
            camera: its lens.
            views: positions and directions of the views, [V, 6] [m].
            reach: the distance [m].
        """
        found = np.zeros([PIXELS_PER_CELL * n for n in self.free.shape[:2]], bool)
        least = float(camera.fx) / math.hypot(float(camera.fx), 0.5 * camera.width)  # a cosine
        for view in views:
            window, x, y = self.round_place(view[:2], reach)
            gap, norm = np.hypot(x, y), max(float(np.hypot(view[3], view[4])), 1e-9)
            is_ahead = (x * view[3] + y * view[4]) / norm >= least * gap
            found[window] |= is_ahead & (gap <= reach)
        return found

    def blind_spot(self, known: np.ndarray, first: np.ndarray, blind: float) -> np.ndarray:
        """Finds what the camera could not see of the floor round the robot's first place.

        It looked over it, and sees the floor behind; later places it has looked at from afar.

        Args:
            known: pixels that are known, [x, y] bool.
            first: where the first view was taken, [2] [m].
            blind: how far from the robot the image first shows the floor [m].

        Returns:
            [x, y] bool.
        """
        if blind <= 0.0:
            return np.zeros(known.shape, bool)
        num = PIXELS_PER_CELL
        shape = self.free.shape[:2]
        hit = np.zeros(shape, bool)
        tall = self.cells[self.above > self.body.step + self.voxel_size]
        hit[tall[:, 0], tall[:, 1]] = True
        x, y = (self.origin[i] + self.size * (np.arange(shape[i]) + 0.5) - first[i] for i in (0, 1))
        near = np.hypot(x[:, None], y[None, :]) <= self.body.needed
        # Round obstacles, not through them: what hides behind a table is not the blind spot.
        for i in range(int(np.ceil(blind / self.size / 0.85))):
            square = None if i % 2 else np.ones((3, 3), bool)
            near = np.asarray(ndimage.binary_dilation(near, square, mask=~hit), bool)
        near = near & np.any(self.free & self.within, axis=2)
        gap = num * (blind / self.size + 1.0)
        found = self.by_pixel(near)
        rows, columns = (np.flatnonzero(near.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return found
        reach = int(np.ceil(2.0 * gap)) + 1
        window = tuple(
            slice(max(num * int(k[0]) - reach, 0), num * (int(k[-1]) + 1) + reach)
            for k in (rows, columns)
        )
        found[window] &= _closed(known[window], gap)
        return found


def _edt(mask: np.ndarray) -> np.ndarray:
    return np.asarray(ndimage.distance_transform_edt(mask))


def _closed(mask: np.ndarray, radius: float) -> np.ndarray:
    """Fills gaps of a mask that are narrower than a disk of this radius [pixels]."""
    pad = int(np.ceil(radius)) + 1
    wide = np.pad(mask, pad)
    if radius > 3.0:  # a large disk has many pixels: by distances instead
        wide = _edt(~wide) <= radius
        return (_edt(wide) > radius)[pad:-pad, pad:-pad]
    side = np.arange(-int(radius), int(radius) + 1)
    disk = np.hypot(side[:, None], side[None, :]) <= radius
    return np.asarray(ndimage.binary_closing(wide, disk))[pad:-pad, pad:-pad]


def _distances(
    closed: np.ndarray, obstacles: np.ndarray, low: np.ndarray, pixel: float, half: float
) -> np.ndarray:
    """Measures from each pixel's center to the nearest closed pixel or obstacle [m].

    Args:
        closed: pixels that the body must not touch, [x, y] bool.
        obstacles: middles of voxels, [n, 2] [m]; to their sides is measured, not to the middles of
            the pixels that hold them.
        low: lower corner of the plan [m], [2].
        pixel: side of a pixel [m].
        half: half the side of a voxel [m].
    """
    targets = np.moveaxis(np.indices(closed.shape) + 0.5, 0, -1) * pixel
    scaled = (obstacles - low) / pixel
    index = tuple(np.clip(np.floor(scaled).astype(np.int64), 0, np.array(closed.shape) - 1).T)
    blocked, centers = closed.copy(), targets.copy()
    blocked[index] = True
    targets[index] = np.where(closed[index][:, None], targets[index], scaled * pixel)
    sides = np.zeros(closed.shape)
    sides[index] = np.where(closed[index], 0.0, half)
    # Beyond the grid nothing is known.
    far = np.pad(~blocked, 1)
    nearest = np.asarray(
        ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
    )[:, 1:-1, 1:-1]
    targets = np.pad(targets, ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd")
    at = nearest[0], nearest[1]
    side = np.pad(sides, 1)[at]
    gap = np.maximum(np.abs(targets[at] - centers) - side[..., None], 0.0)
    return np.where(blocked, 0.0, np.linalg.norm(gap, axis=-1))


def _search(
    distance: np.ndarray, own: np.ndarray, pixel: float, body: Body, way: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Searches shortest paths over the plan, and the pixel with most clearance in each column.

    Returns:
        The pixel's flat index and the length of the path to it [m], [X, Y] each; and the flat index
        of the pixel before each pixel, [x * y].
    """
    # The robot fits at its position, and may leave the margin of obstacles that have come near.
    usable = (distance >= body.needed) | ((own < _LEAVING) & (distance >= body.radius)) | way
    start = np.unravel_index(np.argmin(own), own.shape)
    is_inside = own[start] < pixel
    usable[start] |= is_inside
    first = (int(start[0]), int(start[1]), 0) if is_inside else None
    cost, previous = shortest_paths(usable[:, :, None], first)
    cost, previous = cost[:, :, 0] * pixel, previous[:, :, 0].reshape(-1)
    num = PIXELS_PER_CELL
    x, y = distance.shape[0] // num, distance.shape[1] // num
    by_cell = lambda a: a.reshape(x, num, y, num).transpose(0, 2, 1, 3).reshape(x, y, num * num)
    fits = np.where(distance >= body.needed, distance, -np.inf)
    # Among reachable pixels, if there are any.
    best = np.argmax(by_cell(np.where(np.isfinite(cost), fits + 1e3, fits)), axis=2)[..., None]
    pick = lambda a: np.take_along_axis(by_cell(a), best, axis=2)[..., 0]
    stop = np.where(pick(fits) > 0.0, pick(np.arange(cost.size).reshape(cost.shape)), -1)
    return stop, np.where(stop >= 0, pick(cost), np.inf), previous


def _column(position: np.ndarray, origin: np.ndarray, size: float) -> np.ndarray:
    return np.floor((position[:2] - origin[:2]) / size).astype(np.int64)


def _floor_at(
    body: Body, voxels: np.ndarray, voxel_size: float, occupied: np.ndarray,
    origin: np.ndarray, size: float, position: np.ndarray,
) -> float:  # fmt: skip
    """Returns the floor's height under the robot [m]: given, detected, or the box's lower bound."""
    if body.floor is not None:
        return body.floor
    gap = np.linalg.norm(voxels[:, :2] - position[:2], axis=1)
    around = voxels[gap < _FLOOR_AROUND, 2]
    beneath = voxels[:, 2] < position[2] + voxel_size
    floor = _lowest_level(
        voxels[(gap < _FLOOR_WITHIN) & beneath, 2], around, voxel_size, float(position[2])
    )
    # A level camera shows furniture nearby, and the floor farther off only.
    if floor is None:
        floor = _bottom_level(around[around < position[2] + voxel_size], voxel_size)
    if floor is not None:
        return floor
    x, y = np.clip(_column(position, origin, size), 0, np.array(occupied.shape[:2]) - 1)
    below = np.flatnonzero(
        occupied[x, y] & (origin[2] + size * (np.arange(occupied.shape[2]) + 1) < position[2])
    )
    # The grid has one layer more than its box.
    return float(origin[2] + size * (1 + (below[0] if len(below) else 0)))


def _lowest_level(z: np.ndarray, around: np.ndarray, voxel_size: float, top: float) -> float | None:
    """Finds the lowest level at which voxels lie side by side [m]; None: there is none.

    Args:
        z: heights of voxels near the robot, below it [m].
        around: heights of those around it [m]: below the floor there are hardly any.
        voxel_size: edge of a voxel [m].
        top: height of the camera [m].
    """
    if len(z) < 20:
        return None
    level = np.rint((z - z.min()) / voxel_size).astype(np.int64)
    count = np.bincount(level, minlength=int((top - z.min()) / voxel_size) + 2)
    # A camera that never shows the floor shows walls, in which all levels are alike.
    is_flat = (count >= _FLOOR_SHARE * count.max()) & (count >= 3.0 * np.median(count))
    lowest = int(np.argmax(is_flat))
    below = np.count_nonzero(around < z.min() + (lowest - 1.5) * voxel_size)
    if not is_flat.any() or below >= _MAX_BELOW * count[lowest]:
        return None
    # A floor on the border of two levels fills both of them.
    is_floor = (level == lowest) | ((level == lowest + 1) & (count[level] >= 0.5 * count[lowest]))
    return float(z[is_floor].mean())


def _bottom_level(z: np.ndarray, voxel_size: float) -> float | None:
    """Finds the lowest level if it holds far more voxels than those above it; None: it does not.

    Walls that end at the border of the image have fewer voxels the lower they are.
    """
    if len(z) < 20:
        return None
    count = np.bincount(np.rint((z - z.min()) / voxel_size).astype(np.int64), minlength=4)
    lowest = z < z.min() + 1.5 * voxel_size  # noise, or a border of two levels, fills both
    if lowest.sum() < max(3.0 * count[2:4].sum(), _FLOOR_SHARE * count.max(), 20):
        return None
    return float(z[lowest].mean())


def _floor_map(
    voxels: np.ndarray, cells: np.ndarray, voxel_size: float, shape: tuple[int, ...],
    origin: np.ndarray, size: float, position: np.ndarray, start: float,
) -> np.ndarray:  # fmt: skip
    """Maps the height of the floor [m], [X, Y]: by at most a voxel up or down from cell to cell."""
    low = np.floor(origin[2] / voxel_size)
    num = int(np.ceil(shape[2] * size / voxel_size)) + 2
    level = np.clip(np.floor(voxels[:, 2] / voxel_size) - low, 0, num - 1).astype(np.int64)
    # How many, not whether any: a stray voxel of noise must not lift the floor.
    at = np.ravel_multi_index((cells[:, 0], cells[:, 1], level), (*shape[:2], num))
    filled = np.bincount(at, minlength=shape[0] * shape[1] * num).reshape(*shape[:2], num)
    heights = (low + np.arange(num) + 0.5) * voxel_size
    # A border of unknown columns: no column needs to be checked against the edges.
    floor, known = np.zeros((shape[0] + 2, shape[1] + 2)), np.zeros((shape[0] + 2, shape[1] + 2))
    x, y = np.clip(_column(position, origin, size), 0, np.array(shape[:2]) - 1)
    floor[x + 1, y + 1], known[x + 1, y + 1] = start, 1.0
    near = lambda a: a[:-2, 1:-1] + a[2:, 1:-1] + a[1:-1, :-2] + a[1:-1, 2:]
    while True:
        count = near(known)
        new = (count > 0.0) & (known[1:-1, 1:-1] == 0.0)
        i, j = np.nonzero(new)
        if not len(i):
            return floor[1:-1, 1:-1]
        expected = near(floor)[new] / count[new]
        weight = filled[i, j] * (np.abs(heights - expected[:, None]) <= 1.3 * voxel_size)
        total = weight.sum(axis=1)
        found = (weight * heights).sum(axis=1) / np.maximum(total, 1.0)
        floor[i + 1, j + 1] = np.where(total > 0, found, expected)
        known[i + 1, j + 1] = 1.0


def _highest_seen(
    camera: Camera | None, T_world_camera: np.ndarray, height: float, body: Body
) -> float:
    """Computes how high above the floor the image shows what the robot is about to reach [m]."""
    slope = _upper_slope(camera, T_world_camera)
    if slope >= 0.0:
        return math.inf
    # A camera whose image begins farther off shows the next step of the robot from there only.
    ahead = max(_AHEAD, _blind_radius(camera, T_world_camera, height))
    return height + slope * (body.needed + ahead)


def _upper_slope(camera: Camera | None, T_world_camera: np.ndarray) -> float:
    """Computes the slope of the ray through the middle of the image's upper border."""
    if camera is None:
        return math.inf
    T = np.asarray(T_world_camera, np.float64)
    ray = T[:3, :3] @ np.array([0.0, -float(camera.cy) / float(camera.fy), 1.0])
    return float(ray[2]) / max(float(np.hypot(ray[0], ray[1])), 1e-9)


def _blind_radius(camera: Camera | None, T_world_camera: np.ndarray, height: float) -> float:
    """Computes the smallest distance at which the image shows the floor [m]; 0: never."""
    if camera is None:
        return 0.0
    T = np.asarray(T_world_camera, np.float64)
    lowest = np.array([0.0, (camera.height - float(camera.cy)) / float(camera.fy), 1.0])
    ray = T[:3, :3] @ lowest
    if ray[2] >= -1e-2 * np.linalg.norm(ray):
        return 0.0
    radius = max(height, 0.0) * float(np.hypot(ray[0], ray[1])) / -float(ray[2])
    return radius if radius <= _MAX_BLIND else 0.0
