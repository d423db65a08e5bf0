"""COLMAP's text files: one row a line, two lines an image, # before comments."""

import io
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from r3jax.errors import InputError
from r3jax.files import write_atomic
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, ColmapPoints
from r3jax.formats.errors import naming
from r3jax.formats.lenses import Lens
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import plain_text, read_bytes

T = TypeVar("T")

_MAX_BYTES = 2 << 30
"""Larger models are stored in binary."""

_LARGEST_ID = (1 << 63) - 1
_LONGEST_NUMBER = 64
"""More digits have no meaning in a double."""


def read_text(folder: Path) -> ColmapModel:
    """Reads cameras.txt, images.txt and points3D.txt; rigs.txt and frames.txt say nothing more.

    Raises:
        FormatError: a file is missing or damaged: says which file, which line and what.
    """
    with naming(folder / "cameras.txt"):
        cameras: dict[int, Lens] = {}
        for line in _rows(folder / "cameras.txt"):
            number, lens = _parsed(line, _camera)
            if number in cameras:
                raise ForeignFileError(f"line {line[0]}: the camera {number} occurs twice")
            cameras[number] = lens
    with naming(folder / "images.txt"):
        images = tuple(_images(folder / "images.txt"))
    with naming(folder / "points3D.txt"):
        points = _points([_parsed(line, _point) for line in _rows(folder / "points3D.txt")])
    return ColmapModel(cameras, images, points)


def write_text(folder: Path, model: ColmapModel) -> None:
    """Writes cameras.txt, images.txt and points3D.txt into a folder that exists.

    Raises:
        ValueError: an image's name that no line can hold: with a line break, or with blanks at
            its ends.
        OSError: the disk is full, not writable, ...
    """
    for image in model.images:
        if image.name != image.name.strip() or len(image.name.splitlines()) != 1:
            raise InputError(f"the text format cannot store the name {image.name!r}: use binary")
    for name, lines in (
        ("cameras.txt", _camera_lines(model)),
        ("images.txt", _image_lines(model)),
        ("points3D.txt", _point_lines(model.points)),
    ):
        write_atomic(folder / name, os.fsencode("".join(f"{line}\n" for line in lines)))


_Line = tuple[int, str]
"""Number and text of a line."""


def _lines(path: Path) -> Iterator[_Line]:
    """Yields every line, without blanks at its ends."""
    for number, raw in enumerate(io.BytesIO(plain_text(read_bytes(path, _MAX_BYTES))), start=1):
        yield number, os.fsdecode(raw).strip()


def _rows(path: Path) -> Iterator[_Line]:
    """Yields the lines that are neither empty nor comments."""
    return (line for line in _lines(path) if _is_row(line))


def _is_row(line: _Line) -> bool:
    return bool(line[1]) and not line[1].startswith("#")


def _parsed(line: _Line, parse: Callable[[str], T]) -> T:
    """Parses a line; errors get its number."""
    try:
        return parse(line[1])
    except (ValueError, OverflowError) as error:
        raise ForeignFileError(f"line {line[0]}: {error!s:.200}") from None


def _number(word: str) -> float:
    if len(word) > _LONGEST_NUMBER:
        raise ForeignFileError(f"{word[:20]!r}... is no number")
    return float(word)


def _id(word: str) -> int:
    if len(word) > _LONGEST_NUMBER:
        raise ForeignFileError(f"{word[:20]!r}... is no number")
    number = int(word)
    if not 0 <= number <= _LARGEST_ID:
        raise ForeignFileError(f"{word} is no identifier")
    return number


def _point_id(word: str) -> int:
    return -1 if word == "-1" else _id(word)


def _words(text: str, least: int, what: str) -> list[str]:
    words = text.split()
    if len(words) < least:
        raise ForeignFileError(f"{what} needs at least {least} words, found {len(words)}")
    return words


def _camera(text: str) -> tuple[int, Lens]:
    number, model, width, height, *params = _words(text, 4, "a camera")
    values = tuple(_number(word) for word in params[:100])
    return _id(number), Lens(model, _id(width), _id(height), values)


