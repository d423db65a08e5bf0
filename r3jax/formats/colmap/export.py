"""A run as a COLMAP model: in meters, in the run's own world, nothing turned or scaled."""

from collections.abc import Sequence

import numpy as np

from r3jax.formats.colmap.model import (
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    colmap_pose,
    points_without_tracks,
)
from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.trace.reader import Run


def posed_model(
    lens: Lens, names: Sequence[str], poses: np.ndarray, points: ColmapPoints
) -> ColmapModel:
    """A model of images from one camera, without keypoints; everything is numbered from 1.

    Args:
        lens: the camera of all images.
        names: n paths of the images, relative to the folder of the images.
        poses: `T_world_camera`, [n, 4, 4].
        points: the points.
    """
    images: list[ColmapImage] = []
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        quaternion, translation = colmap_pose(pose)
        none = np.zeros((0, 2))
        images.append(
            ColmapImage(number, name, 1, quaternion, translation, none, np.zeros(0, np.int64))
        )
    return ColmapModel({1: lens}, tuple(images), points)


def model_of(run: Run, xyz: np.ndarray, rgb: np.ndarray) -> ColmapModel:
    """The model of a run: its views, its one camera, and points that no view is known to see.

    Args:
        run: a run.
        xyz: points in the world, such as the map's voxels, [m, 3] [m].
        rgb: their colors, [m, 3] uint8.
    """
    names = [run.image_path(row.step).name for row in run.rows]
    poses = np.stack([row.pose for row in run.rows]).astype(np.float64)
    return posed_model(pinhole_lens(run.camera), names, poses, points_without_tracks(xyz, rgb))
