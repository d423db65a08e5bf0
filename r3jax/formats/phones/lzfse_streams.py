"""Unpacks LZFSE, Apple's compression, into no more room than there may be.

The package `lzfse` makes ever more room for a damaged stream until the memory is full; the
reference decoder inside it writes into a buffer of a given size, and is called directly.
"""

import ctypes
from collections.abc import Collection
from pathlib import Path
from typing import Any

from r3jax.formats.errors import FormatError
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.packages import why_not_imported


def load_decoder(path: Path) -> Any:
    """Loads `lzfse_decode_buffer` of the reference implementation.

    Args:
        path: the capture that needs it, for the message.

    Raises:
        FormatError: the package is not installed, or was built without it.
    """
    try:
        import lzfse

        decoder = ctypes.CDLL(lzfse.__file__).lzfse_decode_buffer
    except ImportError as error:
        what_for = "the depth of Record3D is unpacked by"
        reason = why_not_imported(error, "lzfse", what_for, "phones")
        raise FormatError(path, reason) from None
    except (AttributeError, OSError) as error:
        reason = f"the package lzfse does not hold its decoder ({error!s:.200}): another version?"
        raise FormatError(path, reason) from None
    size, pointer = ctypes.c_size_t, ctypes.c_char_p
    decoder.argtypes = [pointer, size, pointer, size, ctypes.c_void_p]
    decoder.restype = size
    return decoder


def unpack_lzfse(decoder: Any, data: bytes, lengths: Collection[int]) -> bytes:
    """Unpacks a stream.

    Args:
        decoder: of `load_decoder`.
        data: the stream.
        lengths: numbers of bytes that it may hold.

    Raises:
        ForeignFileError: damaged, or of another length.
    """
    room = max(lengths) + 1
    buffer = ctypes.create_string_buffer(room)
    length = decoder(buffer, room, data, len(data), None)
    if length not in lengths:
        wanted = " or ".join(str(one) for one in sorted(lengths))
        what = f"more than {room - 1}" if length == room else str(length)
        raise ForeignFileError(f"it unpacks to {what} bytes, not {wanted}: is it damaged?")
    return buffer.raw[:length]
