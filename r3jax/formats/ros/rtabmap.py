"""Reads maps of RTAB-Map: its database (SQLite), and what it exports.

A database, as its apps and its node for ROS save it:

    Node.pose           12 float32: 3x4 matrix of the robot in the map, z up [m]
    Data.image          JPEG or PNG
    Data.depth          PNG of 16 bits [mm], PNG of four channels that are the bytes of float32 [m],
                        or RVL of 16 bits; a JPEG is the right image of a stereo camera
    Data.depth_confidence  8 bits, 0 to 100, as PNG or by zlib; older versions have none
    Data.calibration    11 int32: version, kind, size, numbers of elements; then float64 K, D, R, P
                        and 12 float32: the camera, optical axes, on the robot
    Admin.opt_ids       ids and poses of the optimized graph, by zlib, with 12 bytes behind it;
    Admin.opt_poses     where they are there, they go before Node.pose, and other nodes are left out

An export, `rtabmap-export --images_id --poses_camera --poses_format 11 X.db`:

    X_camera_poses.txt    lines "stamp x y z qx qy qz qw id", camera to map, OpenCV axes, z up [m]
    X_rgb/<id>.jpg        8-bit RGB
    X_depth/<id>.png      uint16, millimeters, of the same or fewer pixels
    X_calib/<id>.yaml     camera as OpenCV writes it; pixel centers at whole numbers

Images are rectified: RTAB-Map takes the projection matrix, where there is one, and no distortion.
(https://github.com/introlab/rtabmap: DatabaseSchema.sql, Compression.cpp, CameraModel.cpp)
"""

import re
import sqlite3
import struct
import zlib
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r3jax.formats.depth import DEPTH_MODES, keep_confident
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.phones.archives import (
    Archive,
    Shot,
    complete_shots,
    confident_depth,
    posed_images,
)
from r3jax.formats.posed_images import IMAGE_FORMATS, Pixels, PosedImages, left_out
from r3jax.formats.poses import UP_Z, mend_pose, quaternion_pose, read_numbers
from r3jax.formats.ros.messages import clean_depth, rectified_lens, unpack_rvl
from r3jax.validation.database import check_database, query_database
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import plain_text
from r3jax.validation.images import MAX_PIXELS, image_pixels

_HEADER = 11
_RVL = b"DEPTHRVL"
_PNG = b"\x89PNG"
_MAX_GRAPH = 256 << 20
"""A pose takes 48 bytes [bytes]."""

_SURE = 100
"""Of 0 to 100."""

_CONFIDENCE = "SELECT depth_confidence FROM Data WHERE id = ? AND length(depth_confidence) > 0"

_NODES = (
    "SELECT Node.id, Node.pose, Data.calibration FROM Node JOIN Data ON Data.id = Node.id "
    "WHERE length(Data.image) > 0 AND length(Data.depth) > 0 ORDER BY Node.id"
)


def is_rtabmap_database(path: Path) -> bool:
    """Checks whether the file is a database with the tables of RTAB-Map."""
    if path.suffix.lower() != ".db" or not path.is_file():
        return False
    try:
        with naming(path):
            check_database(path)
        names = {name for (name,) in _query(path, "SELECT name FROM sqlite_master")}
    except FormatError:
        return False
    return {"Node", "Data", "Link"} <= names


