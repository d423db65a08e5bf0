"""Tiles in memory and on disk: what leaves the table, packed without loss into files.

A tile's file is written once, read when its tile comes to hand, and deleted when no planner refers
to it any more. Each use of a tile folder has a locked folder of its own in it, so that processes
can share one. What a killed process has left there is deleted by the next one: it is scratch, and
planners are stored by `runs.saved_planner`, whose folders hold the same files under their hashes.

Shape symbols: n voxels of a tile; W words of bins.
"""

import contextlib
import hashlib
import itertools
import json
import os
import re
import secrets
import weakref
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from r3jax import files
from r3jax.errors import InputError, PathError

Tile = tuple[int, int, int]
"""Number of a tile along each axis."""

TILE_MEMORY = 1e9
"""Memory for tiles, where there is a folder for the others [bytes]."""

_MAGIC = b"r3jax tile 1\n"
_NAME = re.compile("[0-9a-f]{64}.tile")
_REMEDY = "map its frames again: r3jax.rebuild(planner, frames)"


@dataclass(frozen=True, eq=False)
class Rows:
    """The voxels of one tile, sorted by place.

    With 64 bins and fewer than 256 observations 33 bytes each, 34 where one of them was looked
    through: 4 for the place, 8 for the bins, 1 for the count, 20 for five floats that stay as they
    are. In the table a row takes 41, and there is room for more of them.
    """

    box: np.ndarray
    """Lowest index of a voxel along each axis, and how many there are, [2, 3]."""

    place: np.ndarray
    """Number of the voxel in that box, [n]."""

    visited: np.ndarray
    """[W, n] uint32."""

    count: np.ndarray
    """[n]; of the shortest kind of integer that holds them all."""

    mean: np.ndarray
    """[3, n] float32."""

    m2: np.ndarray
    """[n] float32."""

    resolution: np.ndarray
    """[n] float32."""

    misses: np.ndarray | None
    """[n] uint8; None: all 0."""

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return sum(x.nbytes for x in vars(self).values() if x is not None)


_STEPS = ("place", "mean", "resolution")
"""Fields of which neighbors differ little: their differences are stored, of the bits of floats."""


def packed_rows(rows: Rows) -> bytes:
    """Packs the rows of a tile without loss: `unpacked_rows` returns the same bits.

    In real maps 14 to 16 bytes a voxel: about half of the bits of floats are noise.
    """
    notes: dict[str, list[object]] = {}
    parts: list[bytes] = []
    for name, x in vars(rows).items():
        if x is not None:
            whole = x.view(f"u{x.itemsize}")
            if name == "mean":  # green and blue are like red
                whole = np.concatenate([whole[:1], whole[1:] - whole[:1]])
            if name in _STEPS:
                whole = np.diff(whole, axis=-1, prepend=whole.dtype.type(0))
            data = _squeezed(whole)
            notes[name] = [x.dtype.str, list(x.shape), len(data)]
            parts.append(data)
    head = json.dumps(notes).encode()
    return b"".join([_MAGIC, len(head).to_bytes(4, "little"), head, *parts])


def unpacked_rows(data: bytes) -> Rows:
    """Undoes `packed_rows`.

    Raises:
        ValueError: other data.
    """
    if not data.startswith(_MAGIC):
        raise InputError("these are not the rows of a tile")
    begin = len(_MAGIC) + 4
    end = begin + int.from_bytes(data[begin - 4 : begin], "little")
    arrays: dict[str, Any] = {"misses": None}
    for name, (kind, shape, num) in json.loads(data[begin:end]).items():
        whole = _unsqueezed(data[end : end + num], np.dtype(kind).itemsize).reshape(shape)
        end += num
        if name in _STEPS:
            whole = np.cumsum(whole, axis=-1, dtype=whole.dtype)
        if name == "mean":
            whole[1:] += whole[:1]
        arrays[name] = whole.view(kind)
    return Rows(**arrays)


def _squeezed(whole: np.ndarray) -> bytes:
    """Compresses integers: all bytes of one weight together, with a code of their own."""
    size = whole.itemsize
    planes = np.ascontiguousarray(whole).view(np.uint8).reshape(-1, size).T
    # No search for repeats: there are none in noise, and it takes ten times as long.
    squeeze = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
    parts = [squeeze.compress(x.tobytes()) + squeeze.flush(zlib.Z_BLOCK) for x in planes]
    return b"".join([*parts, squeeze.flush()])


