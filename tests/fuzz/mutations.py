"""Damage: one hostile case from a seed, and files that would unpack to gigabytes.

A case picks a file of the seed and does something nasty to it. Damage that fits the format gets
past its outer shell: JSON with wrong types, numbers, names and doubled keys, PNG with right
checksums, GLB, NPZ, bombs.
"""

import functools
import io
import json
import os
import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.fuzz.tree import Entry, Fifo, Files, Folder, Link

Rng = np.random.Generator

INT_WORDS = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FFFFFFF // 4, 1 << 24, 0xFFFF)
"""As 32-bit words: counts, indices, sizes."""

FLOAT_WORDS = (float("nan"), float("inf"), float("-inf"), 3e38, -1.0, 0.0, 1e-45, 1e30)
"""As 32 or 64-bit floats."""

NUMBER_TEXTS = (
    *b"nan NaN inf -Infinity 1e308 -1e308 1e999 1e-320 -1 0 -0.0 1.5 2147483647 4294967295".split(),
    *b"9223372036854775807 18446744073709551616 1000000000000 0x10 1_000 true".split(),
    *(b"1" + b"0" * 400, b"9" * 5000, b"\xd9\xa3", b""),
)
"""As text: in JSON, PLY, OBJ and tables of numbers."""

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_HEADER_BYTES = 2000
"""Binary files begin with a text header at most this long, if they have one."""


def mutate(rng: Rng, files: Files) -> tuple[dict[str, Entry], str]:
    """A damaged copy of the files, and what was done to it."""
    changed = dict(files)
    names, described = sorted(changed), "nothing"
    for _ in range(int(rng.choice([1, 1, 1, 2]))):
        name = names[rng.integers(len(names))]
        data = changed.get(name)
        if not isinstance(data, bytes):
            continue  # done with by the first damage
        kinds = _kinds_for(name, data)
        kind = kinds[rng.integers(len(kinds))]
        damaged = kind(rng, data)
        if damaged is None:
            del changed[name]
        else:
            changed[name] = damaged
        described = f"{kind.__name__.strip('_')} of {name}"
    return changed, described


Kind = Callable[[Rng, bytes], Entry | None]


def _kinds_for(name: str, data: bytes) -> list[Kind]:
    """The ways to damage a file; those that fit its format are the most likely."""
    general: list[Kind] = [*_BYTES, *_BYTES, _replace]
    if name.endswith((".json", ".jsonl", ".gltf")) or data[:1] == b"{":
        return [*general, *_TEXT, *[damage_lines] * 12]
    if data[:4] == b"glTF":
        return [*general, *[damage_glb] * 12]
    if data[:4] == b"\x89PNG":
        return [*general, *[damage_png] * 4]
    if data[:2] == b"PK":
        return [*general, *[damage_npz] * 12]
    return [*general, *_TEXT, *_TEXT]


