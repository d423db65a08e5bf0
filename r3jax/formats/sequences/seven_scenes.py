"""Reads a sequence of the 7-Scenes data set (Shotton et al. 2013).

    frame-000000.color.png    8-bit RGB, 640x480; or .jpg, .JPEG, ..., as some hand it on
    frame-000000.depth.png    uint16, millimeters; 0 and 65535 are no measurement
    frame-000000.pose.txt     a 4x4 camera-to-world matrix, OpenCV axes
    camera-intrinsics.txt     3x3 intrinsics, here or one folder above, as 3DMatch adds them

The data set names one camera for both images: focal length 585 px, principal point (320, 240).
Its depth images are not registered to the color images, which are off by some pixels.
(https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/)
"""

from pathlib import Path

import numpy as np

from r3jax.formats.depth import DepthUnit
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, matrix_lens
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.poses import mend_pose, read_matrix

_LENS = Lens("PINHOLE", 640, 480, (585.0, 585.0, 320.0, 240.0))
_UNIT = DepthUnit(0.001, invalid=65535)
_DEPTH = ".depth.png"
_SUFFIXES = (".jpeg", ".jpg", ".png")
"""Endings of images, in any case; where a frame has several, the last is the original."""


def is_seven_scenes(path: Path) -> bool:
    """Returns True if the folder looks like a sequence of the data set."""
    return path.is_dir() and bool(_colors(path))


def _colors(path: Path) -> dict[str, Path]:
    """Finds the color images by the names of their frames."""
    found = [p for p in path.glob("frame-*.color.*") if p.suffix.lower() in _SUFFIXES]
    found.sort(key=lambda image: _SUFFIXES.index(image.suffix.lower()))
    return {image.name.removesuffix(f".color{image.suffix}"): image for image in found}


def read_seven_scenes(path: Path | str) -> PosedImages:
    """Opens a sequence and checks everything but the pixels.

    Args:
        path: the folder of the sequence, such as `chess/seq-01`.

    Raises:
        FormatError: no frames, a pose that is missing, not 4x4, not finite or not rigid. Images
            that are missing are noticed when they are read.
    """
    path = Path(path)
    found = _colors(path)
    if not found:
        raise FormatError(path, "the folder contains no frame-*.color.png or .jpg")
    depths = {depth.name.removesuffix(_DEPTH) for depth in path.glob(f"frame-*{_DEPTH}")}
    bases = sorted(depths.union(found))
    return PosedImages(
        path=path,
        image_paths=tuple(found.get(base, path / f"{base}.color.png") for base in bases),
        lenses=(_lens(path),) * len(bases),
        poses=np.stack([_pose(path / f"{base}.pose.txt") for base in bases]),
        depth_paths=tuple(path / f"{base}{_DEPTH}" for base in bases),
        depth_unit=_UNIT,
    )


def _lens(path: Path) -> Lens:
    """Returns the data set's own camera, unless a file of intrinsics names another one."""
    folders = (path, path.resolve().parent)
    found = (folder / "camera-intrinsics.txt" for folder in folders)
    source = next((file for file in found if file.exists()), None)
    if source is None:
        return _LENS
    K = read_matrix(source, 3, 3)
    with naming(source):
        return matrix_lens(K, (_LENS.width, _LENS.height), offset=0.0)


def _pose(source: Path) -> np.ndarray:
    return mend_pose(source, "the pose", read_matrix(source, 4, 4))
