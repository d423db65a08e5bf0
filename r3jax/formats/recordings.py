"""Reads an RGB-D recording: a folder of images, depth images and poses.

    images/*.png     8-bit RGB (or anything Pillow turns into RGB)
    depth/*.png      uint16, millimeters, 0 = no measurement
    K.txt            3x3 intrinsics, OpenCV's convention: pixel centers at whole numbers
    poses.txt        one camera-to-world matrix per line, 16 numbers row by row, OpenCV axes

Images, depth images and poses belong together in the order of the sorted file names.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, matrix_lens
from r3jax.formats.posed_images import IMAGE_FORMATS, PosedImages, pair_images
from r3jax.formats.poses import read_matrix, read_poses
from r3jax.validation.images import first_size

Up = Literal["y", "z"]

_Z_UP_FROM_Y_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""(x, y, z) becomes (x, -z, y): right-handed stays right-handed."""


def is_recording(path: Path) -> bool:
    """Returns True if the folder looks like a recording."""
    return (path / "poses.txt").exists() and (path / "images").is_dir()


def read_recording(path: Path | str, up: Up = "y") -> PosedImages:
    """Opens a recording and checks everything but the pixels.

    Args:
        path: the folder.
        up: axis of the recording's world that points up; the poses are turned to z up.

    Raises:
        FormatError: files that are missing, numbers of images, depth images and poses that
            differ, intrinsics that make no sense, poses that are not finite or not rigid.
    """
    path = Path(path)
    if not path.is_dir():
        raise FormatError(path, "there is no such folder")
    found, measured = (_list_images(path / name) for name in ("images", "depth"))
    poses = read_poses(path / "poses.txt")
    image_paths, depth_paths = pair_images(path, found, measured, len(poses))
    return PosedImages(
        path=path,
        image_paths=image_paths,
        lenses=(_lens(path / "K.txt", image_paths),) * len(poses),
        poses=_Z_UP_FROM_Y_UP @ poses if up == "y" else poses,
        depth_paths=depth_paths,
    )


def _list_images(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        raise FormatError(folder, "the folder is missing")
    found = {p.stem: p for p in folder.iterdir() if p.suffix.lower() in (".png", ".jpg")}
    if not found:
        raise FormatError(folder, "the folder holds no image (*.png, *.jpg)")
    return found


def _lens(source: Path, images: Sequence[Path]) -> Lens:
    """Reads the intrinsics from K.txt, and the size from the first image that can be opened."""
    K = read_matrix(source, 3, 3)
    with naming(images[0]):
        width, height = first_size(images, IMAGE_FORMATS)
    cx, cy = K[0, 2], K[1, 2]
    if not (0.0 <= cx < width and 0.0 <= cy < height):
        raise FormatError(
            source,
            f"the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} images: "
            "is K for another resolution?",
        )
    with naming(source):
        return matrix_lens(K, (width, height))
