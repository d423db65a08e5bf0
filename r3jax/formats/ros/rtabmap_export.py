"""Reads what RTAB-Map exports: `rtabmap-export --images_id --poses_camera --poses_format 11 X.db`.

    X_camera_poses.txt    lines "stamp x y z qx qy qz qw id", camera to map, OpenCV axes, z up [m]
    X_rgb/<id>.jpg        8-bit RGB
    X_depth/<id>.png      uint16, millimeters, of the same or fewer pixels
    X_calib/<id>.yaml     camera as OpenCV writes it; pixel centers at whole numbers

Images are rectified: RTAB-Map takes the projection matrix, where there is one, and no distortion.
(https://github.com/introlab/rtabmap)
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.phones.archives import Archive
from r3jax.formats.phones.shots import UP_Z, Shot, complete_shots, confident_depth, posed_images
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.poses import read_numbers
from r3jax.formats.quaternion_poses import quaternion_pose
from r3jax.formats.ros.messages import rectified_lens
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import plain_text

COMMAND = "rtabmap-export --images_id --poses_camera --poses_format 11 {}"
"""What a user runs on a database."""

_POSES = "_camera_poses.txt"


def is_rtabmap_export(path: Path) -> bool:
    """True if the folder looks like an export of RTAB-Map."""
    return _name(path) is not None


def _name(path: Path) -> str | None:
    """What the names of all files begin with."""
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
    """One frame of a row [9]; None where it has no image or camera."""
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
    """The camera in a YAML of OpenCV, for an image of this width and height."""
    matrix = _matrix(text, "projection_matrix", 12)
    matrix = _matrix(text, "camera_matrix", 9) if matrix is None else matrix
    if matrix is None:
        raise ForeignFileError("there is no camera_matrix in it")
    return rectified_lens(matrix, size)


def _matrix(text: str, name: str, count: int) -> np.ndarray | None:
    """The numbers of a matrix; None where it is not there."""
    found = re.search(rf"{name}:[^\[\]]{{0,200}}data:\s*\[([^\[\]]{{0,2000}})\]", text)
    if found is None:
        return None
    try:
        numbers = np.array([float(word) for word in found[1].split(",")])
    except ValueError:
        raise ForeignFileError(f"{name} holds a word that is no number") from None
    if len(numbers) != count:
        raise ForeignFileError(f"{name} must have {count} numbers, got {len(numbers)}")
    return numbers
