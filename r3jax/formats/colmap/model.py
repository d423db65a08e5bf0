"""COLMAP's sparse models, and the conversion of their poses.

COLMAP's poses take points from the world to the camera, as a unit quaternion (Hamilton's, w first)
and a translation; its camera axes are OpenCV's: x right, y down, z forward
(https://colmap.github.io/format.html).

Shape symbols: k keypoints of an image; m points; t track elements.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from r3jax.formats.lenses import Lens
from r3jax.formats.poses import MAX_DISTANCE, quaternion_of, rotation_of
from r3jax.validation.errors import ForeignFileError

NO_POINT = -1
"""Id of a keypoint without a point."""


@dataclass(frozen=True)
class ColmapImage:
    """One registered image."""

    id: int
    name: str
    """Path relative to the folder of the images."""

    camera_id: int
    quaternion: np.ndarray
    """World to camera, w x y z, [4] float64."""

    translation: np.ndarray
    """World to camera, [3] float64."""

    keypoints: np.ndarray
    """Positions of features, column and row [px], [k, 2] float64."""

    point_ids: np.ndarray
    """Id of each keypoint's point, or `NO_POINT`, [k] int64."""


@dataclass(frozen=True)
class ColmapPoints:
    """The points and their tracks."""

    ids: np.ndarray
    """[m] int64."""

    xyz: np.ndarray
    """[m, 3] float64."""

    rgb: np.ndarray
    """[m, 3] uint8."""

    error: np.ndarray
    """Mean reprojection error [px], negative if not computed, [m] float64."""

    track_lengths: np.ndarray
    """Number of track elements of each point, [m] int64; they sum to t."""

    track_images: np.ndarray
    """Ids of the images in the tracks, one track after the other, [t] int64."""

    track_keypoints: np.ndarray
    """Indices of the keypoints in those images, [t] int64."""

    def __len__(self) -> int:
        """Returns the number of points."""
        return len(self.ids)


@dataclass(frozen=True)
class ColmapModel:
    """Cameras, images and points that belong together."""

    cameras: Mapping[int, Lens]
    """Cameras by their ids."""

    images: tuple[ColmapImage, ...]
    points: ColmapPoints


def points_without_tracks(xyz: np.ndarray, rgb: np.ndarray) -> ColmapPoints:
    """Makes points whose images are not known, numbered from 1.

    Args:
        xyz: [m, 3].
        rgb: [m, 3] uint8.
    """
    none = np.zeros(0, np.int64)
    return ColmapPoints(
        ids=np.arange(1, len(xyz) + 1, dtype=np.int64),
        xyz=xyz.astype(np.float64),
        rgb=rgb,
        error=np.full(len(xyz), -1.0),
        track_lengths=np.zeros(len(xyz), np.int64),
        track_images=none,
        track_keypoints=none,
    )


def pose_of(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Converts COLMAP's world-to-camera pose to `T_world_camera` [4, 4] float64.

    Raises:
        ForeignFileError: see `rotation_of`; a translation that is not finite, or too far away.
    """
    if not np.all(np.abs(translation) < MAX_DISTANCE):  # NaN makes the comparison false
        raise ForeignFileError(f"the translation {translation.tolist()} is not finite or too large")
    R = rotation_of(quaternion)
    pose = np.eye(4)
    pose[:3, :3] = R.T
    pose[:3, 3] = -R.T @ translation
    return pose


def colmap_pose(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Converts a pose [4, 4] to COLMAP's quaternion [4] and translation [3].

    This is the inverse of `pose_of`.
    """
    quaternion = quaternion_of(T_world_camera[:3, :3].T)
    return quaternion, -rotation_of(quaternion) @ T_world_camera[:3, 3].astype(np.float64)