def _at(rng: Rng, data: bytes) -> int:
    """A place in the data; headers are the more interesting part."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 200)
    return int(rng.integers(max(end, 1)))


def _truncate(rng: Rng, data: bytes) -> bytes:
    return data[: _at(rng, data)]


def _flip_bits(rng: Rng, data: bytes) -> bytes:
    flipped = bytearray(data)
    for _ in range(int(2 ** rng.integers(7))):
        if flipped:
            flipped[_at(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def _overwrite(rng: Rng, data: bytes) -> bytes:
    at, count = _at(rng, data), int(rng.integers(1, 65))
    return data[:at] + rng.bytes(count) + data[at + count :]


def _insert(rng: Rng, data: bytes) -> bytes:
    at = _at(rng, data)
    return data[:at] + rng.bytes(int(rng.integers(1, 65))) + data[at:]


def _repeat(rng: Rng, data: bytes) -> bytes:
    begin, end = sorted((_at(rng, data), _at(rng, data)))
    return data[:end] + data[begin:end] * int(rng.integers(1, 9)) + data[end:]


def _cut_out(rng: Rng, data: bytes) -> bytes:
    begin, end = sorted((_at(rng, data), _at(rng, data)))
    return data[:begin] + data[end:]


def _put_word(rng: Rng, data: bytes) -> bytes:
    """A hostile 32 or 64-bit number at an aligned place."""
    words = [struct.pack("<I", i & 0xFFFFFFFF) for i in INT_WORDS]
    words += [struct.pack(kind, x) for x in FLOAT_WORDS for kind in ("<f", "<d")]
    word = words[rng.integers(len(words))]
    at = _at(rng, data) // 4 * 4
    return data[:at] + word + data[at + len(word) :]


def _put_number(rng: Rng, data: bytes) -> bytes:
    """A hostile number in place of one in a text, or in the text header of a binary file."""
    is_text = data.isascii()
    found = list(_NUMBER.finditer(data if is_text else data[:_HEADER_BYTES]))
    if not found:
        return data + b"nan"
    begin, end = found[rng.integers(len(found))].span()
    return data[:begin] + NUMBER_TEXTS[rng.integers(len(NUMBER_TEXTS))] + data[end:]


def _shuffle_lines(rng: Rng, data: bytes) -> bytes:
    """Drops, doubles or swaps a line."""
    lines = data.split(b"\n")
    i, j = rng.integers(len(lines), size=2)
    how = rng.integers(3)
    if how == 0:
        del lines[i]
    elif how == 1:
        lines.insert(i, lines[j])
    else:
        lines[i], lines[j] = lines[j], lines[i]
    return b"\n".join(lines)


def _put_name(rng: Rng, data: bytes) -> bytes:
    """A name that leads elsewhere, in place of a word of a text."""
    names = [name.encode("utf-8", "surrogatepass") for name in HOSTILE_NAMES]
    words = list(re.finditer(rb"[A-Za-z_][\w./]*", data[:_HEADER_BYTES]))
    name = names[rng.integers(len(names))]
    if not words:
        return name
    begin, end = words[rng.integers(len(words))].span()
    return data[:begin] + name + data[end:]


_BYTES: list[Kind] = [_truncate, _flip_bits, _overwrite, _insert, _repeat, _cut_out, _put_word]
_TEXT: list[Kind] = [_put_number, _put_number, _put_number, _shuffle_lines, _put_name]


def _replace(rng: Rng, data: bytes) -> Entry | None:
    """Something else in place of the file."""
    others: list[Callable[[], Entry | None]] = [
        lambda: b"",
        lambda: None,
        Folder,
        Fifo,
        lambda: Link("../outside/secret"),
        lambda: Link("/dev/zero"),
        lambda: Link("../outside"),
        lambda: Link("nowhere"),
        lambda: b"\0" * len(data),
        lambda: b"\xff\xfe" + data,
        lambda: b"\x80\x81" * 50,
        lambda: pickled(),
        lambda: png_bomb(),
        lambda: zip_bomb(),
        lambda: b"[" * 100_000,
        lambda: b'{"a":' * 100_000,
        lambda: b"GIF89a" + data,
        lambda: b"%PDF-1.4\n" + data,
        lambda: rng.bytes(len(data)),
    ]
    if rng.random() < 0.02:  # large, hence rare
        return b"1" * 100_000_000
    return others[rng.integers(len(others))]()


HOSTILE_NAMES = (
    *("../../x", "../outside/secret", "/etc/passwd", "/dev/zero", "..\\..\\x", "\x00", "", "."),
    *("a/../../../outside/secret", "%2e%2e/outside/secret", "file:///etc/passwd", "~/x", "nul\n"),
    *("http://localhost:1/x", "data:application/octet-stream;base64,AAAA", "data:,", "\ud800"),
    "x" * 10_000,
)

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 1.5, 2**31, 2**32 - 1, 2**63, 10**12, 10**400, 1e308, -1e308,
    1e-320, float("nan"), float("inf"), "", "text", "nan", [], [1], [[]], {}, {"a": 1}, [None],
    [1e308] * 3, ["a", {}], [float("nan")] * 16, [0] * 5000,
)  # fmt: skip


def damage_lines(rng: np.random.Generator, data: bytes) -> bytes:
    """Damages one value of a JSON text, or of one line of JSON lines."""
    try:
        return damage(rng, data)
    except (ValueError, RecursionError):  # no JSON, or nested by earlier damage
        lines = data.split(b"\n")
        i = int(rng.integers(len(lines)))
        try:
            lines[i] = damage(rng, lines[i])
        except (ValueError, RecursionError):
            lines[i] = b"{}"
        return b"\n".join(lines)


def damage(rng: np.random.Generator, data: bytes) -> bytes:
    """Damages one value of a JSON text.

    Raises:
        ValueError: the data is no JSON, or nested too deeply by an earlier damage.
    """
    try:
        tree = {"": json.loads(data)}
    except RecursionError:
        raise ValueError("nested too deeply") from None
    places: list[tuple[Any, Any]] = []
    _collect(tree, places)
    # Strings (names of files among them) deserve their share beside long lists of numbers.
    names = [(node, key) for node, key in places if isinstance(node[key], str)]
    if names and rng.random() < 0.3:
        node, key = names[rng.integers(len(names))]
        node[key] = HOSTILE_NAMES[rng.integers(len(HOSTILE_NAMES))]
        return _text(tree[""])
    if rng.random() < 0.5:  # and so do shallow places
        places = places[: max(1, min(len(places), 40))]
    node, key = places[rng.integers(len(places))]
    how = rng.integers(8)
    if how == 0 and key != "":
        del node[key]
    elif how == 1 and isinstance(node, dict):
        marker = f"~{key}"
        node[marker] = _VALUES[rng.integers(len(_VALUES))]
        return _text(tree[""]).replace(json.dumps(marker).encode(), json.dumps(key).encode())
    elif how == 2 and isinstance(node, list):
        node.extend([node[key]] * int(rng.integers(1, 50)))
    elif how == 3:
        node[key] = [node[key]]
    else:
        node[key] = _VALUES[rng.integers(len(_VALUES))]
    return _text(tree[""])


def _collect(node: Any, places: list[tuple[Any, Any]]) -> None:
    """Every value of the tree by its container and key, breadth first."""
    level = [node]
    while level:
        below = []
        for node in level:
            keys = node.keys() if isinstance(node, dict) else range(len(node))
            for key in keys:
                places.append((node, key))
                if isinstance(node[key], dict | list):
                    below.append(node[key])
        level = below


def _text(tree: Any) -> bytes:
    # 10**400 is written digit by digit; surrogates stay escaped.
    return json.dumps(tree).encode()


_BOMB_BYTES = 1_500_000_000
"""What a bomb unpacks to."""

_PNG_HEAD = b"\x89PNG\r\n\x1a\n"


class Payload:
    """Unpickling this makes a folder: proof that a pickle ran."""

    def __reduce__(self):
        """What a pickle runs."""
        return os.mkdir, ("pickle-ran",)


def pickled() -> bytes:
    """A pickle that does something."""
    return pickle.dumps(Payload())


def chunk(kind: bytes, body: bytes) -> bytes:
    """A chunk of a PNG with its checksum."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@functools.cache
