"""The photos of a capture: those that may be chosen, and those held out for evaluation.

Shape symbols: n photos of the capture; K candidates.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from r3jax.errors import InputError
from r3jax.formats.captures import Capture, open_capture
from r3jax.formats.posed_images import PosedImages
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.runs.reader import Run
from r3jax.splatting.views import Views, load_views, split_views


class PhotosError(InputError):
    """A capture that the protocol cannot be run on, and why."""


@dataclass(frozen=True)
class PhotoPool:
    """Photos with poses and depth. A chooser gets the poses of those that it has not chosen."""

    name: str
    """Name of the capture."""

    capture: Capture

    views: Views
    """All photos as they are trained on and judged."""

    poses: np.ndarray
    """`T_world_camera` of all photos, [n, 4, 4] float64."""

    camera: Camera
    """Camera of the first photo at its full size: candidates are scored with it."""

    on_offer: np.ndarray
    """Numbers of the photos that may be chosen, ascending."""

    test: np.ndarray
    """Numbers of the photos that judge, ascending."""

    def frame(self, number: int) -> Frame:
        """Reads a photo at its full size, for the map."""
        source = self.capture.source
        return source.frame(source.rows[number].step if isinstance(source, Run) else number)


def open_pool(
    path: Path, resolution: int, *, hold_out: int = 8, up: Literal["y", "z"] = "y"
) -> PhotoPool:
    """Opens a capture as a pool of photos.

    Args:
        path: what `r3jax.formats.captures.open_capture` opens.
        resolution: longer side of the images that are trained on and judged [px].
        hold_out: every `hold_out`-th photo is held out for evaluation, beginning with the first.
        up: axis of a recording's world that points up.

    Raises:
        PhotosError: photos without depth, or too few of them.
        FormatError: it is no capture, or a broken one.
    """
    capture = open_capture(path, up)
    _check_depth(capture)
    frames = list(capture.frames())
    if not frames:
        raise PhotosError(f"{path} holds no photos")
    poses = np.stack([np.asarray(frame.T_world_camera, dtype=np.float64) for frame in frames])
    on_offer, test = split_views(len(frames), hold_out)
    views = load_views(frames, resolution)
    return PhotoPool(capture.name, capture, views, poses, frames[0].camera, on_offer, test)


def _check_depth(capture: Capture) -> None:
    """Refuses posed images of which some have no depth image."""
    source = capture.source
    if not isinstance(source, PosedImages):
        return
    missing = sum(path is None for path in source.depth_paths)
    if missing:
        raise PhotosError(
            f"{capture.path}: {missing} of {len(source)} photos have no depth image, of which the "
            "map is made that choosers look at. Add depth_file_path to the frames of "
            "transforms.json (rendered from a mesh, of a depth sensor or of multi-view stereo)"
        )


def first_photos(pool: PhotoPool, num: int, seed: int) -> list[int]:
    """Draws the photos that every choice begins with, the same for all choosers of a seed.

    Raises:
        PhotosError: fewer are on offer.
    """
    if num >= len(pool.on_offer):
        raise PhotosError(
            f"{pool.name} offers {len(pool.on_offer)} photos beside the {len(pool.test)} that "
            f"judge: too few to begin with {num} and choose more"
        )
    return np.random.default_rng(seed).choice(pool.on_offer, num, replace=False).tolist()


def nearest_photos(pool: PhotoPool, chosen: list[int], num: int) -> np.ndarray:
    """Lists the `num` photos on offer, not chosen yet, nearest to the last chosen one.

    Nearest by the distance between the cameras; of those at one place the one that is turned
    least, and then the first.
    """
    left = np.setdiff1d(pool.on_offer, chosen)
    here = pool.poses[chosen[-1]]
    distance = np.linalg.norm(pool.poses[left, :3, 3] - here[:3, 3], axis=1)
    alike = np.einsum("nij,ij->n", pool.poses[left, :3, :3], here[:3, :3])
    # Micrometers: what differs by less stands at one place, whatever float64 says.
    order = np.lexsort((left, -alike, np.round(distance, 6)))
    return left[order[:num]]
