"""Finds the floor of a walked capture, and where a person can stand to hold a camera at a place.

Free space over a sofa is no place to stand. The floor is the surface below the cameras. A person
can stand where a cylinder for the body, from shin to head, meets no obstacle, and can reach from
there at arm's length. A capture that no one walked through (by drone, turntable or robot) is
detected: its floor is not visible or too far below, or a person could not stand at most of its own
cameras. Where a person could stand is then not known.

Shape symbols: n cameras; m voxels; c places; X Y Z cells of the coarse grid.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from r3jax.mapping.occupancy import OccupancyGrid

_WALKED = (0.5, 2.3)
"""Range of the cameras' median height over the floor in a walked capture [m]."""

_HELD_LOW = 1.0
"""Cameras lower than this over what is below them may all have been held over a table [m]."""

_BESIDE = 2.0
"""How far from the cameras the floor beside the table may lie [m]."""

_LEAST_STEP = 0.3
"""How far the floor lies below the table at least [m]."""

_LEAST_FLOOR = 0.5
"""Area that a floor shows at least [m2]."""

_USUAL_HEIGHT = 1.5
"""Assumed height if the capture's unit is not known [m]."""

_SHIN, _HEAD = 0.25, 1.8
"""Lower and upper end of the body over the floor: above its roughness, and at the head [m]."""

_SHOULDERS = 0.25
"""Radius of the body [m]."""

_ARM = 0.6
"""How far to the side of the feet a camera can be held [m]."""

_NEAR_CAMERAS = 16
"""Number of cameras around a place that determine its floor."""

_FLOOR_PERCENTILE = 25.0
"""Percentile of the heights below these cameras; some were held over a table."""

_KNOWN_BELOW = 0.2
"""Minimum share of the cameras with a known surface below."""

_OWN_SHARE = 0.5
"""Minimum share of the capture's own cameras at places where a person could hold them."""

_STRAYS = 16
"""Maximum number of voxels in a body's cells that count as noise: 4 % of a square meter at 5 cm."""

_FREE_SHARE = 0.5
"""Minimum share of a body's cells that are known to be free; the others may be unknown."""


@dataclass(frozen=True)
class Footing:
    """Where a person stands to hold the camera at each place."""

    feet: np.ndarray
    """Points on the floor, [c, 3] [audit units]; NaN where no one can hold a camera there."""

    is_over: np.ndarray
    """True where the camera is held out over something, or sideways from the feet, [c]."""

    @property
    def is_reached(self) -> np.ndarray:
        """True where a person can hold a camera, [c]."""
        return np.isfinite(self.feet[:, 0])