def _zeros(count: int) -> bytes:
    """Compressed zeros."""
    press, block = zlib.compressobj(1), bytes(1 << 20)
    return b"".join(press.compress(block) for _ in range(count >> 20)) + press.flush()


@functools.cache
def png_bomb() -> bytes:
    """A small PNG of 20,000 x 20,000 pixels."""
    head = struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", _zeros(20_000 * 60_001))
    return _PNG_HEAD + body + chunk(b"IEND", b"")


@functools.cache
def zip_bomb() -> bytes:
    """A small NPZ whose one array unpacks to more than a gigabyte."""
    count = _BOMB_BYTES >> 20
    file, block = io.BytesIO(), bytes(1 << 20)
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("rgb.npy", "w", force_zip64=True) as member,
    ):
        member.write(_npy_head("|u1", (count << 20,)))
        for _ in range(count):
            member.write(block)
    return file.getvalue()


def _npy_head(descr: str, shape: tuple[int, ...]) -> bytes:
    """The header of an array; nothing checks that the shape is sane."""
    head = io.BytesIO()
    fields = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(head, fields)
    return head.getvalue()


def damage_png(rng: np.random.Generator, data: bytes) -> bytes:
    """Another size, depth or color type, bombs in side chunks; the checksums are right."""
    parts = _png_chunks(data)
    how = rng.integers(5)
    if not parts or parts[0][0] != b"IHDR" or how == 0:
        return png_bomb()
    head = bytearray(parts[0][1])
    if how <= 2:
        sizes = (0, 1, 2, 7, 8, 9, 10, 4096, 20_000, 65_535, 0x7FFFFFFF, 0xFFFFFFFF)
        at = int(rng.integers(2)) * 4
        head[at : at + 4] = struct.pack(">I", sizes[rng.integers(len(sizes))])
    elif how == 3:
        head[8 + int(rng.integers(5))] = int(rng.choice([0, 1, 2, 3, 4, 6, 8, 16, 255]))
    parts[0] = (b"IHDR", bytes(head))
    if how == 4:
        kind, lead = [(b"zTXt", b"k\0\0"), (b"iCCP", b"k\0\0"), (b"iTXt", b"k\0\1\0\0\0")][
            rng.integers(3)
        ]
        parts.insert(1, (kind, lead + _zeros(256 << 20)))
    return _PNG_HEAD + b"".join(chunk(kind, body) for kind, body in parts)


