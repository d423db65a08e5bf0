"""Reads recordings of Record3D: the .r3d archive, or what it unpacks to, and the export EXR + JPG.

    metadata         JSON: w, h, dw, dh; K, 9 numbers column by column; poses [qx, qy, qz, qw, x, y,
                     z], camera to world, OpenGL axes [m]; perFrameIntrinsicCoeffs [fx, fy, cx, cy]
    rgbd/<n>.jpg     8-bit RGB
    rgbd/<n>.depth   LZFSE of float32 [dh, dw] [m], NaN where there is no measurement
    rgbd/<n>.conf    LZFSE of uint8 [dh, dw], 2 is the best; the front camera has none

    metadata.json    the same JSON, in a folder EXR_RGBD
    rgb/<n>.jpg      or .png: 8-bit RGB
    depth/<n>.exr    one channel of float32 [m]; confidence is not exported

Where the first pose is no rotation, the app has made the first camera the world: which way is up
is not known then. Else the world is ARKit's, y up.
"""

import ctypes
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.formats.depth import MILLIMETERS, check_exr, keep_confident, stored_depth
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.formats.phones.archives import (
    Archive,
    Shot,
    complete_shots,
    find_archive,
    is_there,
    posed_images,
)
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.poses import UP_Y, quaternion_pose
from r3jax.validation.errors import ForeignFileError, why_not_imported
from r3jax.validation.json_text import check_fields, check_type

_BEST = 2
_DEPTH_SIZES = ((256, 192), (640, 480))
"""Longer and shorter side of the LiDAR's and the front camera's depth [px], for files that do not
say it."""

_MAX_BYTES = 16 << 20
"""A packed depth image takes a megabyte at most."""

_MAX_EXR = 64 << 20
"""A depth image that is not packed takes 1.2 MB; some enlarge it to the size of the image."""

_R3D, _EXPORT = ("metadata", "rgbd"), ("metadata.json", "rgb", "depth")
"""Names in an archive of each layout."""

_FIELDS = {"w": int, "h": int, "K": list[float], "poses": list[list[float]]}


def is_record3d(path: Path) -> bool:
    """Returns True if the folder or archive looks like a recording of Record3D."""
    return is_there(path, *_R3D) or (is_there(path, *_EXPORT) and _export(path) is not None)


def _export(path: Path) -> Archive | None:
    """Finds the export EXR + JPG in a folder or archive."""
    archive = find_archive(path, *_EXPORT)
    return archive if archive is not None and archive.names("depth", ".exr") else None


def read_record3d(path: Path | str) -> PosedImages:
    """Opens a recording and checks everything but the pixels.

    Args:
        path: the .r3d file, the folder that it was unpacked to, or an export EXR + JPG.

    Raises:
        FormatError: lzfse or OpenEXR is not installed; metadata that are missing or damaged;
            numbers of poses and intrinsics that differ; no depth images.
    """
    path = Path(path)
    r3d = find_archive(path, *_R3D)
    archive = r3d or _export(path)
    if archive is None:
        raise FormatError(path, "there are no metadata and no folder rgbd in it")
    with naming(path):
        decoder = load_decoder(path) if r3d else check_exr()
    name = (_R3D if r3d else _EXPORT)[0]
    metadata, source = archive.json(name), archive.where(name)
    with naming(source):
        check_fields("metadata", metadata, _FIELDS)
        lenses = _lenses(metadata)
        size = _depth_size(metadata)
    rows = metadata["poses"]
    if not rows or len(rows) != len(lenses) or {len(row) for row in rows} != {7}:
        raise FormatError(
            source,
            f"the {len(rows)} poses must have 7 numbers each and be as many as there are "
            f"intrinsics, {len(lenses)}",
        )
    depth = partial(_depth, archive, decoder, size) if r3d else partial(_exported_depth, archive)
    shots = [
        Shot(
            *(_files(i) if r3d else _exported_files(archive, i)),
            lens=lens,
            pose=quaternion_pose(source, f"pose {i}", row[4:], row[:4]) @ OPENGL_FROM_OPENCV,
        )
        for i, (row, lens) in enumerate(zip(np.asarray(rows, np.float64), lenses, strict=True))
    ]
    advice = (
        "this looks like a recording of Record3D without depth (rgbd/<n>.depth or depth/<n>.exr): "
        "share it as .r3d"
    )
    kept, remark = complete_shots(archive, shots, len(rows), advice)
    is_relative = abs(abs(rows[0][3]) - 1.0) < 1e-6
    up = None if is_relative else UP_Y
    return posed_images(archive, kept, depth=depth, up=up, remark=remark)


