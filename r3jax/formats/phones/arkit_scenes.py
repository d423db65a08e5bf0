"""Reads a video of Apple's data set ARKitScenes, at its low resolution.

    lowres_wide/<video>_<time>.png                 8-bit RGB, 256 x 192
    lowres_depth/<video>_<time>.png                uint16, millimeters
    confidence/<video>_<time>.png                  2 is the best
    lowres_wide_intrinsics/<video>_<time>.pincam   "width height fx fy cx cy"
    lowres_wide.traj                               "time, axis-angle (3), translation (3)": world to
                                                   camera, OpenCV axes, world z up [m, rad]

The clocks differ by a millisecond; images without a pose within 5 ms are left out.
(https://github.com/apple/ARKitScenes/blob/main/DATA.md)
"""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

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
from r3jax.formats.poses import UP_Z, mend_pose, nearest, read_numbers
from r3jax.validation.errors import ForeignFileError

_BEST = 2
_TRAJECTORY, _CAMERAS = "lowres_wide.traj", "lowres_wide_intrinsics"
_MAX_GAP = 0.005
"""Poses farther from an image do not belong to it [s]."""

_MILLISECONDS = (0.0, -0.001, 0.001)
"""What the names of cameras differ from those of images [s]."""


def is_arkit_scenes(path: Path) -> bool:
    """Returns True if the folder or archive looks like a video of ARKitScenes."""
    return is_there(path, _TRAJECTORY)


def read_arkit_scenes(path: Path | str) -> PosedImages:
    """Opens a video and checks everything but the pixels.

    Args:
        path: the folder of the video, such as `raw/Training/40753679`.

    Raises:
        FormatError: files that are missing or damaged; no image with a pose, a camera and depth.
    """
    path = Path(path)
    archive = find_archive(path, _TRAJECTORY)
    if archive is None:
        raise FormatError(path, f"there is no {_TRAJECTORY} in it")
    source = archive.where(_TRAJECTORY)
    with naming(source):
        times, poses = _trajectory(archive)
    names = archive.names("lowres_wide", ".png")
    cameras = set(archive.names(_CAMERAS, ".pincam"))
    taken = np.array([_time(name) for name in names])
    chosen = nearest(taken, times, _MAX_GAP) if names else []
    shots: list[Shot] = []
    for name, at in zip(names, chosen, strict=True):
        camera = _camera_name(name, cameras)
        if at >= 0 and camera is not None:
            pose = mend_pose(source, f"the pose at {times[at]:.3f} s", poses[at])
            shots.append(_shot(archive, name, camera, pose))
    advice = (
        "this looks like a video of ARKitScenes without images that have a depth image, a pose "
        "and a camera: download its assets lowres_wide, lowres_depth, confidence, "
        "lowres_wide_intrinsics and lowres_wide.traj"
    )
    kept, remark = complete_shots(archive, shots, len(names), advice)
    read = partial(confident_depth, archive, best=_BEST)
    return posed_images(archive, kept, depth=read, up=UP_Z, remark=remark)


def _shot(archive: Archive, name: str, camera: str, pose: np.ndarray) -> Shot:
    source = f"{_CAMERAS}/{camera}.pincam"
    with naming(archive.where(source)):
        numbers = read_numbers(archive.where(source), 6, archive.read(source))[0]
        width, height = (int(value) if abs(value) < 1e6 else 0 for value in numbers[:2])
        lens = Lens("PINHOLE", width, height, tuple(float(value) for value in numbers[2:]))
    files = (f"{folder}/{name}.png" for folder in ("lowres_wide", "lowres_depth", "confidence"))
    return Shot(*files, lens=lens, pose=pose)


def _trajectory(archive: Archive) -> tuple[np.ndarray, np.ndarray]:
    """Reads times [n] and poses `T_world_camera` [n, 4, 4]."""
    table = read_numbers(archive.where(_TRAJECTORY), 7, archive.read(_TRAJECTORY))
    if not np.all(np.isfinite(table)) or np.abs(table).max() > 1e12:
        raise ForeignFileError("there are numbers that are not finite or far too large")
    turns = Rotation.from_rotvec(-table[:, 1:4])
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns.as_matrix(), -turns.apply(table[:, 4:7])
    return table[:, 0], poses


def _time(name: str) -> float:
    """Reads the seconds in a name such as 40753679_6791.528; NaN if it has none."""
    try:
        return float(name.rpartition("_")[2])
    except ValueError:
        return float("nan")


def _camera_name(name: str, cameras: set[str]) -> str | None:
    """Finds the camera of an image, whose time may be a millisecond off."""
    video, _, _ = name.rpartition("_")
    candidates = [f"{video}_{_time(name) + off:.3f}" for off in _MILLISECONDS]
    return next((one for one in (name, *candidates) if one in cameras), None)
