"""Unpacks a chunk of a bag, and never more of it than it says."""

import bz2
import sys
from typing import Any

from r3jax.validation.errors import ForeignFileError

MAX_CHUNK = 256 << 20
"""Recorders begin another chunk after about a megabyte; some users let them wait longer [bytes]."""


def unpack_chunk(data: bytes, compression: str, size: int | None = None) -> bytes:
    """Unpacks a chunk.

    Args:
        data: as it is stored.
        compression: lz4, zstd or bz2; nothing or none: it is not packed.
        size: what it must come to [bytes]; None: not known.

    Raises:
        ForeignFileError: another compression, damaged, of another size, or too large.
    """
    most = MAX_CHUNK if size is None else size
    if most > MAX_CHUNK:
        raise ForeignFileError(f"a chunk of {size} bytes is more than {MAX_CHUNK} and not read")
    found = data if compression in ("", "none") else _unpacked(data, compression, most + 1)
    if len(found) > most or size not in (None, len(found)):
        raise ForeignFileError(f"a chunk holds more or less than the {most} bytes it may hold")
    return found


def _unpacked(data: bytes, compression: str, most: int) -> bytes:
    """At most so many bytes of it."""
    decompressor = _decompressor(compression)
    try:
        return decompressor.decompress(data, max_length=most)
    except Exception as error:  # each decompressor has its own
        raise ForeignFileError(f"a chunk cannot be unpacked ({error!s:.200})") from None


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    if compression == "zstd":
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
        return zstd.ZstdDecompressor()
    raise ForeignFileError(f"chunks packed by {compression[:20]!r} are not read")
