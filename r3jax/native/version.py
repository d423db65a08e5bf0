"""Which version of XLA's foreign function interface this jaxlib speaks."""

import functools
import re
from pathlib import Path

import jax

WRITTEN_FOR = (0, 3)
"""Version of XLA's foreign function interface whose structs `native.ffi` reads by offset."""


@functools.cache
def ffi_version() -> tuple[int, int]:
    """Reads major and minor version of the interface from the header that jaxlib ships.

    Returns:
        The version; (-1, -1) if the header does not say.
    """
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text(encoding="utf-8") if header.is_file() else ""
    found = [
        re.search(rf"^#define XLA_FFI_API_{part} (\d+)$", text, re.MULTILINE)
        for part in ("MAJOR", "MINOR")
    ]
    major, minor = (-1 if match is None else int(match[1]) for match in found)
    return major, minor
