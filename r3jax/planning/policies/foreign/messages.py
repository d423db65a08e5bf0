"""Messages between the loop and a program: a JSON header, then the bytes of arrays.

    4 bytes   N, the length of the header [bytes], unsigned, little-endian
    4 bytes   M, the length of all arrays [bytes], unsigned, little-endian
    N bytes   the header: a JSON object in UTF-8
    M bytes   the arrays one behind the other, little-endian, rows first

The header has a `kind`, and `arrays`: a list of objects with `name`, `dtype` and `shape`, in the
order of their bytes; requests have arrays, replies have none. Nothing in a message is ever
executed.
"""

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r3jax.errors import InputError
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import check_type, parse_json

PREFIX = struct.Struct("<II")
"""Lengths of header and arrays."""

MAX_HEADER = 1 << 20
"""Longest header of a message [bytes]."""

DTYPES = {"uint8": "|u1", "int32": "<i4", "int64": "<i8", "float32": "<f4", "float64": "<f8"}
"""Kinds of numbers that arrays may hold, and how NumPy calls them."""


class MessageError(InputError):
    """Bytes that are not a message."""


@dataclass(frozen=True)
class Message:
    """One message."""

    kind: str
    """Its kind: `hello`, `decide`, `view`, ..."""

    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    """The other fields of the header."""

    arrays: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """By name."""


def encode(message: Message) -> bytes:
    """Encodes a message in bytes.

    Raises:
        ValueError: numbers that JSON cannot represent, arrays of an unsupported type, or too many
            bytes.
    """
    arrays = {name: np.ascontiguousarray(array) for name, array in message.arrays.items()}
    for name, array in arrays.items():
        if array.dtype.name not in DTYPES:
            raise InputError(f"the array {name!r} is {array.dtype}, not one of {', '.join(DTYPES)}")
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
        raise InputError(f"a message of {len(header)} + {len(data)} bytes is not sent")
    return PREFIX.pack(len(header), len(data)) + header + data


def length_of(prefix: bytes) -> int:
    """Reads the length of the reply that begins with these 8 bytes, including them [bytes].

    Raises:
        MessageError: it is too long, or has arrays: most likely not a message.
    """
    header, data = PREFIX.unpack(prefix)
    if header > MAX_HEADER or data:
        raise MessageError(
            f"the bytes {prefix!r} announce a header of {header} and arrays of {data} bytes, more "
            f"than {MAX_HEADER} and 0: nothing but messages may go to the standard output; print "
            "to the standard error"
        )
    return PREFIX.size + header


def decode(data: bytes) -> Message:
    """Decodes a reply: inverse of `encode` for a message without arrays.

    Raises:
        MessageError: not a valid message; says why.
    """
    if len(data) < PREFIX.size or len(data) != length_of(data[: PREFIX.size]):
        raise MessageError(f"{len(data)} bytes are not a whole message")
    try:
        plain = parse_json(data[PREFIX.size :])
        check_type("header", plain, dict[str, Any])
        kind, arrays = plain.pop("kind", None), plain.pop("arrays", [])
        check_type("kind", kind, str)
        if arrays != []:
            raise ForeignFileError("`arrays` must be empty in a reply")
        return Message(kind, plain)
    except ForeignFileError as error:
        raise MessageError(f"the header cannot be parsed: {error}") from None