def read_rtabmap_database(path: Path | str) -> PosedImages:
    """Opens a database and checks everything but the pixels.

    Args:
        path: the .db file.

    Raises:
        FormatError: no SQLite, damaged, of an old version, of a stereo camera or several cameras;
            no node with an image, depth, a camera and a pose.
    """
    path = Path(path)
    with _reading(path):
        check_database(path, ("Node", "Data", "Admin"))
    rows = _query(path, _NODES)
    columns = {row[1] for row in _query(path, "PRAGMA table_info(Data)")}
    has_confidence = "depth_confidence" in columns
    (total,) = _query(path, "SELECT count(*) FROM Data WHERE length(image) > 0")[0]
    if not total:
        (nodes,) = _query(path, "SELECT count(*) FROM Node")[0]
        raise FormatError(
            path,
            f"the map has {nodes} nodes and no image: RTAB-Map keeps images only with "
            "Mem/BinDataKept true, so map again with it, or audit the bag that it was made from",
        )
    with naming(path):
        optimized = _optimized(path)
        nodes = [node for row in rows if (node := _node(path, row, optimized)) is not None]
    if not nodes:
        raise FormatError(
            path,
            f"of {total} images in it none has depth, a camera and a pose: export what there is by "
            f"{COMMAND.format(path)}",
        )
    gone = total - len(nodes)
    which = "odometry's: the graph was never optimized" if optimized is None else "optimized"
    lost = left_out(gone, total, "images")
    return PosedImages(
        path=path,
        image_paths=tuple(path / "image" / str(node.id) for node in nodes),
        lenses=tuple(node.lens for node in nodes),
        poses=np.stack([node.pose for node in nodes]),
        depth_paths=tuple(path / "depth" / str(node.id) for node in nodes),
        pixels=Pixels(
            lambda index: _rgb(path, nodes[index]),
            lambda index: _depth(path, nodes[index], has_confidence=has_confidence),
        ),
        up=UP_Z,
        remark=f"Poses are {which}.{'' if lost is None else f' {lost}'}",
    )


class _Node(NamedTuple):
    """A node with an image."""

    id: int
    lens: Lens
    pose: np.ndarray
    """`T_map_camera`, [4, 4]."""


@contextmanager
def _reading(path: Path) -> Generator[None]:
    """Names the database in what goes wrong in SQLite.

    Raises:
        FormatError: missing, no database, damaged, or without such tables.
    """
    with naming(path):
        try:
            yield
        except (sqlite3.Error, UnicodeError, OverflowError) as error:
            raise ForeignFileError(
                f"this database cannot be read ({error!s:.200}): was RTAB-Map closed when it was "
                f"copied? Or export it: {COMMAND.format(path)}"
            ) from None


def _query(path: Path, sql: str, values: Sequence[Any] = ()) -> list[Any]:
    """Reads all rows of a query; raises FormatError as `_reading`."""
    with _reading(path):
        return query_database(path, sql, values)


def _optimized(path: Path) -> dict[int, np.ndarray] | None:
    """Reads the poses of the robot by the node's id, [4, 4].

    The result is None if the graph was never optimized.
    """
    columns = {row[1] for row in _query(path, "PRAGMA table_info(Admin)")}
    if not {"opt_ids", "opt_poses"} <= columns:
        return None
    rows = _query(path, "SELECT opt_ids, opt_poses FROM Admin WHERE opt_poses IS NOT NULL")
    if not rows:
        return None
    ids, poses = (_unzipped(blob) for blob in rows[0])
    if not ids or len(poses) != 12 * len(ids):
        raise ForeignFileError("the optimized poses are damaged: are they as many as their ids?")
    numbers = np.frombuffer(ids, "<i4")
    return dict(zip(numbers.tolist(), _poses(poses), strict=True))


