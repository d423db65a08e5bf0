"""Reads a .sens file, in which ScanNet and its app keep a whole scene (Dai et al. 2017).

Little endian. uint32 version 4; uint64 length and name of the sensor; four 4x4 float32 matrices:
intrinsics and extrinsics of color, then of depth; int32 codecs of color (1 PNG, 2 JPEG) and of
depth (0 raw, 1 zlib, of uint16); uint32 width and height of color, then of depth; float32 steps a
meter; uint64 number of frames. Each frame: 16 float32 camera to world (OpenCV axes, -inf where
tracking was lost), two uint64 times, uint64 bytes of color and of depth, and both.
"""

import struct
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import IMAGE_FORMATS, DepthUnit, Pixels, PosedImages
from r3jax.formats.poses import mend_pose
from r3jax.formats.sequences.scannet import UP, lost, scannet_lens
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular
from r3jax.validation.images import MAX_PIXELS, image_pixels, image_size

_VERSION = 4
_COLOR_CODECS, _DEPTH_CODECS = (1, 2), (0, 1)
_LONGEST_NAME = 1 << 16
_HEAD = struct.Struct("<ii4IfQ")
_FRAME = struct.Struct("<16f4Q")


class _Place(NamedTuple):
    """Where the data of a frame lie in the file [bytes]."""

    color: int
    color_bytes: int
    depth_bytes: int


class _Head(NamedTuple):
    """What is said of all frames."""

    lens: Lens
    depth_lens: Lens
    is_packed: bool
    unit: DepthUnit
    num_frames: int


def is_sens(path: Path) -> bool:
    """True if it is named like a .sens file, or is a folder with one."""
    return _file(path) is not None


def _file(path: Path) -> Path | None:
    if path.is_dir():
        found = list(path.glob("*.sens"))
        return found[0] if len(found) == 1 else None
    return path if path.suffix.lower() == ".sens" and path.is_file() else None


def read_sens(path: Path | str) -> PosedImages:
    """Opens a .sens file and checks everything but the pixels.

    Args:
        path: the file, or a folder that holds one.

    Raises:
        FormatError: another version or codec; cut off; cameras that make no sense; no frame that
            has a pose.
    """
    path = _file(Path(path)) or Path(path)
    with naming(path):
        size = check_regular(path)
        with open(path, "rb") as file:
            head = _head(file)
            frames = [_frame(file, size) for _ in range(_counted(head.num_frames, size))]
    kept = [
        (number, mend_pose(path, f"the pose of frame {number}", pose), place)
        for number, (pose, place) in enumerate(frames)
        if np.all(np.isfinite(pose))
    ]
    if not kept:
        raise FormatError(path, "no frame has a pose that is finite")
    places = [place for _, _, place in kept]
    return PosedImages(
        path=path,
        image_paths=tuple(path / f"frame {number}" for number, _, _ in kept),
        lenses=(head.lens,) * len(kept),
        poses=np.stack([pose for _, pose, _ in kept]),
        depth_paths=tuple(path / f"frame {number}" for number, _, _ in kept),
        pixels=Pixels(
            lambda index: _rgb(path, head, places[index]),
            lambda index: _depth(path, head, places[index]),
        ),
        depth_lenses=(head.depth_lens,) * len(kept),
        up=UP,
        remark=lost(len(frames) - len(kept), len(frames)),
    )


def _take(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise ForeignFileError("the file is cut off: download or copy it again")
    return data


def _head(file: BinaryIO) -> _Head:
    version, length = struct.unpack("<IQ", _take(file, 12))
    if version != _VERSION:
        raise ForeignFileError(f"its version is {version}, only {_VERSION} is read")
    if length > _LONGEST_NAME:
        raise ForeignFileError(f"the name of its sensor has {length} characters")
    _take(file, length)
    matrices = np.frombuffer(_take(file, 4 * 64), "<f4").reshape(4, 4, 4).astype(np.float64)
    values = _HEAD.unpack(_take(file, _HEAD.size))
    color_codec, depth_codec, width, height, depth_width, depth_height, steps, count = values
    if color_codec not in _COLOR_CODECS or depth_codec not in _DEPTH_CODECS:
        raise ForeignFileError(
            f"the codecs of color and depth are {color_codec} and {depth_codec}, only JPEG or PNG "
            "and plain or zlib are read"
        )
    if not 1e-3 < steps < 1e9:
        raise ForeignFileError(f"{steps:g} steps of depth a meter make no sense")
    if max(width * height, depth_width * depth_height) > MAX_PIXELS:
        raise ForeignFileError(f"more than {MAX_PIXELS} pixels are not read")
    return _Head(
        lens=scannet_lens(width, height, matrices[0]),
        depth_lens=scannet_lens(depth_width, depth_height, matrices[2]),
        is_packed=depth_codec == 1,
        unit=DepthUnit(1.0 / steps),
        num_frames=count,
    )


def _counted(count: int, size: int) -> int:
    """The number of frames, that must fit into a file of so many bytes."""
    if not 0 < count <= size // _FRAME.size:
        raise ForeignFileError(f"it claims to hold {count} frames in {size} bytes: copy it again")
    return count


def _frame(file: BinaryIO, size: int) -> tuple[np.ndarray, _Place]:
    """A pose, and where the pixels lie; they are not read."""
    *pose, _, _, color_bytes, depth_bytes = _FRAME.unpack(_take(file, _FRAME.size))
    at = file.tell()
    if at + color_bytes + depth_bytes > size:
        raise ForeignFileError("the file is cut off: download or copy it again")
    file.seek(at + color_bytes + depth_bytes)
    return np.array(pose).reshape(4, 4), _Place(at, color_bytes, depth_bytes)


def _read(path: Path, at: int, count: int) -> bytes:
    with open(path, "rb") as file:
        file.seek(at)
        return _take(file, count)


def _rgb(path: Path, head: _Head, place: _Place) -> np.ndarray:
    with naming(path):
        data = _read(path, place.color, place.color_bytes)
        image_size(data, IMAGE_FORMATS)  # refuses what would not fit into memory
        return image_pixels(data, IMAGE_FORMATS, (head.lens.width, head.lens.height))


def _depth(path: Path, head: _Head, place: _Place) -> np.ndarray:
    """z-depth [h, w] float32."""
    shape = (head.depth_lens.height, head.depth_lens.width)
    wanted = 2 * shape[0] * shape[1]
    with naming(path):
        data = _read(path, place.color + place.color_bytes, place.depth_bytes)
        if head.is_packed:
            try:
                data = zlib.decompressobj().decompress(data, wanted + 1)
            except zlib.error as error:
                raise ForeignFileError(f"a depth image is damaged ({error})") from None
        if len(data) != wanted:
            raise ForeignFileError(f"a depth image has {len(data)} bytes, not {wanted}")
    return head.unit.depth(np.frombuffer(data, "<u2").reshape(shape))
