"""Colored points as PLY: the initial points of 3DGS, and point clouds of other programs.

The reader is written by hand. Of the 13 kinds of damage in its tests, trimesh accepts seven (a
missing point, a doubled name, numbers that are not finite); plyfile allocates memory for all
declared points before counting them, accepts positions that are not finite, and has another license
(GPL).

Shape symbols: n points.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r3jax.errors import InputError
from r3jax.files import write_atomic
from r3jax.formats.errors import naming
from r3jax.mapping.state import MapState
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes

_MAX_BYTES = 4 << 30
"""Scans of buildings are no larger."""

_MAX_HEADER = 1 << 16
"""A header has some hundred bytes."""

_KINDS = {
    name: kind
    for kind, names in {
        "i1": "char int8",
        "u1": "uchar uint8",
        "i2": "short int16",
        "u2": "ushort uint16",
        "i4": "int int32",
        "u4": "uint uint32",
        "f4": "float float32",
        "f8": "double float64",
    }.items()
    for name in names.split()
}
"""NumPy's number types by PLY's names."""

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}

_GRAY = 128
"""Color of points without one."""


@dataclass(frozen=True)
class _Vertices:
    """What the header says of them."""

    order: str
    """NumPy's byte order; empty: text."""

    count: int
    fields: tuple[tuple[str, str], ...]
    """Names and number types."""

    start: int
    """Byte at which they begin."""


def read_points(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Reads positions [n, 3] float64 and colors [n, 3] uint8 of the vertices.

    Vertices without a color are gray.

    The file may be binary of either byte order or text. Other properties are skipped, and other
    elements behind the vertices too.

    Raises:
        FormatError: the file is missing, not a PLY or cut off; the vertices are not its first
            element, have lists or no position, or one that is not finite.
    """
    table = read_point_table(path)
    xyz = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    with naming(Path(path)):
        if not np.all(np.isfinite(xyz)):
            bad = int(np.argmin(np.isfinite(xyz).all(axis=1)))
            raise ForeignFileError(f"the position of point {bad} is not finite")
        return xyz, _colors(table)


def read_point_table(path: Path | str) -> np.ndarray:
    """Reads all properties of the vertices, a structured array [n].

    Raises:
        FormatError: as `read_points`, but for positions that are not finite.
    """
    path = Path(path)
    with naming(path):
        data = read_bytes(path, _MAX_BYTES)
        vertices = _header(data)
        return _text_table(data, vertices) if not vertices.order else _table(data, vertices)


def _header(data: bytes) -> _Vertices:
    end = data.find(b"end_header", 0, _MAX_HEADER)
    line_end = data.find(b"\n", end) if end >= 0 else -1
    if not data.startswith(b"ply") or line_end < 0:
        raise ForeignFileError(
            "this is not a PLY file (no `ply` at its beginning, or no end_header)"
        )
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    order, count = None, None
    fields: dict[str, str] = {}
    for words in lines[1:]:
        if words[:1] == ["format"] and len(words) == 3:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            if count is not None:
                break
            count = _count(words)
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _KINDS or words[2] in fields:
                raise ForeignFileError(f"the vertices have the property {' '.join(words)[:80]!r}")
            fields[words[2]] = _KINDS[words[1]]
    if order is None or count is None:
        raise ForeignFileError("the header has no known format, or no element")
    missing = sorted(set("xyz") - fields.keys())
    if missing:
        raise ForeignFileError(f"the vertices are missing {', '.join(missing)}")
    return _Vertices(order, count, tuple(fields.items()), line_end + 1)


def _count(words: list[str]) -> int:
    if len(words) != 3 or words[1] != "vertex" or not words[2].isdecimal() or len(words[2]) > 18:
        raise ForeignFileError(f"the first element is {' '.join(words)[:80]!r}, not the vertices")
    return int(words[2])


def _check_length(vertices: _Vertices, row: int, left: int) -> None:
    if vertices.count * row > left:
        raise ForeignFileError(
            f"it is truncated: it declares {vertices.count} points, and only {left} bytes follow"
        )


def _table(data: bytes, vertices: _Vertices) -> np.ndarray:
    kind = np.dtype([(name, vertices.order + kind) for name, kind in vertices.fields])
    _check_length(vertices, kind.itemsize, len(data) - vertices.start)
    return np.frombuffer(data, kind, vertices.count, vertices.start)


def _text_table(data: bytes, vertices: _Vertices) -> np.ndarray:
    width = len(vertices.fields)
    _check_length(vertices, 2 * width - 1, len(data) - vertices.start)
    numbers = np.empty((vertices.count, width))
    lines = io.BytesIO(data)
    lines.seek(vertices.start)
    for i in range(vertices.count):
        line = lines.readline(1 << 12)
        words = line.split()
        if len(words) != width:
            raise ForeignFileError(f"point {i} has {len(words)} numbers, not {width}")
        try:
            numbers[i] = [float(word) for word in words]
        except ValueError as error:
            raise ForeignFileError(f"point {i}: {error!s:.200}") from None
    kinds = [(name, "f8" if kind[0] == "f" else "i8") for name, kind in vertices.fields]
    table = np.empty(vertices.count, np.dtype(kinds))
    for column, (name, kind) in enumerate(kinds):
        values = numbers[:, column]
        if kind == "i8" and not np.all(np.abs(values) < 1 << 53):
            raise ForeignFileError(f"`{name}` contains values that are not integers")
        table[name] = values
    return table


def _colors(table: np.ndarray) -> np.ndarray:
    """Reads colors, [n, 3] uint8; fractions are of 1."""
    names = ("red", "green", "blue")
    if not all(name in (table.dtype.names or ()) for name in names):
        return np.full((len(table), 3), _GRAY, np.uint8)
    rgb = np.stack([table[name].astype(np.float64) for name in names], axis=1)
    scale = 255.0 if table.dtype["red"].kind == "f" else 1.0
    return np.rint(np.nan_to_num(rgb) * scale).clip(0, 255).astype(np.uint8)


def voxel_points(map_state: MapState) -> tuple[np.ndarray, np.ndarray]:
    """Reads centers [m] and mean colors of the occupied voxels, [n, 3] float32 and uint8."""
    occupied = np.asarray(map_state.present)
    centers = np.asarray(map_state.center).T[occupied]
    colors = np.rint(np.asarray(map_state.mean).T[occupied] * 255.0)
    return centers.astype(np.float32), colors.clip(0, 255).astype(np.uint8)


def write_points(
    path: Path,
    points: np.ndarray,
    colors: np.ndarray,
    properties: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Writes a PLY with `x y z red green blue`, and further properties behind them.

    Args:
        path: the file.
        points: [n, 3] [m]; float64 is stored as such.
        colors: [n, 3] uint8.
        properties: further numbers of every point by their names, [n] each; stored as float32.

    Raises:
        ValueError: shapes that differ.
        OSError: the disk is full, not writable, ...
    """
    if points.shape != colors.shape or points.shape[1:] != (3,):
        raise InputError(f"points {points.shape} and colors {colors.shape} must both be [n, 3]")
    properties = {} if properties is None else properties
    kind = "<f8" if points.dtype == np.float64 else "<f4"
    fields = [(name, kind) for name in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")]
    fields += [(name, "<f4") for name in properties]
    table = np.empty(len(points), dtype=fields)
    for name, values in properties.items():
        if values.shape != (len(points),):
            raise InputError(f"{name} has the shape {values.shape} for {len(points)} points")
        table[name] = values
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        table[name] = colors[:, channel]
    kinds = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields] + ["end_header", ""]
    write_atomic(path, "\n".join(header).encode() + table.tobytes())
