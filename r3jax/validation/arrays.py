"""Arrays from NPZ and NPY files: no pickles, and none that unpacks to more than it may."""

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular

_SMALL = 256 << 20
"""Files that unpack to no more are never bombs [bytes]."""

_SQUEEZE = 200
"""Larger ones are, if they were packed tighter than this: images reach a tenth of it."""


def read_npz(path: str | Path, types: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Reads the arrays of an NPZ file.

    Args:
        path: the file.
        types: what it must hold: the kind (`np.dtype.kind`) of every array by its name.

    Raises:
        ForeignFileError: not an NPZ, cut off, packed like a bomb; arrays that are missing, of
            another kind, larger than their stored bytes, or not finite.
        OSError: missing, or not permitted.
    """
    size = check_regular(path)
    try:
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            members = {info.filename: info for info in archive.infolist()}
            wanted = {name: members.get(f"{name}.npy") for name in types}
            missing = sorted(name for name, info in wanted.items() if info is None)
            if missing:
                raise ForeignFileError(f"these arrays are missing: {', '.join(missing)}")
            infos = [info for info in wanted.values() if info is not None]
            unpacked = sum(info.file_size for info in infos)
            if unpacked > max(_SMALL, _SQUEEZE * size):
                raise ForeignFileError(
                    f"it has {size} bytes and claims to unpack to {unpacked}: not done"
                )
            arrays = {info.filename[:-4]: _read(archive, info) for info in infos}
    except (ForeignFileError, FileNotFoundError, PermissionError):
        raise
    except Exception as error:  # zlib, struct, seeks before the beginning, ...
        raise ForeignFileError(f"this is no NPZ file ({error!s:.200})") from None
    for name, array in arrays.items():
        if array.dtype.kind != types[name]:
            raise ForeignFileError(f"the array {name!r} is of the type {array.dtype}")
    return arrays


def read_npy(data: bytes) -> np.ndarray:
    """Reads the array of an NPY file.

    Raises:
        ForeignFileError: not an NPY, cut off, or no plain numbers or texts.
    """
    try:
        return _array(io.BytesIO(data), "the array", len(data))
    except ForeignFileError:
        raise
    except Exception as error:  # a header that is no Python literal, ...
        raise ForeignFileError(f"this is no NPY file ({error!s:.200})") from None


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Reads one member."""
    with archive.open(info) as file:
        return _array(file, info.filename, info.file_size)


def _array(file: Any, name: str, size: int) -> np.ndarray:
    """Reads an array and its header, which may not declare more bytes than there are."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ForeignFileError(f"{name} has the unknown version {version}")
    head = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, is_fortran, dtype = head(file)
    count = math.prod(shape)
    if dtype.hasobject or min(shape, default=0) < 0:
        raise ForeignFileError(f"{name} holds no plain numbers or texts")
    if count * dtype.itemsize != size - file.tell():
        raise ForeignFileError(f"{name} promises {count} numbers, others are there")
    data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise ForeignFileError(f"{name} is cut off")
    array = np.frombuffer(data, dtype).reshape(shape[::-1] if is_fortran else shape)
    return array.T if is_fortran else array
