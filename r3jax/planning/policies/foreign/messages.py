"""Messages between the loop and a program: a JSON header, then the bytes of arrays.

    4 bytes   N, the length of the header [bytes], unsigned, little-endian
    4 bytes   M, the length of all arrays [bytes], unsigned, little-endian
    N bytes   the header: a JSON object in UTF-8
    M bytes   the arrays one behind the other, little-endian, rows first

The header has a `kind`, and `arrays`: a list of objects with `name`, `dtype` and `shape`, in the
order of their bytes. Nothing in a message is ever executed.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import check_type, parse_json

PREFIX = struct.Struct("<II")
"""Lengths of header and arrays."""

MAX_HEADER = 1 << 20
"""Longest header that is read [bytes]."""

MAX_ARRAYS = 64 << 20
"""Most bytes of arrays that are read; what is sent may be larger."""

DTYPES = {"uint8": "|u1", "int32": "<i4", "int64": "<i8", "float32": "<f4", "float64": "<f8"}
"""Kinds of numbers that arrays may hold, and how NumPy calls them."""


class MessageError(ValueError):
    """Bytes that are no message."""


@dataclass(frozen=True)
class Message:
    """One message."""

    kind: str
    """What it is: `hello`, `decide`, `view`, ..."""

    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    """What else the header says."""

    arrays: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """By name."""


def encode(message: Message) -> bytes:
    """The bytes of a message.

    Raises:
        ValueError: numbers that JSON does not know, arrays of a kind that is not sent, or too
            many bytes.
    """
    arrays = {name: np.ascontiguousarray(array) for name, array in message.arrays.items()}
    for name, array in arrays.items():
        if array.dtype.name not in DTYPES:
            raise ValueError(f"the array {name!r} is {array.dtype}, not one of {', '.join(DTYPES)}")
    listed = [
        {"name": name, "dtype": array.dtype.name, "shape": list(array.shape)}
        for name, array in arrays.items()
    ]
    plain = {"kind": message.kind, **message.fields, "arrays": listed}
    header = json.dumps(plain, allow_nan=False, separators=(",", ":")).encode()
    data = b"".join(
        array.astype(DTYPES[array.dtype.name], copy=False).tobytes() for array in arrays.values()
    )
    if len(header) > MAX_HEADER or len(data) >= 1 << 32:
        raise ValueError(f"a message of {len(header)} + {len(data)} bytes is not sent")
    return PREFIX.pack(len(header), len(data)) + header + data


def length_of(prefix: bytes) -> int:
    """Length of the message that begins with these 8 bytes, they themselves included [bytes].

    Raises:
        MessageError: more than any answer has: most likely they are no message.
    """
    header, data = PREFIX.unpack(prefix)
    if header > MAX_HEADER or data > MAX_ARRAYS:
        raise MessageError(
            f"the bytes {prefix!r} announce a header of {header} and arrays of {data} bytes, more "
            f"than {MAX_HEADER} and {MAX_ARRAYS}: nothing but messages may go to the standard "
            "output; print to the standard error"
        )
    return PREFIX.size + header + data


def decode(data: bytes) -> Message:
    """The message that bytes are: inverse of `encode`.

    Raises:
        MessageError: they are none; says why.
    """
    if len(data) < PREFIX.size or len(data) != length_of(data[: PREFIX.size]):
        raise MessageError(f"{len(data)} bytes are not a whole message")
    end = PREFIX.size + PREFIX.unpack(data[: PREFIX.size])[0]
    try:
        plain = parse_json(data[PREFIX.size : end])
        check_type("header", plain, dict[str, Any])
        kind, listed = plain.pop("kind", None), plain.pop("arrays", [])
        check_type("kind", kind, str)
        check_type("arrays", listed, list[dict[str, Any]])
        return Message(kind, plain, _arrays_of(listed, data[end:]))
    except ForeignFileError as error:
        raise MessageError(f"the header is not understood: {error}") from None


def _arrays_of(listed: list[Mapping[str, Any]], data: bytes) -> dict[str, np.ndarray]:
    """The arrays that a header lists, out of their bytes.

    Raises:
        ForeignFileError: the list is odd, or the bytes are not those of its arrays.
    """
    arrays: dict[str, np.ndarray] = {}
    begin = 0
    for entry in listed:
        parts: dict[str, Any] = {"name": None, "dtype": None, "shape": None} | dict(entry)
        name, dtype, shape = parts["name"], parts["dtype"], parts["shape"]
        check_type("name", name, str)
        check_type(f"{name}.dtype", dtype, str)
        check_type(f"{name}.shape", shape, list[int])
        if dtype not in DTYPES or name in arrays or min([0, *shape]) < 0:
            raise ForeignFileError(f"the array {entry!r:.200} is odd or listed twice")
        size = math.prod(shape) * np.dtype(DTYPES[dtype]).itemsize
        if begin + size > len(data):
            raise ForeignFileError(f"the array {name!r:.80} has more numbers than bytes were sent")
        part = np.frombuffer(data[begin : begin + size], DTYPES[dtype])
        arrays[name] = part.reshape(shape)
        begin += size
    if begin != len(data):
        raise ForeignFileError(f"{len(data) - begin} bytes belong to no array")
    return arrays
