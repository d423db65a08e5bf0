"""Reads a scene of ScanNet (Dai et al. 2017) as its own reader exports it.

    color/0.jpg                        8-bit RGB
    depth/0.png                        uint16, millimeters, of fewer pixels
    pose/0.txt                         a 4x4 camera-to-world matrix, OpenCV axes, world z up [m];
                                       inf where tracking was lost: these frames are left out
    intrinsic/intrinsic_color.txt      4x4 or 3x3 intrinsics, pixel centers at whole numbers
    intrinsic/intrinsic_depth.txt      the same of the depth images

Both cameras count as one place: ScanNet's own depth is registered to its colors.
(https://github.com/ScanNet/ScanNet)
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import IMAGE_FORMATS, PosedImages
from r3jax.formats.poses import mend_pose, read_lines, to_floats
from r3jax.validation.images import first_size

UP = np.array([0.0, 0.0, 1.0])


def is_scannet(path: Path) -> bool:
    """True if the folder looks like an exported scene."""
    return all((path / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))


def read_scannet(path: Path | str) -> PosedImages:
    """Opens an exported scene and checks everything but the pixels.

    Args:
        path: the folder of the scene.

    Raises:
        FormatError: no frame with a pose, a pose or intrinsics that are missing, damaged, or not
            rigid. Images that are missing are noticed when they are read.
    """
    path = Path(path)
    images = sorted((path / "color").glob("*.[jp][pn]g"), key=_number)
    if not images:
        raise FormatError(path / "color", "the folder holds no image (*.jpg, *.png)")
    poses = [read_pose(path / "pose" / f"{image.stem}.txt") for image in images]
    found = [(image, pose) for image, pose in zip(images, poses, strict=True) if pose is not None]
    if not found:
        raise FormatError(path / "pose", "no frame has a pose that is finite")
    used = [image for image, _ in found]
    depths = [path / "depth" / f"{image.stem}.png" for image in used]
    count = len(found)
    return PosedImages(
        path=path,
        image_paths=tuple(used),
        lenses=(_lens(path / "intrinsic" / "intrinsic_color.txt", used),) * count,
        poses=np.stack([pose for _, pose in found]),
        depth_paths=tuple(depths),
        depth_lenses=(_lens(path / "intrinsic" / "intrinsic_depth.txt", depths),) * count,
        up=UP,
        remark=lost(len(images) - count, len(images)),
    )


def lost(count: int, total: int) -> str | None:
    """Says how many frames have no pose."""
    return f"{count} of {total} frames have no pose and are left out." if count else None


def read_pose(source: Path) -> np.ndarray | None:
    """A camera-to-world matrix [4, 4]; None where tracking was lost."""
    pose = _matrix(source)
    if pose.shape != (4, 4):
        raise FormatError(source, f"expected a 4x4 matrix, got {len(pose)} lines")
    return mend_pose(source, "the pose", pose) if np.all(np.isfinite(pose)) else None


def scannet_lens(width: int, height: int, K: np.ndarray) -> Lens:
    """A pinhole of intrinsics [3, 3] or [4, 4]."""
    values = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    return Lens("PINHOLE", width, height, tuple(float(value) for value in values))


def _lens(source: Path, images: Sequence[Path]) -> Lens:
    K = _matrix(source)
    if len(K) < 3:
        raise FormatError(source, f"expected a 4x4 matrix, got {len(K)} lines")
    with naming(images[0]):
        width, height = first_size(images, IMAGE_FORMATS)
    with naming(source):
        return scannet_lens(width, height, K)


def _matrix(source: Path) -> np.ndarray:
    """A table of 3 or 4 columns."""
    rows = list(read_lines(source))
    columns = 3 if rows and len(rows[0][1]) == 3 else 4
    return np.array([to_floats(source, number, words, columns) for number, words in rows])


def _number(path: Path) -> tuple[int, str]:
    """Order by the number in a name: 10 comes after 9."""
    is_number = path.stem.isascii() and path.stem.isdigit() and len(path.stem) < 19
    return (int(path.stem) if is_number else 1 << 62), path.name
