"""Tiles: a map of any size, of which only what lies round the robot is at hand.

The world is cut into boxes of some meters. A block of them is at hand: the rows of their voxels lie
in one `MapState` whose capacity stays, their cells in arrays whose shape stays. Of all other tiles
there are compact arrays on the host, by tile; planners share them, and none is ever written to.
When the robot has left the tile in the middle of the block, `page` moves the block: tiles that it
leaves behind go out of the table, those that it comes to join it, and what was removed is gone.

Exact: the rows at hand and those of the tiles are the rows of the map without tiles, bit for bit,
as long as no frame reaches beyond the block; `lattice_for` makes it large enough for a camera.

Shape symbols: N capacity of the map; n voxels; X Y Z cells at hand.
"""

import functools
import itertools
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import EMPTY_WORD, INDEX_LIMIT, check_near_origin
from r3jax.kernels.constants import JOINED, LOG_ODDS_LIMIT
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.join import merge
from r3jax.mapping.state import MapState
from r3jax.mapping.tile_files import Filed, Rows, Tile, TileFolder, Voxels
from r3jax.mapping.update import MAX_LOAD

ACROSS = 5
"""Tiles at hand along an axis: the robot's own, and two on each side."""

HYSTERESIS = 0.5
"""The block stays until the robot is so far out of its middle tile [m]: on a border it would move
back and forth."""

VOXELS_PER_AREA = 2.5
"""Voxels over one square of the floor as large as a voxel's face: floor, ceiling and walls of rooms
of 6 m have 2.1."""

STORY = 3.0
"""Height of a story [m]. A block that is not cut into levels holds all stories of its box."""

_MASK21 = np.uint32((1 << 21) - 1)


