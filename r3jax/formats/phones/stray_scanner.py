"""Reads recordings of Stray Scanner.

    rgb.mp4                  the video
    depth/000000.png         uint16, millimeters
    confidence/000000.png    2 is the best
    odometry.csv             "timestamp, frame, x, y, z, qx, qy, qz, qw", camera to world, OpenCV
                             axes, world y up [m]; newer versions: and fx, fy, cx, cy, and
                             distortion_center_x, distortion_center_y, which may be empty
    camera_matrix.csv        3x3 intrinsics of the video, of the last frame

Columns are found by their names, and an empty field is not known.
(https://github.com/StrayRobots/scanner)
"""

import math
from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.phones.archives import (
    Archive,
    Shot,
    complete_shots,
    confident_depth,
    find_archive,
    is_there,
    posed_images,
)
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.poses import UP_Y, quaternion_pose, read_matrix
from r3jax.formats.video import Video
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular, plain_text

_BEST = 2
_POSE = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_VIDEO = "rgb.mp4"
_MAX_VIDEO = 4 << 30
"""Size of a video in an archive, which is read as a whole [bytes]."""


def is_stray_scanner(path: Path) -> bool:
    """Returns True if the folder or archive looks like a recording of Stray Scanner."""
    return is_there(path, "odometry.csv", _VIDEO)


def read_stray_scanner(path: Path | str) -> PosedImages:
    """Opens a recording and checks everything but the pixels.

    Args:
        path: the folder that the app wrote, or a zip archive of it.

    Raises:
        FormatError: PyAV is not installed; files that are missing or damaged; frames that the
            video does not have; poses that are not finite; no depth images.
    """
    path = Path(path)
    archive = find_archive(path, "odometry.csv", _VIDEO)
    if archive is None:
        raise FormatError(path, "there are no odometry.csv and rgb.mp4 in it")
    video = _video(archive)
    with naming(archive.where("odometry.csv")):
        poses, intrinsics = _table(archive)
        unknown = np.isnan(intrinsics).any(axis=1)
        if unknown.any():
            intrinsics[unknown] = _camera_matrix(archive)
        shots = [
            _shot(archive, video, *row)
            for row in zip(poses, intrinsics, strict=True)
            # Some videos end before the poses do; where tracking was lost there is no pose.
            if row[0][0] < len(video) and not np.isnan(row[0]).any()
        ]
    advice = (
        "this looks like a recording of Stray Scanner without depth/: the phone has no LiDAR "
        f"sensor, or the folder was not copied; ns-process-data video --data {path / _VIDEO} "
        "--output-dir OUT finds poses by COLMAP"
    )
    kept, remark = complete_shots(archive, shots, len(poses), advice, images=False)
    return posed_images(
        archive,
        kept,
        depth=lambda shot: confident_depth(archive, shot, _BEST),
        rgb=lambda shot: video.frame(int(shot.image[-6:])),
        up=UP_Y,
        remark=remark,
    )


def _shot(archive: Archive, video: Video, row: np.ndarray, params: np.ndarray) -> Shot:
    """Makes one frame of a row [8] of the table and its intrinsics [4]."""
    number = int(row[0])
    if number != row[0] or number < 0:
        raise ForeignFileError(f"{row[0]:g} is no number of a frame")
    source = archive.where("odometry.csv")
    return Shot(
        image=f"{_VIDEO}/{number:06d}",
        depth=f"depth/{number:06d}.png",
        confidence=f"confidence/{number:06d}.png",
        lens=Lens("PINHOLE", *video.size, tuple(float(value) for value in params)),
        pose=quaternion_pose(source, f"the pose of frame {number}", row[1:4], row[4:8]),
    )


def _video(archive: Archive) -> Video:
    """Opens the video, from the disk if it lies there."""
    name = archive.where(_VIDEO)
    if archive.zipped is not None:
        return Video(name, archive.read(_VIDEO, _MAX_VIDEO))
    with naming(name):
        check_regular(name)
    return Video(name, name)


def _table(archive: Archive) -> tuple[np.ndarray, np.ndarray]:
    """Reads odometry.csv: frame and pose [n, 8], and intrinsics [n, 4]; unknown values are NaN.

    Raises:
        ForeignFileError: no such columns, no rows, or a field that is no number.
    """
    lines = plain_text(archive.read("odometry.csv")).decode(errors="replace").splitlines()
    rows = [[word.strip() for word in line.split(",")] for line in lines if line.strip()]
    names = rows[0] if rows else []
    missing = [name for name in _POSE if name not in names]
    if missing:
        raise ForeignFileError(f"there are no columns {', '.join(missing)}")
    if not rows[1:]:
        raise ForeignFileError("it lists no frames")
    at = [names.index(name) if name in names else -1 for name in (*_POSE, *_INTRINSICS)]
    table = np.full((len(rows) - 1, len(at)), np.nan)
    for number, row in enumerate(rows[1:]):
        if len(row) != len(names):
            raise ForeignFileError(f"row {number + 1} has {len(row)} fields, not {len(names)}")
        table[number] = [_number(row[i], f"row {number + 1}: `{names[i]}`") if i >= 0 else np.nan
                         for i in at]  # fmt: skip
    return table[:, : len(_POSE)], table[:, len(_POSE) :]


def _number(word: str, which: str) -> float:
    """Reads a field; NaN where it is empty."""
    try:
        value = float(word) if word else 0.0
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ForeignFileError(f"{which} must be a number, got {word[:40]!r}")
    return value if word else math.nan


def _camera_matrix(archive: Archive) -> np.ndarray:
    """Reads fx, fy, cx, cy of all frames, [4]."""
    name = "camera_matrix.csv"
    K = read_matrix(archive.where(name), 3, 3, archive.read(name).replace(b",", b" "))
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
