"""Reads a capture of LLFF (Mildenhall et al. 2019), whose poses NeRF and its successors take.

    poses_bounds.npy    [n, 17]: a 3x5 matrix and two depths for each image
    images/             the images, of which there are as many, in the order of their names
    images_4/, ...      smaller copies

The matrix is camera to world, with the axes down, right, backward, the position, and height, width
and focal length in pixels of the images that COLMAP had. The lens has no distortion, and its
principal point is the middle. The depths, between which the points lie, are not used.
(https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap)
"""

from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import FOLDERS, PosedImages, find_mask
from r3jax.formats.poses import mend_pose
from r3jax.validation.arrays import read_npy
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes

_NAME = "poses_bounds.npy"
_SUFFIXES = (".jpg", ".jpeg", ".png")
_MAX_BYTES = 64 << 20


def is_llff(path: Path) -> bool:
    """Returns True if the folder looks like a capture of LLFF."""
    return (path / _NAME).is_file()


def read_llff(path: Path | str) -> PosedImages:
    """Opens a capture and checks everything but the pixels.

    Args:
        path: the folder that holds poses_bounds.npy.

    Raises:
        FormatError: an array of another shape, a pose that is not rigid, a size or focal length
            that is not positive; or no folder with as many images as there are poses.
    """
    path = Path(path)
    source = path / _NAME
    with naming(source):
        table = read_npy(read_bytes(source, _MAX_BYTES)).astype(np.float64)
        if table.ndim != 2 or table.shape[1] != 17 or not len(table):
            raise ForeignFileError(f"poses must be an array of n x 17, got {table.shape}")
        if not np.isfinite(table).all():
            raise ForeignFileError("a number is not finite")
        rows = table[:, :15].reshape(-1, 3, 5)
        lenses = tuple(_lens(*row[:, 4].tolist()) for row in rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.stack([rows[..., 1], rows[..., 0], -rows[..., 2], rows[..., 3]], axis=-1)
    images = _images(path, len(rows))
    masks = [find_mask(path, image.name) for image in images]
    return PosedImages(
        path=path,
        image_paths=tuple(images),
        lenses=lenses,
        poses=np.stack([mend_pose(source, f"pose {i}", pose) for i, pose in enumerate(poses)]),
        depth_paths=(None,) * len(rows),
        mask_paths=tuple(masks) if any(masks) else None,
    )


def _lens(height: float, width: float, focal: float) -> Lens:
    return Lens("PINHOLE", round(width), round(height), (focal, focal, width / 2, height / 2))


def _images(path: Path, count: int) -> list[Path]:
    """Lists the images of the first folder that has as many as there are poses."""
    there: list[str] = []
    for folder in (path / name for name in FOLDERS):
        if not folder.is_dir():
            continue
        found = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)
        if len(found) == count:
            return found
        there += [f"{folder} has {len(found)}"] if found else []
    raise FormatError(
        path / _NAME,
        f"it has {count} poses, but {', '.join(there) or 'there are no images beside it'}: poses "
        "are in the order of the images' names, so remove those that COLMAP found no pose for",
    )