def _unzipped(blob: Any) -> bytes:
    """Unpacks the bytes of a matrix that RTAB-Map compressed, without its size and type."""
    if not isinstance(blob, bytes):
        raise ForeignFileError("the optimized poses are no bytes")
    try:
        data = zlib.decompressobj().decompress(blob, _MAX_GRAPH)
    except zlib.error as error:
        raise ForeignFileError(f"the optimized poses are damaged ({error})") from None
    return data[: len(data) // 4 * 4]


def _poses(data: bytes) -> np.ndarray:
    """Reads matrices [n, 4, 4] from rows of 12 float32."""
    poses = np.tile(np.eye(4), (len(data) // 48, 1, 1))
    poses[:, :3] = np.frombuffer(data, "<f4").reshape(-1, 3, 4)
    return poses


def _node(
    path: Path, row: tuple[Any, ...], optimized: dict[int, np.ndarray] | None
) -> _Node | None:
    """Reads a node; None if it has no camera or no pose."""
    number, pose, calibration = row
    is_known = isinstance(number, int) and isinstance(calibration, bytes)
    if not is_known or not isinstance(pose, bytes) or len(pose) != 48:
        return None
    T_map_robot = _poses(pose)[0] if optimized is None else optimized.get(number)
    if T_map_robot is None or not T_map_robot[:3, :3].any():  # RTAB-Map's null is all zero
        return None
    lens, T_robot_camera = _camera(path, number, calibration)
    which = f"the pose of node {number}"
    return _Node(number, lens, mend_pose(path, which, T_map_robot @ T_robot_camera))


def _camera(path: Path, number: int, data: bytes) -> tuple[Lens, np.ndarray]:
    """Reads a node's lens, and the pose of the camera on the robot."""
    header = np.frombuffer(data[: 4 * _HEADER], "<i4").tolist()
    if len(header) < _HEADER or header[3] != 0:
        raise ForeignFileError(
            "its cameras are those of a stereo rig or of an old version: export depth images by "
            f"{COMMAND.format(path)}"
        )
    width, height, *counts, places = header[4:]
    if min(counts) < 0 or max(counts) > 64 or places != 12:
        raise ForeignFileError(f"the camera of node {number} is damaged")
    begin = 4 * _HEADER
    middle = begin + 8 * sum(counts)
    end = middle + 4 * places
    if len(data) < end:
        raise ForeignFileError(f"the camera of node {number} is truncated")
    if len(data) >= end + 4 * _HEADER:
        raise ForeignFileError("nodes with several cameras are not supported: export one of them")
    parts = np.split(np.frombuffer(data[begin:middle], "<f8"), np.cumsum(counts)[:-1])
    K, P = parts[0], parts[3]
    matrix = P if len(P) == 12 else K
    if len(matrix) not in (9, 12):
        raise ForeignFileError(f"the camera of node {number} has no matrix")
    return rectified_lens(matrix, (width, height)), _poses(data[middle:end])[0]


def _blob(path: Path, column: str, node: _Node) -> bytes:
    rows = _query(path, f"SELECT {column} FROM Data WHERE id = ?", (node.id,))
    if len(rows) != 1 or not isinstance(rows[0][0], bytes):
        raise ForeignFileError("this is no image")
    return rows[0][0]


def _rgb(path: Path, node: _Node) -> np.ndarray:
    with naming(path / "image" / str(node.id)):
        data = _blob(path, "image", node)
        return image_pixels(data, IMAGE_FORMATS, (node.lens.width, node.lens.height))


def _depth(path: Path, node: _Node, *, has_confidence: bool) -> np.ndarray:
    """Reads z-depth [h, w] float32 where the sensor was confident."""
    with naming(path / "depth" / str(node.id)):
        depth = _all_depth(_blob(path, "depth", node))
        rows = _query(path, _CONFIDENCE, (node.id,)) if has_confidence else []
        if not rows:
            return depth
        if not isinstance(rows[0][0], bytes):
            raise ForeignFileError("its confidence is no image")
        return keep_confident(depth, _confidence(rows[0][0]), _SURE)


def _confidence(data: bytes) -> np.ndarray:
    """Reads the confidence [h, w] uint8.

    It is a PNG, or rows packed by zlib and followed by their number, length and type.
    """
    if data.startswith(_PNG):
        wanted = "confidence must be an 8-bit PNG"
        return image_pixels(data, ("PNG",), None, ("L",), wanted)
    rows, columns, kind = struct.unpack("<3i", data[-12:].rjust(12, b"\0"))
    if rows <= 0 or columns <= 0 or kind != 0 or rows * columns > MAX_PIXELS:
        raise ForeignFileError("its confidence is damaged")
    try:
        levels = zlib.decompressobj().decompress(data, rows * columns)
    except zlib.error:
        levels = b""
    if len(levels) != rows * columns:
        raise ForeignFileError("its confidence is damaged")
    return np.frombuffer(levels, np.uint8).reshape(rows, columns)


def _all_depth(data: bytes) -> np.ndarray:
    """Reads z-depth [h, w] float32 as it is stored."""
    if data.startswith(_RVL):
        return clean_depth(0.001 * unpack_rvl(data[len(_RVL) :]).astype(np.float64))
    wanted = "depth must be a PNG of 16 bits or of four channels"
    pixels = image_pixels(data, ("PNG",), None, (*DEPTH_MODES, "RGBA"), wanted)
    if pixels.ndim == 2:
        return clean_depth(0.001 * pixels.astype(np.float64))
    stored = np.ascontiguousarray(pixels[..., [2, 1, 0, 3]])  # OpenCV's order
    return clean_depth(stored.view("<f4")[..., 0])


COMMAND = "rtabmap-export --images_id --poses_camera --poses_format 11 {}"
"""What a user runs on a database."""

_POSES = "_camera_poses.txt"


def is_rtabmap_export(path: Path) -> bool:
    """Returns True if the folder looks like an export of RTAB-Map."""
    return _name(path) is not None


def _name(path: Path) -> str | None:
    """Finds the prefix that the names of all files share."""
    found = [one.name.removesuffix(_POSES) for one in path.glob(f"*{_POSES}")]
    found = [name for name in found if (path / f"{name}_rgb").is_dir()]
    return found[0] if len(found) == 1 else None


def read_rtabmap_export(path: Path | str) -> PosedImages:
    """Opens an export and checks everything but the pixels.

    Args:
        path: the folder.

    Raises:
        FormatError: poses or cameras that are missing or damaged; no image with depth.
    """
    path = Path(path)
    name = _name(path)
    if name is None:
        raise FormatError(path, f"there is no file *{_POSES} with a folder *_rgb in it")
    source = path / f"{name}{_POSES}"
    archive = Archive(path)
    rows = read_numbers(source, columns=9)
    shots = [_shot(archive, source, name, row) for row in rows]
    advice = (
        "this looks like an export of RTAB-Map without images and depth that are named by their "
        f"ids: {COMMAND.format('DATABASE')}"
    )
    kept, remark = complete_shots(archive, [shot for shot in shots if shot], len(rows), advice)
    read = partial(confident_depth, archive, best=0)
    return posed_images(archive, kept, depth=read, up=UP_Z, remark=remark)


def _shot(archive: Archive, source: Path, name: str, row: np.ndarray) -> Shot | None:
    """Makes one frame of a row [9]; None if it has no image or camera."""
    number = int(row[8]) if np.isfinite(row[8]) and abs(row[8]) < 1e15 else -1
    image, calibration = f"{name}_rgb/{number}.jpg", f"{name}_calib/{number}.yaml"
    if not archive.has(image) or not archive.has(calibration):
        return None
    with naming(archive.where(calibration)):
        text = plain_text(archive.read(calibration)).decode(errors="replace")
        lens = _lens(text, archive.size(image))
    return Shot(
        image=image,
        depth=f"{name}_depth/{number}.png",
        confidence="",
        lens=lens,
        pose=quaternion_pose(source, f"the pose of image {number}", row[1:4], row[4:8]),
    )


def _lens(text: str, size: tuple[int, int]) -> Lens:
    """Reads the camera in a YAML of OpenCV, for an image of this width and height."""
    matrix = _matrix(text, "projection_matrix", 12)
    matrix = _matrix(text, "camera_matrix", 9) if matrix is None else matrix
    if matrix is None:
        raise ForeignFileError("there is no camera_matrix in it")
    return rectified_lens(matrix, size)


def _matrix(text: str, name: str, count: int) -> np.ndarray | None:
    """Reads the numbers of a matrix; None if it is missing."""
    found = re.search(rf"{name}:[^\[\]]{{0,200}}data:\s*\[([^\[\]]{{0,2000}})\]", text)
    if found is None:
        return None
    try:
        numbers = np.array([float(word) for word in found[1].split(",")])
    except ValueError:
        raise ForeignFileError(f"{name} contains a word that is not a number") from None
    if len(numbers) != count:
        raise ForeignFileError(f"{name} must have {count} numbers, got {len(numbers)}")
    return numbers