def _png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    parts, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        parts.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return parts


def damage_glb(rng: np.random.Generator, data: bytes) -> bytes:
    """Damages the JSON or the numbers of a GLB; the lengths of its chunks are right."""
    if len(data) < 20:
        return data
    (length,) = struct.unpack("<I", data[12:16])
    tree, rest = data[20 : 20 + length], data[20 + length :]
    if rng.random() < 0.75:
        try:
            tree = damage(rng, tree)
        except ValueError:
            tree = b"{}"
    elif len(rest) > 16:
        at = 8 + int(rng.integers((len(rest) - 12) // 4)) * 4
        word = INT_WORDS[rng.integers(len(INT_WORDS))]
        packed = struct.pack("<f", FLOAT_WORDS[rng.integers(len(FLOAT_WORDS))])
        packed = packed if rng.random() < 0.5 else struct.pack("<I", word)
        rest = rest[:at] + packed + rest[at + 4 :]
    tree += b" " * (-len(tree) % 4)
    body = struct.pack("<I4s", len(tree), b"JSON") + tree + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def damage_npz(rng: np.random.Generator, data: bytes) -> bytes:
    """Other shapes, types, numbers or members in an NPZ; pickles and bombs among them."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # it was damaged before
        return zip_bomb()
    name = sorted(members)[rng.integers(len(members))]
    how = rng.integers(7)
    if how == 0:
        del members[name]
    elif how == 1:
        members[name] = npy(np.array([Payload()], dtype=object))
    elif how == 2:
        members[name] = b"\x93NUMPY\x01\x00" + pickled()
    elif how == 3:
        shape = [(1 << 40,), (3, 1 << 33), (-1, 3), (0,), (2**63, 2), ()][rng.integers(6)]
        members[name] = _npy_head("<f4", shape) + bytes(64)
    elif how == 4:
        body = bytearray(members[name])
        at = int(rng.integers(max(1, len(body) // 4))) * 4
        body[at : at + 4] = struct.pack("<f", FLOAT_WORDS[rng.integers(len(FLOAT_WORDS))])
        members[name] = bytes(body)
    elif how == 5:
        others = (np.zeros(3), np.array("text"), np.full((2, 3), np.nan, np.float32), np.arange(9))
        members[name] = npy(others[rng.integers(len(others))])
    else:
        members["../../x.npy"] = members.pop(name)
    return zipped(members)


def zipped(members: dict[str, bytes]) -> bytes:
    """An archive of members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, body in members.items():
            archive.writestr(name, body)
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    """An array as a member of an NPZ; objects are pickled."""
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return file.getvalue()
