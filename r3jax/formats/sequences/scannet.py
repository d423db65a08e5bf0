"""Reads a scene of ScanNet (Dai et al. 2017), as its own reader exports it or as a .sens file.

    color/0.jpg                        8-bit RGB
    depth/0.png                        uint16, millimeters, of fewer pixels
    pose/0.txt                         a 4x4 camera-to-world matrix, OpenCV axes, world z up [m];
                                       inf where tracking was lost: these frames are left out
    intrinsic/intrinsic_color.txt      4x4 or 3x3 intrinsics, pixel centers at whole numbers
    intrinsic/intrinsic_depth.txt      the same of the depth images

A .sens file holds a whole scene, little endian. uint32 version 4; uint64 length and name of the
sensor; four 4x4 float32 matrices: intrinsics and extrinsics of color, then of depth; int32 codecs
of color (1 PNG, 2 JPEG) and of depth (0 raw, 1 zlib, of uint16); uint32 width and height of color,
then of depth; float32 steps a meter; uint64 number of frames. Each frame: 16 float32 camera to
world (-inf where tracking was lost), two uint64 times, uint64 bytes of color and of depth, and
both.

Both cameras count as one place: ScanNet's own depth is registered to its colors.
(https://github.com/ScanNet/ScanNet)
"""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from r3jax.formats.depth import DepthUnit
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, matrix_lens
from r3jax.formats.posed_images import IMAGE_FORMATS, Pixels, PosedImages, left_out
from r3jax.formats.poses import UP_Z, mend_pose, read_lines, read_matrix
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular
from r3jax.validation.images import MAX_PIXELS, first_size, image_pixels


def is_scannet(path: Path) -> bool:
    """Returns True if the folder looks like an exported scene."""
    return all((path / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))


def read_scannet(path: Path | str) -> PosedImages:
    """Opens an exported scene and checks everything but the pixels.

    Args:
        path: the folder of the scene.

    Raises:
        FormatError: no frame with a pose, a pose or intrinsics that are missing, damaged, or not
            rigid. Images that are missing are noticed when they are read.
    """
    path = Path(path)
    images = sorted((path / "color").glob("*.[jp][pn]g"), key=_number)
    if not images:
        raise FormatError(path / "color", "the folder holds no image (*.jpg, *.png)")
    poses = [_pose(path / "pose" / f"{image.stem}.txt") for image in images]
    found = [(image, pose) for image, pose in zip(images, poses, strict=True) if pose is not None]
    if not found:
        raise FormatError(path / "pose", "no frame has a pose that is finite")
    used = [image for image, _ in found]
    depths = [path / "depth" / f"{image.stem}.png" for image in used]
    count = len(found)
    return PosedImages(
        path=path,
        image_paths=tuple(used),
        lenses=(_lens(path / "intrinsic" / "intrinsic_color.txt", used),) * count,
        poses=np.stack([pose for _, pose in found]),
        depth_paths=tuple(depths),
        depth_lenses=(_lens(path / "intrinsic" / "intrinsic_depth.txt", depths),) * count,
        up=UP_Z,
        remark=left_out(len(images) - count, len(images)),
    )


def _pose(source: Path) -> np.ndarray | None:
    """Reads a camera-to-world matrix [4, 4]; None where tracking was lost."""
    pose = read_matrix(source, 4, 4)
    return mend_pose(source, "the pose", pose) if np.all(np.isfinite(pose)) else None


def _lens(source: Path, images: Sequence[Path]) -> Lens:
    lines = list(read_lines(source))
    size = 3 if lines and len(lines[0][1]) == 3 else 4
    K = read_matrix(source, size, size)
    with naming(images[0]):
        width, height = first_size(images, IMAGE_FORMATS)
    with naming(source):
        return matrix_lens(K, (width, height))


def _number(path: Path) -> tuple[int, str]:
    """Returns a sort key by the number in a name: 10 comes after 9."""
    is_number = path.stem.isascii() and path.stem.isdigit() and len(path.stem) < 19
    return (int(path.stem) if is_number else 1 << 62), path.name


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
    """Checks whether the path is named like a .sens file, or is a folder with one."""
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
        up=UP_Z,
        remark=left_out(len(frames) - len(kept), len(frames)),
    )


def _take(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise ForeignFileError("the file is cut off: download or copy it again")
    return data


def _head(file: BinaryIO) -> _Head:
    version, length = struct.unpack("<IQ", _take(file, 12))
    if version != _VERSION:
        raise ForeignFileError(f"unsupported version {version}, only {_VERSION} is read")
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
        raise ForeignFileError(f"invalid depth unit: {steps:g} steps per meter")
    if max(width * height, depth_width * depth_height) > MAX_PIXELS:
        raise ForeignFileError(f"images have more than {MAX_PIXELS} pixels")
    return _Head(
        lens=matrix_lens(matrices[0], (width, height)),
        depth_lens=matrix_lens(matrices[2], (depth_width, depth_height)),
        is_packed=depth_codec == 1,
        unit=DepthUnit(1.0 / steps),
        num_frames=count,
    )


def _counted(count: int, size: int) -> int:
    """Reads the number of frames, which must fit into a file of this size."""
    if not 0 < count <= size // _FRAME.size:
        raise ForeignFileError(f"it declares {count} frames in {size} bytes: copy it again")
    return count


def _frame(file: BinaryIO, size: int) -> tuple[np.ndarray, _Place]:
    """Reads a pose, and locates the pixels without reading them."""
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
        return image_pixels(data, IMAGE_FORMATS, (head.lens.width, head.lens.height))


def _depth(path: Path, head: _Head, place: _Place) -> np.ndarray:
    """Reads z-depth [h, w] float32."""
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
