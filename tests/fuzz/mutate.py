"""One hostile case from a seed: picks a file of it and something nasty to do to that file."""

import re
import struct
from collections.abc import Callable

import numpy as np

from tests.fuzz import containers, json_trees
from tests.fuzz.numbers import FLOAT_WORDS, INT_WORDS, NUMBER_TEXTS
from tests.fuzz.tree import Entry, Fifo, Files, Folder, Link

Rng = np.random.Generator

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
    general: list[Kind] = [*_BYTES, *_BYTES, _whole]
    if name.endswith((".json", ".jsonl", ".gltf")) or data[:1] == b"{":
        return [*general, *_TEXT, *[json_trees.damage_lines] * 12]
    if data[:4] == b"glTF":
        return [*general, *[containers.damage_glb] * 12]
    if data[:4] == b"\x89PNG":
        return [*general, *[containers.damage_png] * 4]
    if data[:2] == b"PK":
        return [*general, *[containers.damage_npz] * 12]
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
    names = [name.encode("utf-8", "surrogatepass") for name in json_trees.HOSTILE_NAMES]
    words = list(re.finditer(rb"[A-Za-z_][\w./]*", data[:_HEADER_BYTES]))
    name = names[rng.integers(len(names))]
    if not words:
        return name
    begin, end = words[rng.integers(len(words))].span()
    return data[:begin] + name + data[end:]


_BYTES: list[Kind] = [_truncate, _flip_bits, _overwrite, _insert, _repeat, _cut_out, _put_word]
_TEXT: list[Kind] = [_put_number, _put_number, _put_number, _shuffle_lines, _put_name]


def _whole(rng: Rng, data: bytes) -> Entry | None:
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
        lambda: containers.pickled(),
        lambda: containers.png_bomb(),
        lambda: containers.zip_bomb(),
        lambda: b"[" * 100_000,
        lambda: b'{"a":' * 100_000,
        lambda: b"GIF89a" + data,
        lambda: b"%PDF-1.4\n" + data,
        lambda: rng.bytes(len(data)),
    ]
    if rng.random() < 0.02:  # large, hence rare
        return b"1" * 100_000_000
    return others[rng.integers(len(others))]()