def _unsqueezed(data: bytes, size: int) -> np.ndarray:
    """Undoes `_squeezed`, for integers of `size` bytes, [n]."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(size, -1)
    return np.ascontiguousarray(planes.T).view(f"u{size}")[:, 0]


@dataclass(frozen=True, eq=False)
class Filed:
    """The voxels of a tile, in a file."""

    path: Path
    """The file."""

    sha256: str
    """Of the file's content."""

    num: int
    """Voxels."""

    folder: "TileFolder | None" = None
    """Its folder, which stays as long as this is in use."""

    def data(self) -> bytes:
        """Reads the file.

        Raises:
            PathError: it is missing or damaged.
        """
        try:
            data = self.path.read_bytes()
        except OSError as error:
            reason = f"a tile of the map cannot be read ({error.strerror}): {_REMEDY}"
            raise PathError(self.path, reason) from None
        if hashlib.sha256(data).hexdigest() != self.sha256:
            reason = "a tile of the map is damaged (its SHA-256 differs)"
            raise PathError(self.path, f"{reason}: {_REMEDY}")
        return data

    def read(self) -> Rows:
        """Reads the voxels.

        Raises:
            PathError: the file is missing or damaged.
        """
        return unpacked_rows(self.data())


@dataclass(frozen=True, eq=False)
class Voxels:
    """Voxels by tile: of some tiles in memory, of the others in files, which are read when used."""

    memory: Mapping[Tile, Rows] = field(default_factory=dict[Tile, Rows])
    """Tiles in memory."""

    disk: Mapping[Tile, Filed] = field(default_factory=dict[Tile, Filed])
    """Tiles in files."""

    def __getitem__(self, tile: Tile) -> Rows:
        """Returns the voxels of a tile, from disk if they are there."""
        rows = self.memory.get(tile)
        return self.disk[tile].read() if rows is None else rows

    def __iter__(self) -> Iterator[Tile]:
        """Lists all tiles; reads none."""
        return itertools.chain(self.memory, self.disk)

    def items(self) -> Iterator[tuple[Tile, Rows]]:
        """Lists all tiles with their voxels; reads one after the other."""
        return ((tile, self[tile]) for tile in self)

    def values(self) -> Iterator[Rows]:
        """Lists the voxels of all tiles; reads one tile after the other."""
        return (self[tile] for tile in self)

    def __len__(self) -> int:
        """Counts the tiles."""
        return len(self.memory) + len(self.disk)

    def __contains__(self, tile: object) -> bool:
        """Checks for a tile; reads none."""
        return tile in self.memory or tile in self.disk

    def changed(self, gone: Iterable[Tile], new: Mapping[Tile, Rows]) -> "Voxels":
        """Takes tiles out, and adds others in memory."""
        without = set(gone)
        memory = {tile: rows for tile, rows in self.memory.items() if tile not in without}
        disk = {tile: filed for tile, filed in self.disk.items() if tile not in without}
        return Voxels(memory | dict(new), disk)

    def num_in(self, tile: Tile) -> int:
        """Returns the number of voxels in a tile; reads nothing."""
        rows = self.memory.get(tile)
        return self.disk[tile].num if rows is None else len(rows.place)

    @property
    def num_voxels(self) -> int:
        """Number of voxels."""
        return sum(self.num_in(tile) for tile in self)

    @property
    def nbytes(self) -> int:
        """Memory of the tiles that are in memory [bytes]."""
        return sum(rows.nbytes for rows in self.memory.values())


@dataclass(frozen=True, eq=False)
class TileFolder:
    """A place for the tiles of this process that memory has no room for. See `open_tile_folder`."""

    own: Path
    """Folder of this process, in the one that the user gave."""

    most_bytes: float | int
    """Tiles in memory take at most this [bytes]."""

    numbers: Iterator[int] = field(default_factory=itertools.count)
    """Numbers for files."""

    def add(self, data: bytes, num: int) -> Filed:
        """Writes the packed voxels of a tile into a new file.

        Raises:
            PathError: the disk is full, or not writable.
        """
        path = self.own / f"{next(self.numbers):06d}.tile"
        try:
            files.write_atomic(path, data, durable=False)
        except OSError as error:
            raise PathError(
                path,
                f"a tile of the map cannot be written ({error.strerror}): free some space and "
                "repeat the call with the same planner, which lost nothing; or save it, and load "
                "it with another tile_folder or a larger tile_memory",
            ) from None
        filed = Filed(path, hashlib.sha256(data).hexdigest(), num, self)
        weakref.finalize(filed, _remove, path, os.getpid()).atexit = False  # all go together then
        return filed

    def fit(self, voxels: Voxels, middle: Tile) -> Voxels:
        """Moves tiles to disk until the others fit into memory: the farthest from `middle` first.

        Raises:
            PathError: the disk is full, or not writable.
        """
        excess = voxels.nbytes - self.most_bytes
        if excess <= 0:
            return voxels
        memory, disk = dict(voxels.memory), dict(voxels.disk)
        gap: Callable[[Tile], float] = lambda tile: sum(
            (a - b) ** 2 for a, b in zip(tile, middle, strict=True)
        )
        for tile in sorted(memory, key=gap, reverse=True):
            rows = memory.pop(tile)
            disk[tile] = self.add(packed_rows(rows), len(rows.place))
            excess -= rows.nbytes
            if excess <= 0:
                break
        return Voxels(memory, disk)


