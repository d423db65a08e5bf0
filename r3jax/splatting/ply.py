"""Gaussians as PLY files in the field layout of Kerbl et al. (2023), which most viewers open.

Shape symbols: n Gaussians, k harmonics per color channel (1, 4, 9 or 16).
"""

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np

from r3jax.errors import InputError
from r3jax.files import write_atomic
from r3jax.geometry.arguments import checked
from r3jax.splatting.errors import SceneFileError
from r3jax.splatting.scene import GaussianScene, a_scene
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""PLY's names of number types, and NumPy's."""

_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}

_MAX_HEADER_LINES = 10_000
"""Maximum length of a header [bytes]."""

_BLOCK = 1 << 22
"""Length of a text that is read at once [bytes]."""

_LONGEST_WORD = 400
"""Maximum length of a number in a text file [characters]."""

_HASH = re.compile(rb"(?<=\n)comment sha256 ([0-9a-f]{64})\n")

_POSITION = ["x", "y", "z"]
_NORMAL = ["nx", "ny", "nz"]
_DC = [f"f_dc_{i}" for i in range(3)]
_SCALE = [f"scale_{i}" for i in range(3)]
_ROTATION = [f"rot_{i}" for i in range(4)]


@dataclass(frozen=True)
class _Element:
    """A table in a PLY file, as declared by its header."""

    name: str
    count: int
    fields: list[tuple[str, str]]
    """Names and NumPy types of the columns."""

    has_lists: bool
    """True if rows differ in length."""


@checked(scene=a_scene)
def write_scene(path: Path | str, scene: GaussianScene) -> None:
    """Writes the used rows of a scene; reading the file gives bit-identical numbers.

    Binary, little endian, float32: x y z, nx ny nz (zeros), f_dc, f_rest (all of red, then
    green, then blue), opacity (before the sigmoid), scale (logarithms), rot (wxyz). A comment in
    the header is the SHA-256 of all the rest.

    Raises:
        SceneFileError: no Gaussians, or parameters that are not finite.
        OSError: the disk is full, not writable, ...
    """
    path = Path(path)
    alive = np.asarray(scene.is_alive)
    means, quats, log_scales, logits, sh = (
        np.asarray(x)[alive]
        for x in (scene.means, scene.quats, scene.log_scales, scene.opacity_logits, scene.sh)
    )
    num_rest = 3 * (sh.shape[1] - 1)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), num_rest)
    columns = [means, np.zeros_like(means), sh[:, 0], rest, logits[:, None], log_scales, quats]
    names = _scene_fields(num_rest)
    table = np.concatenate(columns, axis=1).astype("<f4")
    _check_values(path, names, table)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    before, after = "\n".join([*header, ""]).encode(), b"end_header\n" + table.tobytes()
    sha256 = hashlib.sha256(before + after).hexdigest()
    write_atomic(path, before + f"comment sha256 {sha256}\n".encode() + after)


def read_scene(path: Path | str) -> GaussianScene:
    """Reads a scene written by r3jax or another program.

    Fields may come in any order and number type, with others between them and without normals;
    the file may be binary of either byte order or text, and hold other elements.

    Raises:
        SceneFileError: the file is missing, not a PLY, cut off, compressed, without needed
            fields, not the content that its hash was made of, or holds no Gaussians, numbers that
            are not finite or rotations that are zero.
    """
    path = Path(path)
    try:
        check_regular(path)
        with open(path, "rb") as file:
            byte_order, elements = _read_header(path, file)
            vertex, before = _find_vertices(path, elements)
            num_rest = _count_rest(path, {name for name, _ in vertex.fields})
            read = _read_text if byte_order == "=" else _read_binary
            table = read(path, file, byte_order, vertex, before)
            _check_hash(file)  # last: the specific errors say more
    except FileNotFoundError:
        raise SceneFileError(path, "the file is missing") from None
    except OSError as error:
        raise SceneFileError(path, f"the file cannot be read ({error.strerror})") from None
    except ForeignFileError as error:
        raise SceneFileError(path, f"the file cannot be read ({error})") from None
    names = [name for name in _scene_fields(num_rest) if name not in _NORMAL]
    values = np.stack([table[name] for name in names], axis=1)
    _check_values(path, names, values)
    means, dc, rest, logits, log_scales, quats = np.split(
        values, np.cumsum([3, 3, num_rest, 1, 3]), axis=1
    )
    rest = rest.reshape(len(rest), 3, num_rest // 3).transpose(0, 2, 1)
    return GaussianScene(
        means=jnp.asarray(means),
        quats=jnp.asarray(quats),
        log_scales=jnp.asarray(log_scales),
        opacity_logits=jnp.asarray(logits[:, 0]),
        sh=jnp.asarray(np.concatenate([dc[:, None, :], rest], axis=1)),
    )


def _scene_fields(num_rest: int) -> list[str]:
    """Lists the columns in the order of the original program."""
    rest = [f"f_rest_{i}" for i in range(num_rest)]
    return [*_POSITION, *_NORMAL, *_DC, *rest, "opacity", *_SCALE, *_ROTATION]


def _check_hash(file: BinaryIO) -> None:
    """Compares the file with the hash in its header, if there is one.

    Raises:
        ForeignFileError: it is not what was written.
    """
    file.seek(0)
    head = file.read(1 << 16)
    found = _HASH.search(head[: head.find(b"end_header") + 1])
    if found is not None:
        digest = hashlib.sha256(head[: found.start()] + head[found.end() :])
        while block := file.read(_BLOCK):
            digest.update(block)
        if digest.hexdigest() != found[1].decode():
            raise ForeignFileError("checksum mismatch (SHA-256): the file was damaged or edited")


def _read_header(path: Path, file: BinaryIO) -> tuple[str, list[_Element]]:
    """Reads the byte order and elements; leaves the file at the first byte of the data."""
    if file.readline(16).strip() != b"ply":
        raise SceneFileError(path, "not a PLY file (it does not begin with 'ply')")
    elements: list[_Element] = []
    byte_order = ""
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(1 << 16)
        words = line.decode("ascii", errors="replace").split()
        if not line:
            break
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "end_header":
            if not byte_order:
                raise SceneFileError(path, "the header names no format")
            return byte_order, elements
        try:
            if words[0] == "format":
                byte_order = _BYTE_ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], _as_count(words[2]), [], has_lists=False))
            elif words[0] == "property":
                elements[-1] = _with_property(elements[-1], words[1:])
            else:
                raise InputError
        except (KeyError, IndexError, ValueError):
            raise SceneFileError(
                path, f"the header has an invalid line: {' '.join(words)[:80]!r}"
            ) from None
    raise SceneFileError(path, "the header has no end (no line 'end_header'): is the file cut off?")


def _as_count(word: str) -> int:
    count = int(word)
    if count < 0:
        raise InputError
    return count


def _with_property(element: _Element, words: list[str]) -> _Element:
    """Adds a column to the element, from a line such as `float x`."""
    if words[0] == "list":
        return _Element(element.name, element.count, element.fields, has_lists=True)
    column = (words[1], _TYPES[words[0]])
    if column[0] in dict(element.fields):
        raise InputError
    return _Element(element.name, element.count, [*element.fields, column], element.has_lists)


def _find_vertices(path: Path, elements: list[_Element]) -> tuple[_Element, list[_Element]]:
    """Finds the element that holds the Gaussians, and those that lie before it."""
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise SceneFileError(path, f"there is no element 'vertex', only {names}")
    position = names.index("vertex")
    vertex, before = elements[position], elements[:position]
    if any(name == "packed_position" for name, _ in vertex.fields):
        raise SceneFileError(
            path, "the file is a compressed PLY (SuperSplat): export it uncompressed instead"
        )
    if vertex.has_lists or any(element.has_lists for element in before):
        raise SceneFileError(path, "lists in the element 'vertex' or before it cannot be read")
    if vertex.count == 0:
        raise SceneFileError(path, "the file holds no Gaussians")
    return vertex, before


def _read_binary(
    path: Path, file: BinaryIO, byte_order: str, vertex: _Element, before: list[_Element]
) -> dict[str, np.ndarray]:
    """Reads the columns of the vertices as float32."""

    def row_type(element: _Element) -> np.dtype:
        return np.dtype([(name, byte_order + kind) for name, kind in element.fields])

    start = file.tell() + sum(element.count * row_type(element).itemsize for element in before)
    row = row_type(vertex)
    present = max(0, os.fstat(file.fileno()).st_size - start) // row.itemsize
    if present < vertex.count:
        raise _cut_off(path, vertex.count, present)
    file.seek(start)
    table = np.fromfile(file, dtype=row, count=vertex.count)
    with np.errstate(over="ignore"):  # too large for float32: found with the infinities
        return {name: table[name].astype(np.float32) for name, _ in vertex.fields}


def _read_text(
    path: Path, file: BinaryIO, byte_order: str, vertex: _Element, before: list[_Element]
) -> dict[str, np.ndarray]:
    """Reads the columns of the vertices as float32, from numbers between white space."""
    del byte_order  # text has none
    start = sum(element.count * len(element.fields) for element in before)
    width = len(vertex.fields)
    numbers = [np.zeros(0)]
    needed, skipped = vertex.count * width, 0
    try:
        for words in _words(file):
            begin = min(len(words), start - skipped)
            skipped += begin
            taken = words[begin : begin + needed]
            needed -= len(taken)
            numbers.append(np.fromiter(map(float, taken), np.float64, len(taken)))
            if needed == 0:
                break
    except ValueError as error:
        raise SceneFileError(path, f"the data is no table of numbers ({error!s:.200})") from None
    if needed:
        raise _cut_off(path, vertex.count, vertex.count - -(-needed // width))
    table = np.concatenate(numbers).reshape(vertex.count, width)
    with np.errstate(over="ignore"):
        return {name: table[:, i].astype(np.float32) for i, (name, _) in enumerate(vertex.fields)}


def _words(file: BinaryIO) -> Iterator[list[bytes]]:
    """Yields the words between white space, block by block.

    Split as a whole, the file would take 20 times its size.
    """
    rest = b""
    while block := file.read(_BLOCK):
        words = (rest + block).split()
        # The last word may go on in the next block.
        rest = words.pop() if words and not block[-1:].isspace() else b""
        if len(rest) > _LONGEST_WORD:
            raise InputError(f"a word has more than {_LONGEST_WORD} characters")
        yield words
    yield [rest] if rest else []


def _cut_off(path: Path, promised: int, found: int) -> SceneFileError:
    return SceneFileError(
        path,
        f"truncated: the header declares {promised} Gaussians, the file contains {found}; copy "
        "or export it again",
    )


def _count_rest(path: Path, names: set[str]) -> int:
    """Counts the f_rest fields, once all that a scene needs is there."""
    num_rest = sum(name.startswith("f_rest_") for name in names)
    missing = [name for name in _scene_fields(0) if name not in names and name not in _NORMAL]
    if missing:
        raise SceneFileError(
            path,
            f"these fields are missing: {', '.join(missing)}; is it a point cloud or a mesh "
            "instead of 3D Gaussians?",
        )
    if num_rest not in (0, 9, 24, 45):
        raise SceneFileError(
            path,
            f"{num_rest} fields f_rest_*: expected 0, 9, 24 or 45 (spherical harmonics of degree "
            "0 to 3)",
        )
    missing = [name for name in _scene_fields(num_rest)[9:-8] if name not in names]
    if missing:
        raise SceneFileError(
            path, f"f_rest_* must be counted from 0 to {num_rest - 1}: {missing[0]} is missing"
        )
    return num_rest


def _check_values(path: Path, names: list[str], table: np.ndarray) -> None:
    """Refuses values that render to NaN or to nothing."""
    if len(table) == 0:
        raise SceneFileError(path, "there are no Gaussians to write")
    is_bad = ~np.isfinite(table)
    rows = np.flatnonzero(is_bad.any(axis=1))
    if len(rows):
        column = int(np.argmax(is_bad[rows[0]]))
        raise SceneFileError(
            path,
            f"{len(rows)} of {len(table)} Gaussians have parameters that are not finite, the "
            f"first in row {rows[0]}: {names[column]} is {table[rows[0], column]}; remove them, "
            "or use a scene from before training diverged",
        )
    quats = table[:, [names.index(name) for name in _ROTATION]]
    zero = np.flatnonzero(~quats.any(axis=1))
    if len(zero):
        raise SceneFileError(
            path,
            f"{len(zero)} of {len(table)} Gaussians have the rotation 0 0 0 0, the first in row "
            f"{zero[0]}: set it to 1 0 0 0",
        )