@dataclass(frozen=True)
class Lattice:
    """How the world is cut."""

    origin: tuple[float, float, float]
    """Lower corner of tile (0, 0, 0) [m]."""

    cells: Tile
    """Cells of a tile along each axis."""

    cell_size: float
    """Edge of a cell [m]."""

    num: Tile
    """Tiles at hand along each axis: `ACROSS`, or 1 along an axis that is not cut."""

    reach: float
    """A voxel farther from the camera than this is not touched [m]."""

    @property
    def edge(self) -> np.ndarray:
        """Edges of a tile [m], [3]."""
        return np.array(self.cells) * self.cell_size

    @property
    def shape(self) -> Tile:
        """Cells at hand along each axis."""
        x, y, z = (n * c for n, c in zip(self.num, self.cells, strict=True))
        return x, y, z

    @property
    def size(self) -> np.ndarray:
        """Edges of the block at hand [m], [3]."""
        return np.array(self.shape) * self.cell_size

    def corner(self, middle: Tile) -> np.ndarray:
        """Computes the lower corner of the block round a tile [m], [3]."""
        first = np.array(middle) - np.array(self.num) // 2
        return np.array(self.origin) + first * self.edge

    def tiles_of(self, points: np.ndarray) -> np.ndarray:
        """Finds the tile of each point, [3, n] int64, from coordinates [3, n] [m]."""
        tile = np.floor((points - np.array(self.origin)[:, None]) / self.edge[:, None])
        # Along an axis that is not cut there is one tile, wherever it may end.
        return np.where(np.array(self.num)[:, None] == 1, 0, tile).astype(np.int64)

    def block(self, middle: Tile) -> Iterable[Tile]:
        """Lists the tiles of the block round a tile."""
        x, y, z = (range(m - n // 2, m + n // 2 + 1) for m, n in zip(middle, self.num, strict=True))
        return itertools.product(x, y, z)


def lattice_for(config: MappingConfig, camera: Camera, box: np.ndarray) -> Lattice:
    """Cuts the world so that no frame of a camera reaches beyond the tiles at hand.

    Args:
        config: voxels, cells, range.
        camera: the widest of all cameras whose frames come in.
        box: of the space to explore, [2, 3] [m]; may be infinite. An axis along which it fits into
            the block is not cut.
    """
    # A range is a depth for points of pixels: in the corner of an image they are farther away.
    reach = config.max_range * longest_ray(camera) + 2.0 * config.voxel_size
    half = (reach + HYSTERESIS) / (ACROSS // 2)
    # Where views are chosen along the level, all that is seen from one place shall be at hand.
    edges = np.array([max(half, config.max_range), max(half, config.max_range), half])
    cells = np.ceil(edges / config.cell_size - 1e-6).astype(int)
    length = np.ceil((box[1] - box[0]) / config.cell_size - 1e-6) + 2.0
    is_whole = length <= ACROSS * cells
    origin = np.where(is_whole, box[0] - config.cell_size, 0.0)
    cells = np.where(is_whole, np.minimum(length, 1e6), cells).astype(int)
    num = np.where(is_whole, 1, ACROSS)
    triple: Any = lambda values, kind: tuple(kind(v) for v in values)
    return Lattice(triple(origin, float), triple(cells, int), config.cell_size,
                   triple(num, int), reach)  # fmt: skip


def longest_ray(camera: Camera) -> float:
    """Computes how much farther than its depth the farthest point of an image is away."""
    x = max(float(camera.cx), camera.width - float(camera.cx)) / float(camera.fx)
    y = max(float(camera.cy), camera.height - float(camera.cy)) / float(camera.fy)
    return math.sqrt(1.0 + x * x + y * y)


def capacity_for(lattice: Lattice, voxel_size: float) -> int:
    """Chooses the rows at hand, a power of two: `VOXELS_PER_AREA` over all floors, at 70 %."""
    x, y, z = lattice.size
    stories = max(1, round(z / STORY)) if lattice.num[2] == 1 else 1
    rows = VOXELS_PER_AREA * x * y * stories / voxel_size**2 / MAX_LOAD
    return 1 << max(12, math.ceil(math.log2(rows)))


class Layer(NamedTuple):
    """Cells of a tile, compressed."""

    data: bytes
    kind: str


@dataclass(frozen=True, eq=False)
class Tiles:
    """All that is not at hand, and where the block at hand lies."""

    lattice: Lattice

    middle: Tile
    """The tile in the middle of the block."""

    capacity: int
    """Rows of the table at hand; more only for as long as what is at hand needs them."""

    voxels: Voxels = field(default_factory=Voxels)
    """Tiles out of the block that hold voxels."""

    cells: Mapping[Tile, Mapping[str, Layer]] = field(default_factory=dict[Tile, dict[str, Layer]])
    """Tiles out of the block of whose cells anything is known."""

    folder: TileFolder | None = None
    """Where tiles go that memory has no room for; None: all have."""

    @property
    def num_voxels(self) -> int:
        """Number of voxels in all tiles."""
        return self.voxels.num_voxels

    @property
    def nbytes(self) -> int:
        """Memory of the tiles that are in memory [bytes]."""
        layers = (len(x.data) for cells in self.cells.values() for x in cells.values())
        return self.voxels.nbytes + sum(layers)


Layers = Mapping[str, np.ndarray]
"""Named numbers of the cells at hand, [X, Y, Z] each; 0: nothing is known."""


def middle_for(tiles: Tiles, position: np.ndarray) -> Tile:
    """Finds the middle tile of the block for a robot's position [3] [m]: most often the same."""
    lattice, middle = tiles.lattice, np.array(tiles.middle)
    own = lattice.tiles_of(np.asarray(position, np.float64)[:, None])[:, 0]
    low = np.array(lattice.origin) + middle * lattice.edge
    gap = np.maximum(low - position, position - (low + lattice.edge))
    x, y, z = (int(i) for i in np.where(gap > HYSTERESIS, own, middle))
    return x, y, z


def page(
    state: MapState, layers: Layers, tiles: Tiles, position: np.ndarray
) -> tuple[MapState, Layers, Tiles]:
    """Moves the block at hand to a position, if it has left the middle of the block.

    Args:
        state: the rows at hand.
        layers: the cells at hand.
        tiles: all others.
        position: of the robot, or of the camera whose frame comes next, [3] [m].

    Returns:
        The same three, unchanged while the robot stays; else in a table without rows of voxels that
        were removed.

    Raises:
        ValueError: a position so far from the origin that float32 cannot tell voxels apart.
        PathError: a tile on disk is missing or damaged, or cannot be written.
    """
    check_near_origin("position", position)
    middle = middle_for(tiles, position)
    if middle == tiles.middle:
        return state, layers, tiles
    cells, layers = _shift(layers, tiles, middle)
    state, voxels = _exchange(state, tiles, middle)
    return state, layers, replace(tiles, middle=middle, cells=cells, voxels=voxels)


def _shift(
    layers: Layers, tiles: Tiles, middle: Tile
) -> tuple[Mapping[Tile, Mapping[str, Layer]], Layers]:
    """Moves the cells at hand: returns the cells of all other tiles, and the arrays."""
    lattice = tiles.lattice
    before, after = set(lattice.block(tiles.middle)), set(lattice.block(middle))
    far = dict(tiles.cells)
    moved = {name: np.zeros_like(x) for name, x in layers.items()}
    far |= _cells_at_hand(layers, tiles, before - after)
    for tile in after:
        to = _slices(lattice, middle, tile)
        if tile in before:
            at = _slices(lattice, tiles.middle, tile)
            for name, x in layers.items():
                moved[name][to] = x[at]
        else:
            for name, layer in far.pop(tile, {}).items():
                moved[name][to] = unpacked_layer(layer, lattice.cells)
    return far, moved


def _slices(lattice: Lattice, middle: Tile, tile: Tile) -> tuple[slice, ...]:
    """Finds a tile's part of the arrays of a block."""
    first = [t - m + n // 2 for t, m, n in zip(tile, middle, lattice.num, strict=True)]
    return tuple(slice(i * c, (i + 1) * c) for i, c in zip(first, lattice.cells, strict=True))


def packed_layer(x: np.ndarray) -> Layer:
    """Compresses the cells of a tile."""
    # Most cells are never touched, or free as can be: a fifth is left of them, at no time.
    return Layer(zlib.compress(np.ascontiguousarray(x).tobytes(), 1), x.dtype.str)


def unpacked_layer(layer: Layer, shape: Tile) -> np.ndarray:
    """Undoes `packed_layer`."""
    return np.frombuffer(zlib.decompress(layer.data), layer.kind).reshape(shape)


_Arrays = dict[str, np.ndarray]
"""Fields of a map by name, the long axis last; in place of the key `whole` [n]: both of its words
as one number."""


def packed_index(index: np.ndarray) -> np.ndarray:
    """Packs voxel indices [3, n] as `geometry.voxels.pack` does, [n] uint64."""
    x, y, z = (index + INDEX_LIMIT).astype(np.uint64)
    return x | (y << np.uint64(21)) | (z << np.uint64(42))


def _index(whole: np.ndarray) -> np.ndarray:
    """Unpacks the voxel indices, [3, n] int64."""
    fields = [(whole >> np.uint64(21 * axis)) & np.uint64(_MASK21) for axis in range(3)]
    return np.stack(fields).astype(np.int64) - INDEX_LIMIT


def _exchange(state: MapState, tiles: Tiles, middle: Tile) -> tuple[MapState, Voxels]:
    """Moves rows between the table and the tiles: returns the table, and the other tiles."""
    # Only here, as below: Numba takes a second to load, and most planners hold no tiles.
    from r3jax.kernels.mapping.paging import LEAVES, MOVES, sort_rows

    lattice, size = tiles.lattice, float(state.voxel_size)
    key = np.asarray(state.key)
    kinds = sort_rows(key, np.asarray(state.present), *_ends_of(lattice, middle, size))
    far, away = tiles.voxels, np.flatnonzero(kinds == LEAVES)
    coming = [tile for tile in lattice.block(middle) if tile in far]
    if not coming and not len(away):
        return state, far

    def packed() -> dict[Tile, Rows]:
        return dict(tile_rows(_rows_of(state, away, _whole(key[:, away])), lattice, size))

    with ThreadPoolExecutor(1) as aside:
        packing = aside.submit(packed)
        new = _joined(_none_of(state), *_expanded_all((far[tile] for tile in coming), state))
        num = int((kinds >= MOVES).sum()) + len(new["whole"])
        if state.capacity == tiles.capacity and num <= MAX_LOAD * tiles.capacity:
            table = table_of(new, state, tiles.capacity, kinds)
        else:
            left = np.flatnonzero(kinds >= MOVES)
            rows = _joined(_rows_of(state, left, _whole(key[:, left])), new)
            table = table_of(rows, state, tiles.capacity)
        leaving = packing.result()
    assert not any(tile in far for tile in leaving), "a frame reached beyond the block"
    after = far.changed(coming, leaving)
    if tiles.folder is not None:
        after = tiles.folder.fit(after, middle)
    return table, after


def _ends_of(lattice: Lattice, middle: Tile, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Finds the lowest and the highest index of a voxel in a block, in the bits of a key, [3]."""
    corner, ends = lattice.corner(middle), np.array([[0] * 3, [int(_MASK21)] * 3])
    for axis in range(3):
        if lattice.num[axis] == 1:
            continue
        for end, side in enumerate((0, lattice.num[axis])):
            # By the rule for tiles itself: rounding must not put a voxel into neither of two.
            near = int((corner[axis] + side * lattice.edge[axis]) / size)
            index = np.arange(near - 3, near + 4)
            tile = lattice.tiles_of(np.tile((index + 0.5) * size, (3, 1)))[axis]
            wanted = middle[axis] - lattice.num[axis] // 2 + side
            ends[end, axis] = index[np.searchsorted(tile, wanted)] + INDEX_LIMIT - end
    first, last = ends.astype(np.uint32)
    return first, last


def _joined(*parts: _Arrays) -> _Arrays:
    """Joins arrays of rows."""
    return {name: np.concatenate([x[name] for x in parts], axis=-1) for name in parts[0]}


def _present_rows(state: MapState) -> tuple[np.ndarray, np.ndarray]:
    """Finds the rows that describe a voxel, and their keys, both words as one number, [n] each."""
    present = np.flatnonzero(np.asarray(state.present))
    return present, _whole(np.asarray(state.key)[:, present])


def _whole(key: np.ndarray) -> np.ndarray:
    """Makes one number of both words of keys [2, n]."""
    low, high = key.astype(np.uint64)
    return low | (high << np.uint64(32))


def _rows_of(state: MapState, rows: np.ndarray, whole: np.ndarray) -> _Arrays:
    """Copies some rows to the host, whose keys are known."""
    names = ("visited", "count", "mean", "m2", "resolution", "misses")
    found = {name: getattr(state, name) for name in names}
    return {"whole": whole} | {
        name: np.take(np.asarray(x), rows, axis=-1) for name, x in found.items() if x is not None
    }


def _none_of(state: MapState) -> _Arrays:
    return _rows_of(state, np.zeros(0, np.int64), np.zeros(0, np.uint64))


def tile_rows(rows: _Arrays, lattice: Lattice, size: float) -> Iterable[tuple[Tile, Rows]]:
    """Sorts rows of voxels of some size by tile, and makes them compact."""
    tile = lattice.tiles_of((_index(rows["whole"]) + 0.5) * size)
    if not tile.size:
        return
    low, num = tile.min(axis=1), np.ptp(tile, axis=1) + 1
    number = np.asarray(np.ravel_multi_index(tuple(tile - low[:, None]), tuple(num)))
    order = np.argsort(rows["whole"])
    # Small numbers are sorted by counting.
    order = order[np.argsort(number[order].astype(np.min_scalar_type(np.prod(num))), kind="stable")]
    cuts = np.flatnonzero(np.diff(number[order])) + 1
    for part in np.split(order, cuts):
        x, y, z = (int(i) for i in tile[:, part[0]])
        yield (x, y, z), _compact({name: np.take(a, part, axis=-1) for name, a in rows.items()})


def _compact(rows: _Arrays) -> Rows:
    """Stores rows of one tile, in the order of their places, in as few bytes as hold them."""
    index = _index(rows["whole"])
    low = index.min(axis=1)
    span = index.max(axis=1) - low + 1
    place = ((index[0] - low[0]) * span[1] + index[1] - low[1]) * span[2] + index[2] - low[2]
    fields = {name: x for name, x in rows.items() if name != "whole"}
    return _shortest(np.stack([low, span]), place, fields)


def _shortest(box: np.ndarray, place: np.ndarray, fields: _Arrays) -> Rows:
    """Makes rows of the shortest kinds of numbers that hold them."""
    count, misses = fields["count"], fields.get("misses")
    whole = count.astype(np.min_scalar_type(int(count.max())))
    return Rows(
        box=box,
        place=place.astype(np.min_scalar_type(max(int(place.max()), 1 << 16))),
        visited=fields["visited"],
        # Observations are counted in whole numbers, but for maps that others have weighted.
        count=whole if np.array_equal(whole, count) else count,
        mean=fields["mean"],
        m2=fields["m2"],
        resolution=fields["resolution"],
        misses=misses if misses is not None and misses.any() else None,
    )


def _expanded_all(tiles: Iterable[Rows], like: MapState) -> list[_Arrays]:
    """Undoes `_compact` for the tiles of a map."""
    return [_expanded(rows, counts_misses=like.misses is not None) for rows in tiles]


def _expanded(rows: Rows, *, counts_misses: bool) -> _Arrays:
    """Undoes `_compact`."""
    (low, span), place = rows.box, rows.place.astype(np.int64)
    offset = np.stack([place // (span[1] * span[2]), place // span[2] % span[1], place % span[2]])
    arrays = {name: getattr(rows, name) for name in ("visited", "mean", "m2", "resolution")}
    if counts_misses:
        none = np.zeros(len(place), np.uint8)
        arrays["misses"] = none if rows.misses is None else rows.misses
    return arrays | {
        "count": rows.count.astype(np.float32),
        "whole": packed_index(offset + low[:, None]),
    }


def table_of(
    rows: _Arrays, like: MapState, capacity: int, kinds: np.ndarray | None = None
) -> MapState:
    """Builds a table of rows: of `capacity`, or larger if they need it.

    Args:
        rows: rows of distinct voxels.
        like: a map with the same voxels.
        capacity: of the table.
        kinds: of `sort_rows`: rows of `like` that stay, or move within the table, which is then as
            large as `like`. None: there are none.
    """
    from r3jax.kernels.mapping.paging import MOVES, STAYS, fill_rows

    while kinds is None and len(rows["whole"]) > MAX_LOAD * capacity:
        capacity *= 2
    words = rows["whole"] & np.uint64(0xFFFFFFFF), rows["whole"] >> np.uint64(32)
    rows = rows | {"key": np.stack(words).astype(np.uint32)}
    stays = np.zeros(capacity, np.uint8) if kinds is None else kinds
    moved = np.flatnonzero(stays == MOVES)
    key = np.concatenate([np.asarray(like.key)[:, moved], rows["key"]], axis=1)
    row = _places(key, stays == STAYS)
    arrays: dict[str, Any] = {}
    for name, x in rows.items():
        if name != "whole":
            field = _aligned((*x.shape[:-1], capacity), x.dtype)
            old = field if kinds is None else np.asarray(getattr(like, name))
            words = (np.atleast_2d(a.view(f"u{x.itemsize}")) for a in (old, x, field))
            empty = np.array(EMPTY_WORD if name == "key" else 0, f"u{x.itemsize}")[()]
            for before, values, into in zip(*words, strict=True):
                fill_rows(before, stays, moved, values, row, empty, into)
            arrays[name] = jax.device_put(field)
    return replace(like, **arrays)


def table_from(state: MapState, rows: np.ndarray, capacity: int) -> tuple[MapState, np.ndarray]:
    """Builds a table of some rows of a map: of `capacity`, or larger if they need it.

    Args:
        state: the map.
        rows: which of its rows, [n]; they hold voxels.
        capacity: of the table.

    Returns:
        The table, and the row of `state` that each of its rows holds; the capacity of `state` for
        empty rows.
    """
    key = np.asarray(state.key)[:, rows]
    table = table_of(_rows_of(state, rows, _whole(key)), state, capacity)
    origin = np.full(table.capacity, state.capacity)
    origin[_places(key, np.zeros(table.capacity, bool))] = rows
    return table, origin


class Union:
    """Collects the voxels of many maps of one voxel size, one after the other.

    Equal to `mapping.join.merge` up to rounding, in time that does not grow with the union.
    """

    def __init__(self, most: int) -> None:
        """Starts without voxels.

        Args:
            most: maximum number of voxels.
        """
        self._parts: list[_Arrays] = []
        self._most, self._united = most, 0

    def add(self, state: MapState) -> None:
        """Adds the voxels of a map.

        Raises:
            ValueError: there are more than the maximum.
        """
        self._parts.append(_rows_of(state, *_present_rows(state)))
        # Each time they have doubled: every row is then sorted a few times in all.
        if sum(len(part["whole"]) for part in self._parts) > 2 * self._united + self._most // 8:
            self._unite()

    def table(self, like: MapState) -> MapState:
        """Builds a table of all voxels, no smaller than that of a map of the same voxels.

        Raises:
            ValueError: there are more than the maximum.
        """
        self._unite()
        return table_of(self._parts[0], like, like.capacity)

    def _unite(self) -> None:
        self._parts = [_united(_joined(*self._parts))]
        self._united = len(self._parts[0]["whole"])
        if self._united > self._most:
            raise InputError(f"the maps hold more than {self._most} voxels")


def _united(rows: _Arrays) -> _Arrays:
    """Unites rows of the same voxels, as `mapping.join.combine_moments` does for two."""
    order = np.argsort(rows["whole"], kind="stable")
    rows = {name: np.take(x, order, axis=-1) for name, x in rows.items()}
    first = np.flatnonzero(np.diff(rows["whole"], prepend=~rows["whole"][:1]))
    group = np.repeat(np.arange(len(first)), np.diff(first, append=len(order)))
    count = np.add.reduceat(rows["count"], first)
    total = np.add.reduceat(rows["count"] * rows["mean"], first, axis=-1, dtype=np.float64)
    mean = (total / np.maximum(count, 1.0)).astype(np.float32)
    # About the means: sums of squares minus squared sums would cancel in float32.
    apart = ((rows["mean"] - mean[:, group]) ** 2).sum(axis=0)
    return {
        "whole": rows["whole"][first],
        "visited": np.bitwise_or.reduceat(rows["visited"], first, axis=-1),
        "count": count,
        "mean": mean,
        "m2": np.add.reduceat(rows["m2"] + rows["count"] * apart, first),
        "resolution": np.maximum.reduceat(rows["resolution"], first),
    }


def _aligned(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    """Makes an array that JAX need not copy: one that begins at a multiple of 64 bytes."""
    num = math.prod(shape) * kind.itemsize
    memory = np.empty(num + 64, np.uint8)
    begin = -memory.ctypes.data % 64
    return memory[begin : begin + num].view(kind).reshape(shape)


def _places(key: np.ndarray, is_taken: np.ndarray) -> np.ndarray:
    """Finds a row for each of distinct keys [2, n] in a table of which some rows [N] are taken."""
    from r3jax.kernels.mapping.paging import place_keys

    rows = place_keys(key, is_taken)
    if (rows < 0).any():
        raise RuntimeError(f"{(rows < 0).sum()} voxels found no row of {len(is_taken)}")
    return rows


def check_view(tiles: Tiles, camera: Camera, max_range: float, voxel_size: float) -> None:
    """Refuses a camera whose frames would reach beyond the tiles at hand.

    Raises:
        ValueError: its field of view is wider than that of the camera at the start.
    """
    reach = max_range * longest_ray(camera) + 2.0 * voxel_size
    if reach > tiles.lattice.reach * (1.0 + 1e-6):
        raise InputError(
            f"the frame's camera sees {reach:.1f} m far into its corners, the one that the planner "
            f"was started for {tiles.lattice.reach:.1f} m: start it with the widest camera"
        )


def whole_map(state: MapState, tiles: Tiles) -> MapState:
    """Joins the rows at hand and those of all tiles in one table, as large as it must be."""
    more = _expanded_all(tiles.voxels.values(), state)
    rows = _joined(_rows_of(state, *_present_rows(state)), *more)
    return table_of(rows, state, state.capacity)


World = tuple[MapState, Layers, Tiles]
"""Rows at hand, cells at hand, and all others."""

_FITTED = 64
"""While maps are merged, tiles go to disk after this number of new ones."""


def merge_worlds(worlds: Sequence[World]) -> World:
    """Merges several maps of one lattice tile by tile: `mapping.join.merge` of their voxels.

    No table is larger than that of two tiles or of the block. Cells add up; log-odds are clipped as
    after a frame.

    Args:
        worlds: of one lattice.

    Returns:
        All of them, with the first one's block at hand.

    Raises:
        ValueError: voxel sizes or numbers of bins that differ.
        PathError: a tile on disk is missing or damaged, or cannot be written.
    """
    state, layers, tiles = worlds[0]
    every = [_all_voxels(state, tiles) for state, _, tiles in worlds]
    memory, disk = dict[Tile, Rows](), dict[Tile, Filed]()
    for i, tile in enumerate(sorted(set[Tile]().union(*every))):
        held = [each for each in every if tile in each]
        if len(held) == 1 and tile in held[0].disk:
            disk[tile] = held[0].disk[tile]
            continue
        parts = (each[tile] for each in held)
        memory[tile] = functools.reduce(lambda a, b: _merged(a, b, state), parts)
        if tiles.folder is not None and i % _FITTED == 0:
            fitting = tiles.folder.fit(Voxels(memory, disk), tiles.middle)
            memory, disk = dict(fitting.memory), dict(fitting.disk)
    voxels = Voxels(memory, disk)
    coming = [tile for tile in tiles.lattice.block(tiles.middle) if tile in voxels]
    rows = _joined(_none_of(state), *_expanded_all((voxels[tile] for tile in coming), state))
    table = table_of(rows, state, tiles.capacity)
    # Voxels that any of them dropped are missing from the union, too.
    table = replace(table, dropped=jnp.int32(sum(int(s.dropped) for s, _, _ in worlds)))
    voxels = voxels.changed(coming, {})
    voxels = voxels if tiles.folder is None else tiles.folder.fit(voxels, tiles.middle)
    cells, layers = _merged_cells(worlds)
    return table, layers, replace(tiles, voxels=voxels, cells=cells)


def _all_voxels(state: MapState, tiles: Tiles) -> Voxels:
    """Lists the voxels of all tiles, those at hand too."""
    rows = _rows_of(state, *_present_rows(state))
    here = dict(tile_rows(rows, tiles.lattice, float(state.voxel_size)))
    return tiles.voxels.changed((), here)


def _merged(a: Rows, b: Rows, like: MapState) -> Rows:
    """Merges the voxels of a tile in two maps."""
    num = len(a.place) + len(b.place)
    # At least one whole chunk: XLA rounds shorter ones in another way.
    capacity = max(JOINED, 1 << math.ceil(math.log2(num / MAX_LOAD)))
    one, other = (table_of(rows, like, capacity) for rows in _expanded_all((a, b), like))
    both = merge(one, other)
    rows = _rows_of(both, *_present_rows(both))
    order = np.argsort(rows["whole"])
    return _compact({name: x[..., order] for name, x in rows.items()})


def _merged_cells(worlds: Sequence[World]) -> tuple[Mapping[Tile, Mapping[str, Layer]], Layers]:
    """Adds up the cells of maps: returns those of far tiles, and the arrays of the first block."""
    _, layers, tiles = worlds[0]
    lattice, middle = tiles.lattice, tiles.middle
    block = set(lattice.block(middle))
    far: dict[Tile, dict[str, Layer]] = {}
    here = {name: np.zeros_like(x) for name, x in layers.items()}
    every = [
        {**tiles.cells, **_cells_at_hand(layers, tiles, lattice.block(tiles.middle))}
        for _, layers, tiles in worlds
    ]
    for tile in set[Tile]().union(*every):
        for name, like in layers.items():
            found = [cells[tile][name] for cells in every if name in cells.get(tile, {})]
            if len(found) == 1 and tile not in block:
                far.setdefault(tile, {})[name] = found[0]
            elif found:
                total = sum(unpacked_layer(layer, lattice.cells) for layer in found)
                if name == "log_odds":
                    total = np.clip(total, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)
                total = np.asarray(total, like.dtype)
                if tile in block:
                    here[name][_slices(lattice, middle, tile)] = total
                else:
                    far.setdefault(tile, {})[name] = packed_layer(total)
    return far, here


def _cells_at_hand(
    layers: Layers, tiles: Tiles, which: Iterable[Tile]
) -> dict[Tile, dict[str, Layer]]:
    """Packs the cells of tiles at hand of which anything is known."""
    packed: dict[Tile, dict[str, Layer]] = {}
    for tile in which:
        at = _slices(tiles.lattice, tiles.middle, tile)
        found = {name: packed_layer(x[at]) for name, x in layers.items() if x[at].any()}
        if found:
            packed[tile] = found
    return packed


def arrays_of(tiles: Tiles) -> dict[str, np.ndarray]:
    """Lists all that tiles hold as some arrays, to be stored: the inverse of `with_arrays`."""
    arrays = {"middle": np.array(tiles.middle), "capacity": np.array(tiles.capacity)}
    voxels = list(tiles.voxels.items())
    if voxels:
        every = [rows for _, rows in voxels]
        arrays["voxels.tile"] = np.array([tile for tile, _ in voxels])
        arrays["voxels.num"] = np.array([len(rows.place) for rows in every])
        arrays["voxels.box"] = np.stack([rows.box for rows in every])
        arrays["voxels.place"] = np.concatenate([rows.place for rows in every])
        expanded = [_expanded(rows, counts_misses=True) for rows in every]
        for name in expanded[0].keys() - {"whole"}:
            arrays[f"voxels.{name}"] = np.concatenate([x[name] for x in expanded], axis=-1)
    for name in sorted({name for layers in tiles.cells.values() for name in layers}):
        found = [(tile, layers[name]) for tile, layers in tiles.cells.items() if name in layers]
        arrays[f"cells.{name}.tile"] = np.array([tile for tile, _ in found])
        arrays[f"cells.{name}.num"] = np.array([len(layer.data) for _, layer in found])
        data = b"".join(layer.data for _, layer in found)
        arrays[f"cells.{name}.data"] = np.frombuffer(data, np.uint8)
    return arrays


def with_arrays(tiles: Tiles, arrays: Mapping[str, np.ndarray], kinds: Mapping[str, str]) -> Tiles:
    """Fills tiles with stored arrays.

    Args:
        tiles: of the same lattice.
        arrays: of `arrays_of`.
        kinds: type of the numbers of each layer.

    Raises:
        KeyError: an array is missing.
        ValueError: arrays that do not fit together.
    """
    voxels, cells = dict[Tile, Rows](), dict[Tile, dict[str, Layer]]()
    if "voxels.tile" in arrays:
        names = ("visited", "count", "mean", "m2", "resolution", "misses")
        for i, tile, part in _parts(arrays["voxels.tile"], arrays["voxels.num"]):
            fields = {name: arrays[f"voxels.{name}"][..., part] for name in names}
            voxels[tile] = _shortest(arrays["voxels.box"][i], arrays["voxels.place"][part], fields)
    for name, kind in kinds.items():
        if f"cells.{name}.tile" in arrays:
            data = arrays[f"cells.{name}.data"]
            tiles_of_layer = arrays[f"cells.{name}.tile"], arrays[f"cells.{name}.num"]
            for _, tile, part in _parts(*tiles_of_layer):
                cells.setdefault(tile, {})[name] = Layer(data[part].tobytes(), kind)
    x, y, z = (int(i) for i in arrays["middle"])
    capacity = int(arrays["capacity"])
    return replace(tiles, middle=(x, y, z), capacity=capacity, voxels=Voxels(voxels), cells=cells)


def _parts(tile: np.ndarray, num: np.ndarray) -> Iterable[tuple[int, Tile, slice]]:
    """Lists each tile's number, name and part of arrays in which all follow one another."""
    ends = np.cumsum(num)
    for i, (x, y, z) in enumerate(tile):
        yield i, (int(x), int(y), int(z)), slice(int(ends[i] - num[i]), int(ends[i]))
