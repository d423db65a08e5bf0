"""COLMAP's binary files: little endian, each table preceded by its number of rows.

Numbers of rows are compared with the remaining bytes before memory is allocated.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from r3jax.files import write_atomic
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, ColmapPoints
from r3jax.formats.errors import naming
from r3jax.formats.lenses import MODELS, NAMES, Lens
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes

_MAX_BYTES = 4 << 30
"""Maximum size of a file; models of cities are smaller."""

_LONGEST_NAME = 4096
"""Linux opens no longer path [bytes]."""

_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
_POINT = struct.Struct("<Q3d3BdQ")
_IMAGE = struct.Struct("<I4d3dI")
_CAMERA = struct.Struct("<IiQQ")
_COUNT = struct.Struct("<Q")
_LARGEST_ID = (1 << 63) - 1


def read_binary(folder: Path) -> ColmapModel:
    """Reads cameras.bin, images.bin and points3D.bin; rigs.bin and frames.bin are not needed.

    Raises:
        FormatError: a file is missing, truncated, longer than its tables, or has invalid content;
            names the file and the reason.
    """
    with naming(folder / "cameras.bin"):
        cameras = _cameras(_Cursor(read_bytes(folder / "cameras.bin", _MAX_BYTES)))
    with naming(folder / "images.bin"):
        images = tuple(_images(_Cursor(read_bytes(folder / "images.bin", _MAX_BYTES))))
    with naming(folder / "points3D.bin"):
        points = _points(_Cursor(read_bytes(folder / "points3D.bin", _MAX_BYTES)))
    return ColmapModel(cameras, images, points)


def write_binary(folder: Path, model: ColmapModel) -> None:
    """Writes cameras.bin, images.bin and points3D.bin into a folder that exists.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    write_atomic(folder / "cameras.bin", b"".join(_camera_bytes(model)))
    write_atomic(folder / "images.bin", b"".join(_image_bytes(model)))
    write_atomic(folder / "points3D.bin", b"".join(_point_bytes(model.points)))


class _Cursor:
    """A place in the bytes of a file."""

    def __init__(self, data: bytes):
        self._data = data
        self._at = 0

    def take(self, kind: struct.Struct) -> tuple[int | float, ...]:
        """Reads the next numbers."""
        self._check(kind.size)
        self._at += kind.size
        return kind.unpack_from(self._data, self._at - kind.size)

    def count(self, what: str, size: int) -> int:
        """Reads the number of rows that follow, of at least `size` bytes each."""
        count = int(self.take(_COUNT)[0])
        left = len(self._data) - self._at
        if count * size > left:
            raise ForeignFileError(
                f"it is truncated: it declares {count} {what}, and only {left} bytes follow"
            )
        return count

    def table(self, kind: np.dtype, count: int) -> np.ndarray:
        """Reads the next `count` rows; `count` has been checked."""
        self._check(count * kind.itemsize)
        found = np.frombuffer(self._data, kind, count, self._at)
        self._at += count * kind.itemsize
        return found

    def text(self) -> str:
        """Reads the bytes up to the next zero byte, as a file's name."""
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME + 1)
        if end < 0:
            raise ForeignFileError(f"the image name at byte {self._at} is not terminated")
        name = os.fsdecode(self._data[self._at : end])
        self._at = end + 1
        return name

    def end(self) -> None:
        """Refuses bytes after the last row."""
        left = len(self._data) - self._at
        if left:
            raise ForeignFileError(f"damaged: {left} bytes after the last row")

    def _check(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise ForeignFileError(f"truncated: {size} bytes should follow byte {self._at}")


def _cameras(file: _Cursor) -> dict[int, Lens]:
    cameras: dict[int, Lens] = {}
    for _ in range(file.count("cameras", _CAMERA.size)):
        number, model, width, height = (int(x) for x in file.take(_CAMERA))
        if model not in NAMES:
            raise ForeignFileError(f"camera {number} has the unknown model {model}")
        if number in cameras:
            raise ForeignFileError(f"the camera {number} occurs twice")
        params = file.take(struct.Struct(f"<{len(MODELS[NAMES[model]][1])}d"))
        cameras[number] = Lens(NAMES[model], width, height, tuple(float(x) for x in params))
    file.end()
    return cameras


def _images(file: _Cursor) -> Iterator[ColmapImage]:
    for _ in range(file.count("images", _IMAGE.size + 1 + _COUNT.size)):
        number, *pose, camera = file.take(_IMAGE)
        name = file.text()
        keypoints = file.table(_KEYPOINT, file.count("keypoints", _KEYPOINT.itemsize))
        yield ColmapImage(
            id=int(number),
            name=name,
            camera_id=int(camera),
            quaternion=np.array(pose[:4]),
            translation=np.array(pose[4:]),
            keypoints=keypoints["xy"],
            point_ids=keypoints["point"],
        )
    file.end()


def _points(file: _Cursor) -> ColmapPoints:
    count = file.count("points", _POINT.size)
    ids, lengths = np.empty(count, np.int64), np.empty(count, np.int64)
    xyz, error = np.empty((count, 3)), np.empty(count)
    rgb = np.empty((count, 3), np.uint8)
    tracks: list[np.ndarray] = [np.empty(0, _TRACK)]
    for i in range(count):
        number, *values, length = file.take(_POINT)
        if number > _LARGEST_ID or length * _TRACK.itemsize > _MAX_BYTES:
            raise ForeignFileError(f"point {number} declares a track of {length} images")
        ids[i], lengths[i] = number, length
        xyz[i], rgb[i], error[i] = values[:3], values[3:6], values[6]
        tracks.append(file.table(_TRACK, int(length)))
    file.end()
    track = np.concatenate(tracks)
    return ColmapPoints(
        ids=ids,
        xyz=xyz,
        rgb=rgb,
        error=error,
        track_lengths=lengths,
        track_images=track["image"].astype(np.int64),
        track_keypoints=track["keypoint"].astype(np.int64),
    )


def _camera_bytes(model: ColmapModel) -> Iterator[bytes]:
    yield _COUNT.pack(len(model.cameras))
    for number, lens in sorted(model.cameras.items()):
        yield _CAMERA.pack(number, MODELS[lens.model][0], lens.width, lens.height)
        yield np.asarray(lens.params, "<f8").tobytes()


def _image_bytes(model: ColmapModel) -> Iterator[bytes]:
    yield _COUNT.pack(len(model.images))
    for image in model.images:
        yield _IMAGE.pack(image.id, *image.quaternion, *image.translation, image.camera_id)
        yield os.fsencode(image.name) + b"\0" + _COUNT.pack(len(image.keypoints))
        table = np.empty(len(image.keypoints), _KEYPOINT)
        table["xy"], table["point"] = image.keypoints, image.point_ids
        yield table.tobytes()


def _point_bytes(points: ColmapPoints) -> Iterator[bytes]:
    yield _COUNT.pack(len(points))
    tracks = np.empty(len(points.track_images), _TRACK)
    tracks["image"], tracks["keypoint"] = points.track_images, points.track_keypoints
    ends = np.cumsum(points.track_lengths)
    for i, (end, length) in enumerate(zip(ends, points.track_lengths, strict=True)):
        yield _POINT.pack(
            int(points.ids[i]), *points.xyz[i], *points.rgb[i].tolist(), points.error[i], length
        )
        yield tracks[end - length : end].tobytes()