class Ground:
    """The floor below a walked capture."""

    def __init__(
        self,
        grid: OccupancyGrid,
        voxels: np.ndarray,
        cameras: np.ndarray,
        levels: np.ndarray,
        person: float,
    ):
        """Stores the results of `ground_of`.

        Args:
            grid: free and occupied space.
            voxels: centers of all voxels, [m, 3] [audit units].
            cameras: cameras with a known surface below, [n, 3] [audit units].
            levels: height of the surface below each, [n] [audit units].
            person: length of a meter for a person's size [audit units].
        """
        self._cell, self._origin = float(grid.cell_size), np.asarray(grid.origin, np.float64)
        shape = np.array(grid.log_odds.shape)
        cells = np.floor((voxels - self._origin) / self._cell).astype(np.int64)
        held = np.zeros(shape, np.int32)
        np.add.at(held, tuple(cells[np.all((cells >= 0) & (cells < shape), axis=1)].T), 1)
        self._occupied, self._free, self._held = (
            np.concatenate(
                [np.zeros((*mask.shape[:2], 1), np.int32), mask.cumsum(axis=2, dtype=np.int32)],
                axis=2,
            )
            for mask in (np.asarray(grid.occupied), np.asarray(grid.free), held)
        )
        self._grid = grid
        self._tree, self._levels, self._track = KDTree(cameras), levels, KDTree(cameras[:, :2])
        self.person = person
        """Length of a meter for a person's size [audit units]."""

    def floor(self, places: np.ndarray) -> np.ndarray:
        """Computes the floor height below places, [c] [audit units], from the cameras nearby."""
        count = min(_NEAR_CAMERAS, self._tree.n)
        near = np.asarray(self._tree.query(places, k=count)[1]).reshape(len(places), count)
        return np.percentile(self._levels[near], _FLOOR_PERCENTILE, axis=1)

    def footing(self, places: np.ndarray) -> Footing:
        """Finds where a person stands to hold the camera at each of the places [c, 3]."""
        floor = self.floor(places)
        stands = self._stands(places, floor)
        feet = np.full((len(places), 3), np.nan)
        feet[stands] = np.column_stack([places[stands, :2], floor[stands]])
        for offset in self._arm_offsets():
            left = np.flatnonzero(~np.isfinite(feet[:, 0]))
            aside = places[left] + offset
            halfway = places[left] + 0.5 * offset
            held = is_free_at(self._grid, aside) & is_free_at(self._grid, halfway)
            found = held & self._stands(aside, floor[left])
            feet[left[found]] = np.column_stack([aside[found, :2], floor[left[found]]])
        return Footing(feet, ~stands)

    def _arm_offsets(self) -> list[np.ndarray]:
        """Steps to the side within an arm's reach, the shortest first."""
        reach = _ARM * self.person
        most = int(reach / self._cell)
        steps = self._cell * np.array(
            [(x, y, 0) for x, y in itertools.product(range(-most, most + 1), repeat=2)], np.float64
        )
        length = np.linalg.norm(steps, axis=1)
        order = np.argsort(length, kind="stable")
        return [steps[i] for i in order.tolist() if 0.0 < length[i] <= reach + 1e-9]

    def _stands(self, places: np.ndarray, floor: np.ndarray) -> np.ndarray:
        """Returns a mask of places where a body under the camera meets no obstacle, [c]."""
        shape = np.array(self._grid.log_odds.shape)
        low = np.rint((floor + _SHIN * self.person - self._origin[2]) / self._cell)
        head = np.maximum(floor + _HEAD * self.person, places[:, 2])
        high = np.floor((head - self._origin[2]) / self._cell)
        low, high = (np.clip(k, 0, shape[2]).astype(np.int64) for k in (low, high))
        high = np.maximum(high, low)
        meets = np.zeros(len(places), dtype=bool)
        free, cells, held = (np.zeros(len(places)) for _ in range(3))
        reach = _SHOULDERS * self.person
        most = int(np.ceil(reach / self._cell))
        for dx, dy in itertools.product(range(-most, most + 1), repeat=2):
            if np.hypot(dx, dy) * self._cell > reach + 1e-9:
                continue
            x, y = (
                np.floor((places[:, a] - self._origin[a]) / self._cell).astype(np.int64) + d
                for a, d in ((0, dx), (1, dy))
            )
            inside = (x >= 0) & (x < shape[0]) & (y >= 0) & (y < shape[1])
            x, y = x.clip(0, shape[0] - 1), y.clip(0, shape[1] - 1)
            of = lambda total, x=x, y=y: total[x, y, high] - total[x, y, low]
            meets |= inside & (of(self._occupied) > 0)
            free += inside * of(self._free)
            held += inside * of(self._held)
            cells += high - low
        # The back of a chair fills no cell, so voxels are checked too.
        meets |= held > _STRAYS
        walked = self._track.query(places[:, :2])[0] <= _SHOULDERS * self.person
        return ~meets & (walked | (free >= _FREE_SHARE * cells))


