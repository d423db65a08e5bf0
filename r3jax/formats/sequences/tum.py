"""Reads a sequence of the TUM RGB-D benchmark (Sturm et al. 2012), or one recorded like it.

    rgb.txt, depth.txt    lines "timestamp path", the path relative to the folder
    groundtruth.txt       lines "timestamp tx ty tz qx qy qz qw", camera to world, OpenCV axes
    K.txt                 3x3 intrinsics; without it the benchmark's own defaults

Depth images are uint16 in steps of 0.2 mm, registered to the color images; 0 is no measurement.
The three lists have clocks of their own: every color image takes the depth image and the pose
that are nearest in time, and is left out where one of them is more than 0.02 s away. The
benchmark recommends its default intrinsics, without undistortion. Its world has z up, by motion
capture; a trajectory that begins at the identity is another program's, whose world is the first
camera's.
(https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats)
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r3jax.formats.depth import DepthUnit
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, matrix_lens
from r3jax.formats.posed_images import IMAGE_FORMATS, PosedImages
from r3jax.formats.poses import (
    nearest,
    quaternion_pose,
    read_lines,
    read_matrix,
    read_numbers,
    to_floats,
    up_of_poses,
)
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import below
from r3jax.validation.images import first_size

_MAX_GAP = 0.02
"""Images and poses farther apart than this do not belong together [s]."""

_UNIT = DepthUnit(1.0 / 5000.0)
_SIZE = (640, 480)
_DEFAULT = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
"""Intrinsics of the benchmark's sensors [px]; pixel centers lie at whole numbers."""
_ASSUMED = (
    "There is no K.txt, so the intrinsics are the benchmark's defaults (fx = fy = 525, cx = 319.5, "
    "cy = 239.5 pixels): write those of another camera into one, a 3x3 matrix."
)


def is_tum(path: Path) -> bool:
    """Returns True if the folder looks like a sequence of the benchmark."""
    return all((path / name).exists() for name in ("rgb.txt", "depth.txt", "groundtruth.txt"))


def read_tum(path: Path | str) -> PosedImages:
    """Opens a sequence and checks everything but the pixels.

    Args:
        path: the folder.

    Raises:
        FormatError: files that are missing or damaged, paths that lead out of the folder, no image
            with depth and pose, intrinsics that make no sense, poses that are not finite.
    """
    path = Path(path)
    (image_times, images), (depth_times, depths) = (
        _pictures(path, name) for name in ("rgb.txt", "depth.txt")
    )
    source = path / "groundtruth.txt"
    table = read_numbers(source, columns=8)
    if not np.all(np.isfinite(table)):
        raise FormatError(source, "there are numbers that are not finite")
    depth_at = nearest(image_times, depth_times, _MAX_GAP)
    pose_at = nearest(image_times, table[:, 0], _MAX_GAP)
    chosen = np.flatnonzero((depth_at >= 0) & (pose_at >= 0))
    if not len(chosen):
        raise FormatError(
            path, f"no image has a depth image and a pose within {_MAX_GAP:g} s of it"
        )
    poses = np.stack([_pose(source, table[pose_at[i]]) for i in chosen])
    lens = _lens(path, [images[i] for i in chosen])
    return PosedImages(
        path=path,
        image_paths=tuple(images[i] for i in chosen),
        lenses=(lens,) * len(chosen),
        poses=poses,
        depth_paths=tuple(depths[depth_at[i]] for i in chosen),
        depth_unit=_UNIT,
        up=up_of_poses(poses),
        remark=None if (path / "K.txt").exists() else _ASSUMED,
    )


def _pictures(folder: Path, name: str) -> tuple[np.ndarray, list[Path]]:
    """Reads times [n] and paths of a list of images."""
    source = folder / name
    times: list[float] = []
    paths: list[Path] = []
    for number, words in read_lines(source):
        if len(words) != 2:
            raise FormatError(source, f"line {number} is not a timestamp and a path")
        times += to_floats(source, number, words[:1], 1)
        try:
            paths.append(below(folder, words[1]))
        except ForeignFileError as error:
            raise FormatError(source, f"line {number}: {error}") from None
    if not paths:
        raise FormatError(source, "the file lists no pictures")
    if not np.all(np.isfinite(times)):
        raise FormatError(source, "there are timestamps that are not finite")
    return np.asarray(times), paths


def _pose(source: Path, row: np.ndarray) -> np.ndarray:
    """Converts a line (time, translation, quaternion x y z w) to `T_world_camera`."""
    return quaternion_pose(source, f"the pose at {row[0]:.4f} s", row[1:4], row[4:])


def _lens(path: Path, images: Sequence[Path]) -> Lens:
    with naming(images[0]):
        width, height = first_size(images, IMAGE_FORMATS)
    source = path / "K.txt"
    if not source.exists() and (width, height) != _SIZE:
        raise FormatError(
            source,
            f"the file is missing, and the images are {width}x{height}, not the benchmark's "
            f"{_SIZE[0]}x{_SIZE[1]}: give their 3x3 intrinsics in it",
        )
    K = read_matrix(source, 3, 3) if source.exists() else _DEFAULT
    with naming(source):
        return matrix_lens(K, (width, height))