def _images(path: Path) -> Iterator[ColmapImage]:
    lines = _lines(path)
    for line in lines:
        if _is_row(line):
            # The second line may be empty, hence no comment is looked for.
            keypoints = next(lines, (line[0] + 1, ""))
            xy, ids = _parsed(keypoints, _keypoints)
            yield _parsed(line, lambda text, xy=xy, ids=ids: _image(text, xy, ids))


def _image(text: str, keypoints: np.ndarray, point_ids: np.ndarray) -> ColmapImage:
    words = text.split(maxsplit=9)  # a name may hold blanks
    if len(words) < 10:
        raise ForeignFileError(f"an image needs 10 words, found {len(words)}")
    pose = np.array([_number(word) for word in words[1:8]])
    return ColmapImage(
        id=_id(words[0]),
        name=words[9],
        camera_id=_id(words[8]),
        quaternion=pose[:4],
        translation=pose[4:],
        keypoints=keypoints,
        point_ids=point_ids,
    )


def _keypoints(text: str) -> tuple[np.ndarray, np.ndarray]:
    words = text.split()
    if len(words) % 3:
        raise ForeignFileError(f"keypoints need three numbers each, found {len(words)} words")
    x, y = ([_number(word) for word in words[axis::3]] for axis in range(2))
    return np.array([x, y]).T.reshape(-1, 2), np.array(list(map(_point_id, words[2::3])), np.int64)


_Point = tuple[int, list[float], list[int], float, list[int]]


def _point(text: str) -> _Point:
    words = _words(text, 8, "a point")
    if len(words) % 2:
        raise ForeignFileError("the last element of the track is missing its keypoint")
    rgb = [_id(word) for word in words[4:7]]
    if max(rgb) > 255:
        raise ForeignFileError(f"the color {' '.join(words[4:7])} is not 0 to 255")
    xyz = [_number(word) for word in words[1:4]]
    return _id(words[0]), xyz, rgb, _number(words[7]), [_id(word) for word in words[8:]]


def _points(rows: Sequence[_Point]) -> ColmapPoints:
    tracks = np.array([number for row in rows for number in row[4]], np.int64)
    return ColmapPoints(
        ids=np.array([row[0] for row in rows], np.int64),
        xyz=np.array([row[1] for row in rows], np.float64).reshape(-1, 3),
        rgb=np.array([row[2] for row in rows], np.uint8).reshape(-1, 3),
        error=np.array([row[3] for row in rows], np.float64),
        track_lengths=np.array([len(row[4]) // 2 for row in rows], np.int64),
        track_images=tracks[0::2],
        track_keypoints=tracks[1::2],
    )


def _joined(*values: object) -> str:
    """Joins numbers with all their digits, so that reading restores them exactly."""
    return " ".join(str(value) for value in values)


def _camera_lines(model: ColmapModel) -> Iterator[str]:
    yield "# Camera list with one line of data per camera:"
    yield "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    yield f"# Number of cameras: {len(model.cameras)}"
    for number, lens in sorted(model.cameras.items()):
        yield _joined(number, lens.model, lens.width, lens.height, *lens.params)


def _image_lines(model: ColmapModel) -> Iterator[str]:
    yield "# Image list with two lines of data per image:"
    yield "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "#   POINTS2D[] as (X, Y, POINT3D_ID)"
    yield f"# Number of images: {len(model.images)}"
    for image in model.images:
        pose = (*image.quaternion.tolist(), *image.translation.tolist())
        yield _joined(image.id, *pose, image.camera_id, image.name)
        keypoints = zip(image.keypoints.tolist(), image.point_ids.tolist(), strict=True)
        yield _joined(*(_joined(*xy, point) for xy, point in keypoints))


def _point_lines(points: ColmapPoints) -> Iterator[str]:
    yield "# 3D point list with one line of data per point:"
    yield "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    yield f"# Number of points: {len(points)}"
    elements = np.stack([points.track_images, points.track_keypoints], axis=1)
    ends = np.cumsum(points.track_lengths)
    for i, (end, length) in enumerate(zip(ends, points.track_lengths, strict=True)):
        track = elements[end - length : end].reshape(-1).tolist()
        xyz, rgb = points.xyz[i].tolist(), points.rgb[i].tolist()
        yield _joined(int(points.ids[i]), *xyz, *rgb, float(points.error[i]), *track)