def ground_of(
    grid: OccupancyGrid, voxels: np.ndarray, cameras: np.ndarray, meter: float | None
) -> Ground | None:
    """Finds the floor of a walked capture; None if no one walked there, or it is not known.

    Args:
        grid: free and occupied space.
        voxels: centers of all voxels, [m, 3] [audit units]; finer than the grid.
        cameras: camera positions, [n, 3] [audit units].
        meter: length of a meter [audit units]; None if the capture's unit is not known.
    """
    cell, origin = float(grid.cell_size), np.asarray(grid.origin, np.float64)
    occupied = np.asarray(grid.occupied)
    steps = np.arange(occupied.shape[2], dtype=np.int32)
    top = np.maximum.accumulate(np.where(occupied, steps + 1, 0), axis=2)
    cells = np.floor((cameras - origin) / cell).astype(np.int64)
    cells = cells.clip(0, np.array(occupied.shape) - 1)
    below = top[tuple(cells.T)]
    is_known = below > 0
    if is_known.sum() < max(3.0, _KNOWN_BELOW * len(cameras)):
        return None
    levels = _refined(origin[2] + cell * below[is_known], voxels, cameras[is_known], cell)
    if meter is not None:
        beside = _floor_beside(voxels, cameras[is_known], levels, meter, cell)
        levels = np.minimum(levels, beside)
    held = float(np.median(cameras[is_known, 2] - levels))
    if meter is None:
        meter = held / _USUAL_HEIGHT
    if not _WALKED[0] <= held / meter <= _WALKED[1]:
        return None
    ground = Ground(grid, voxels, cameras[is_known], levels, meter)
    return ground if ground.footing(cameras).is_reached.mean() >= _OWN_SHARE else None


def _refined(tops: np.ndarray, voxels: np.ndarray, cameras: np.ndarray, cell: float) -> np.ndarray:
    """Refines the height below each camera, [n], by the voxels in the cells that end at `tops`.

    A cell is as high as a step of a staircase; a floor that spans two cells lies in the lower one.
    """
    found = tops.copy()
    columns = KDTree(voxels[:, :2]).query_ball_point(cameras[:, :2], 1.5 * cell)
    for i, rows in enumerate(columns):
        height = voxels[rows, 2]
        height = height[(height <= tops[i]) & (height > tops[i] - 2.0 * cell)]
        if len(height):
            found[i] = np.median(height)
    return found


def _floor_beside(
    voxels: np.ndarray, cameras: np.ndarray, levels: np.ndarray, meter: float, cell: float
) -> float:
    """Finds the floor beside a table that most cameras were held over; inf if there is none.

    The lowest level with more surface than walls have at any height.
    """
    held = float(np.median(cameras[:, 2] - levels))
    if held >= _HELD_LOW * meter:
        return np.inf
    lowest = np.median(cameras[:, 2]) - _WALKED[1] * meter
    highest = np.median(levels) - _LEAST_STEP * meter
    is_low = (voxels[:, 2] > lowest) & (voxels[:, 2] < highest)
    low = voxels[is_low]
    low = low[KDTree(cameras[:, :2]).query(low[:, :2])[0] <= _BESIDE * meter] if len(low) else low
    if not len(low):
        return np.inf
    height = 0.5 * cell
    step = np.floor((low[:, 2] - lowest) / height).astype(np.int64)
    cells = np.column_stack([step, np.floor(low[:, :2] / cell).astype(np.int64)])
    area = np.bincount(np.unique(cells, axis=0)[:, 0], minlength=int((highest - lowest) / height))
    is_floor = (area * cell**2 >= _LEAST_FLOOR * meter**2) & (area >= 2.0 * np.median(area))
    if not is_floor.any():
        return np.inf
    # A floor on the border of two steps lies in both.
    first = int(np.argmax(is_floor))
    return float(np.median(low[(step == first) | (step == first + 1), 2]))


def is_free_at(grid: OccupancyGrid, places: np.ndarray) -> np.ndarray:
    """Returns a mask of the places [c, 3] in cells known to be free, [c] bool.

    Places outside of the grid are not free.
    """
    shape = np.array(grid.log_odds.shape)
    cells = np.floor((places - np.asarray(grid.origin)) / float(grid.cell_size)).astype(np.int64)
    is_inside = np.all((cells >= 0) & (cells < shape), axis=1)
    return is_inside & np.asarray(grid.free)[tuple(np.where(is_inside[:, None], cells, 0).T)]
