"""The structs that XLA hands to handlers: where fields lie, and whether this jaxlib agrees.

Handlers read XLA's structs by offset (`kernels/native.ffi`). The version of XLA's foreign function
interface says little about these: from 0.3 to 0.5 none of the fields below moved. So jaxlib's own
header is asked, for each field.
"""

import functools
import re
from collections.abc import Iterator
from pathlib import Path

import jax

OFFSETS = {
    "CallFrame.extension_start": 8,
    "CallFrame.api": 16,
    "CallFrame.args.args": 72,
    "CallFrame.rets.rets": 112,
    "Buffer.data": 24,
    "Buffer.rank": 32,
    "Buffer.dims": 40,
    "Api.api_version.minor_version": 36,
    "Metadata_Extension.extension_base.type": 8,
    "Metadata_Extension.metadata": 24,
    "Metadata.api_version.major_version": 24,
    "Metadata.api_version.minor_version": 28,
}
"""Bytes from the start of a struct `XLA_FFI_...` to a field; with two dots, of a struct in it."""

VALUES = {"XLA_FFI_API_MAJOR": 0, "XLA_FFI_Extension_Metadata": 1}
"""Constants of the handlers."""

_SIZES = {"size_t": 8, "int64_t": 8, "int": 4}
"""Bytes of types; a pointer takes 8, an enumeration 4."""

_Layout = Iterator[tuple[str, int, int]]
"""Fields of a struct: name, offset and size in bytes."""


@functools.cache
def misread() -> str:
    """Says what handlers would misread in the structs of this jaxlib; empty: nothing."""
    path = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    return misread_in(path.read_text(encoding="utf-8") if path.is_file() else "")


def misread_in(header: str) -> str:
    """Says what handlers would misread in structs as a header declares them; empty: nothing.

    Args:
        header: text of `xla/ffi/api/c_api.h`.
    """
    header = re.sub(r"//.*|/\*.*?\*/", "", header)
    for name, value in VALUES.items():
        if not re.search(rf"\b{name}(?: =)? {value}\b", header):
            return f"{name} is not {value}"
    for path, offset in OFFSETS.items():
        struct, _, field = path.partition(".")
        found = {name: at for name, at, _ in _fields(header, f"XLA_FFI_{struct}")}
        if found.get(field) != offset:
            return f"XLA_FFI_{path} lies at {found.get(field, 'no place')}, not at {offset}"
    return ""


def _fields(header: str, struct: str) -> _Layout:
    """Lays out a C struct, structs in it included, up to the first field of a type not known."""
    body = re.search(rf"struct {struct} \{{(.*?)\}}", header, re.DOTALL)
    offset = 0
    for declared in body[1].split(";") if body else ():
        match = re.fullmatch(r"\s*(?:const |struct )*(\w+)\s*(\**)\s*(\w+)\s*", declared)
        if match is None:
            return
        kind, stars, name = match.groups()
        inner = [] if stars or kind in _SIZES else list(_fields(header, kind))
        if stars:
            size = 8
        elif inner:
            size = -(-max(at + size for _, at, size in inner) // 8) * 8
        elif kind in _SIZES or re.search(rf"\}} {kind};", header):
            size = _SIZES.get(kind, 4)
        else:
            return
        offset = -(-offset // min(size, 8)) * min(size, 8)
        yield name, offset, size
        yield from ((f"{name}.{part}", offset + at, size) for part, at, size in inner)
        offset += size
