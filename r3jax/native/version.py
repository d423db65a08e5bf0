"""Which version of XLA's foreign function interface this jaxlib speaks."""

import functools
import re
import warnings
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


def speaks_our_interface() -> bool:
    """Whether XLA can call the kernels; warns once if its interface is another."""
    if (version := ffi_version()) != WRITTEN_FOR:
        _warn(version)
        return False
    return True


@functools.cache
def _warn(version: tuple[int, int]) -> None:
    warnings.warn(
        f"the kernels for CPUs read XLA's structs as they are in version "
        f"{'.'.join(map(str, WRITTEN_FOR))} of its foreign function interface; this jaxlib has "
        f"{'.'.join(map(str, version))}: mapping and scoring in plain JAX, which is slower",
        RuntimeWarning,
        stacklevel=2,
    )