def open_tile_folder(folder: str | Path, most_bytes: float | int) -> TileFolder:
    """Opens a folder for tiles: new, empty, or used for tiles before; several processes may.

    Args:
        folder: on a local disk.
        most_bytes: of tiles in memory.

    Raises:
        PathError: it holds something else, or cannot be written.
    """
    folder = Path(folder).absolute()
    own = folder / f"process-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        files.own_folder(folder, "tile-folder")
        with files.lock_file(folder / "lock", wait=True):
            for old in folder.glob("process-*"):
                if files.kind_of(old) == "tile-folder":
                    with contextlib.suppress(OSError):  # in use, or of another user
                        _empty(old, files.lock_folder(old))
            files.own_folder(own, "tile-folder")
            lock = files.lock_folder(own)
    except files.NotOursError as error:
        raise PathError(error.path, error.reason) from None
    except OSError as error:
        raise PathError(
            folder,
            f"tiles cannot be written there ({error.strerror}): give start another tile_folder",
        ) from None
    opened = TileFolder(own, most_bytes)
    weakref.finalize(opened, _close, own, lock, os.getpid())
    return opened


def _remove(path: Path, process: int) -> None:
    """Deletes a file that this process has written; not in a fork of the process."""
    if process == os.getpid():
        with contextlib.suppress(OSError):
            files.remove(path)


def _close(own: Path, lock: contextlib.ExitStack, process: int) -> None:
    """Deletes all tiles of this process, and frees its folder."""
    if process == os.getpid():
        with contextlib.suppress(OSError):
            _empty(own, lock)


def _empty(own: Path, lock: contextlib.ExitStack) -> None:
    """Deletes tiles that no process uses, with their folder; what else lies in it stays."""
    with lock:
        files.remove_own(own.parent, [f"{own.name}/*.tile"])
        files.disown_folder(own)
    files.remove_own(own.parent, [f"{own.name}/lock"])


def write_tiles(voxels: Voxels, folder: Path) -> dict[str, np.ndarray]:
    """Writes all tiles into a folder, under their hashes, and lists them for `read_tiles`.

    A file that is there already stays, so that only new tiles are written.

    Raises:
        PathError: a tile on disk is missing or damaged.
        OSError: the disk is full, not writable, ...
    """
    files.make_folder(folder)
    names: list[str] = []
    for tile in voxels:
        rows = voxels.memory.get(tile)
        data = voxels.disk[tile].data() if rows is None else packed_rows(rows)
        name = hashlib.sha256(data).hexdigest()
        path = folder / f"{name}.tile"
        try:
            Filed(path, name, 0).data()
        except PathError:  # not there, or damaged
            files.write_atomic(path, data)
        names.append(name)
    numbers = [voxels.num_in(tile) for tile in voxels]
    return {
        "tile": np.array(list(voxels), np.int64).reshape(-1, 3),
        "num": np.array(numbers, np.int64),
        "sha256": np.array([list(bytes.fromhex(n)) for n in names], np.uint8).reshape(-1, 32),
    }


def read_tiles(
    folder: Path, listed: Mapping[str, np.ndarray], into: TileFolder | None, middle: Tile
) -> Voxels:
    """Reads tiles that `write_tiles` has listed; those that memory has no room for are copied.

    Args:
        folder: with their files.
        listed: by `write_tiles`.
        into: folder for those that memory has no room for.
        middle: tile round which they stay in memory.

    Raises:
        PathError: a file is missing or damaged; or a copy cannot be written.
        KeyError: nothing is listed.
    """
    tiles = [(int(x), int(y), int(z)) for x, y, z in listed["tile"]]
    names = [bytes(row).hex() for row in listed["sha256"].astype(np.uint8)]
    memory, disk, used = dict[Tile, Rows](), dict[Tile, Filed](), 0
    order = np.argsort(((listed["tile"] - np.array(middle)) ** 2).sum(axis=1), kind="stable")
    for i in order:
        num = int(listed["num"][i])
        data = Filed(folder / f"{names[i]}.tile", names[i], num).data()
        if into is None or used < into.most_bytes:
            memory[tiles[i]] = unpacked_rows(data)
            used += memory[tiles[i]].nbytes
        else:
            disk[tiles[i]] = into.add(data, num)
    voxels = Voxels(memory, disk)
    return voxels if into is None else into.fit(voxels, middle)


def remove_other_tiles(folder: Path, listed: Mapping[str, np.ndarray]) -> None:
    """Deletes the files of tiles in a folder of ours that are not listed."""
    names = {bytes(row).hex() for row in listed["sha256"].astype(np.uint8)}
    others = [path.name for path in folder.glob("*.tile") if path.stem not in names]
    ours = [name for name in others if _NAME.fullmatch(name)]
    files.remove_own(folder.parent, [f"{folder.name}/{name}" for name in ours])