def _files(index: int) -> tuple[str, str, str]:
    """Names the image, depth and confidence of a frame in an .r3d archive."""
    return f"rgbd/{index}.jpg", f"rgbd/{index}.depth", f"rgbd/{index}.conf"


def _exported_files(archive: Archive, index: int) -> tuple[str, str, str]:
    """Names the files of a frame in an export, which has no confidence."""
    image = f"rgb/{index}.jpg"
    return image if archive.has(image) else f"rgb/{index}.png", f"depth/{index}.exr", ""


def _exported_depth(archive: Archive, shot: Shot) -> np.ndarray:
    """Reads z-depth [h, w] float32 [m]."""
    data = archive.read(shot.depth, _MAX_EXR)
    with naming(archive.where(shot.depth)):
        return MILLIMETERS.depth(stored_depth(data))


def _lenses(metadata: dict[str, Any]) -> list[Lens]:
    """Makes one lens for each pose."""
    width, height, K = metadata["w"], metadata["h"], metadata["K"]
    if len(K) != 9:
        raise ForeignFileError(f"`K` must have 9 numbers, got {len(K)}")
    rows = metadata.get("perFrameIntrinsicCoeffs") or [[K[0], K[4], K[6], K[7]]] * len(
        metadata["poses"]
    )
    check_type("perFrameIntrinsicCoeffs", rows, list[list[float]])
    return [Lens("PINHOLE", width, height, tuple(float(value) for value in row)) for row in rows]


def _depth_size(metadata: dict[str, Any]) -> tuple[int, int] | None:
    """Reads the rows and columns of the depth images, if the file contains them."""
    if "dw" not in metadata or "dh" not in metadata:
        return None
    check_fields("metadata", metadata, {"dw": int, "dh": int})
    rows, columns = metadata["dh"], metadata["dw"]
    if not (0 < rows <= 4096 and 0 < columns <= 4096):
        raise ForeignFileError(f"the depth images cannot have {columns} x {rows} pixels")
    return rows, columns


def _depth(archive: Archive, decoder: Any, size: tuple[int, int] | None, shot: Shot) -> np.ndarray:
    """Reads z-depth [h, w] float32 where the sensor was confident."""
    data = archive.read(shot.depth, _MAX_BYTES)
    with naming(archive.where(shot.depth)):
        sizes = _DEPTH_SIZES if size is None else (size,)
        values = unpack_lzfse(decoder, data, [4 * rows * columns for rows, columns in sizes])
        rows, columns = size or _turned(len(values) // 4, shot.lens)
        depth = np.frombuffer(values, "<f4").reshape(rows, columns)
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))
    if not archive.has(shot.confidence):
        return depth
    data = archive.read(shot.confidence, _MAX_BYTES)
    with naming(archive.where(shot.confidence)):
        values = unpack_lzfse(decoder, data, [rows * columns])
        return keep_confident(depth, np.frombuffer(values, np.uint8).reshape(rows, columns), _BEST)


def _turned(count: int, lens: Lens) -> tuple[int, int]:
    """Finds rows and columns for this number of values, turned as the image is."""
    longer, shorter = next(size for size in _DEPTH_SIZES if count == size[0] * size[1])
    return (longer, shorter) if lens.height > lens.width else (shorter, longer)


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
        reason = (
            f"the package lzfse does not contain its decoder ({error!s:.200}): another version?"
        )
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
