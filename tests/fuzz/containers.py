"""Damage that gets past a format's outer shell: PNG with right checksums, GLB, NPZ, bombs."""

import functools
import io
import os
import pickle
import struct
import zipfile
import zlib

import numpy as np

from tests.fuzz.json_trees import damage
from tests.fuzz.numbers import FLOAT_WORDS, INT_WORDS

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
