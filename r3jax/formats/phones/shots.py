"""From the frames that an app lists to posed images: what every phone reader ends with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r3jax.formats.depth_images import keep_confident
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.phones.archives import Archive
from r3jax.formats.posed_images import DepthUnit, Pixels, PosedImages

UP_Y, UP_Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
"""ARKit's worlds have y up; some data sets turned them."""

MILLIMETERS = DepthUnit(0.001)


@dataclass(frozen=True)
class Shot:
    """One frame: names of its files in the archive, and what was read of it."""

    image: str
    depth: str
    confidence: str
    """Need not exist: then all depth counts."""

    lens: Lens
    """Lens of the color image."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4]: OpenCV axes."""


def complete_shots(
    archive: Archive, shots: Sequence[Shot], total: int, advice: str, *, images: bool = True
) -> tuple[list[Shot], str | None]:
    """Leaves out the frames that lack their depth image or image.

    Args:
        archive: that holds them.
        shots: those that have a pose and a camera.
        total: how many frames the app lists.
        advice: what to do where no frame is left, a part of a sentence.
        images: False where the images are no files of the archive.

    Returns:
        The others, and a remark on how many are left out.

    Raises:
        FormatError: none is left.
    """
    kept = [
        shot
        for shot in shots
        if archive.has(shot.depth) and (not images or archive.has(shot.image))
    ]
    if not kept:
        raise FormatError(archive.path, advice)
    gone = total - len(kept)
    if not gone:
        return kept, None
    return kept, f"{gone} of {total} frames lack an image, depth or a pose and are left out."


def confident_depth(archive: Archive, shot: Shot, best: int) -> np.ndarray:
    """Reads a depth image in millimeters, [h, w] float32 [m], where the sensor was sure.

    Raises:
        FormatError: a file is missing or damaged, or the sizes differ.
    """
    depth = MILLIMETERS.depth(archive.depth_steps(shot.depth))
    if not archive.has(shot.confidence):
        return depth
    levels = archive.confidence(shot.confidence)
    with naming(archive.where(shot.confidence)):
        return keep_confident(depth, levels, best)


def posed_images(
    archive: Archive,
    shots: Sequence[Shot],
    *,
    depth: Callable[[Shot], np.ndarray],
    rgb: Callable[[Shot], np.ndarray] | None = None,
    up: np.ndarray | None,
    remark: str | None,
    path: Path | None = None,
) -> PosedImages:
    """Joins frames to posed images.

    Args:
        archive: that holds their files.
        shots: at least one.
        depth: reads the depth of a frame, [h, w] float32.
        rgb: reads the colors of a frame, [H, W, 3] uint8; None: from its image in the archive.
        up: the vertical of their world, [3]; None: not known.
        remark: what is left out.
        path: what the capture is called in messages; None: as the archive.
    """
    chosen = list(shots)

    def from_archive(shot: Shot) -> np.ndarray:
        return archive.rgb(shot.image, (shot.lens.width, shot.lens.height))

    read = rgb or from_archive
    return PosedImages(
        path=path or archive.path,
        image_paths=tuple(archive.where(shot.image) for shot in chosen),
        lenses=tuple(shot.lens for shot in chosen),
        poses=np.stack([shot.pose for shot in chosen]),
        depth_paths=tuple(archive.where(shot.depth) for shot in chosen),
        pixels=Pixels(lambda index: read(chosen[index]), lambda index: depth(chosen[index])),
        up=up,
        remark=remark,
    )
