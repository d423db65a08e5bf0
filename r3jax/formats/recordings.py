"""Reads an RGB-D recording: a folder of images, depth images and poses.

    images/*.png     8-bit RGB (or anything Pillow turns into RGB)
    depth/*.png      uint16, millimeters, 0 = no measurement
    K.txt            3x3 intrinsics, OpenCV's convention: pixel centers at whole numbers
    poses.txt        one camera-to-world matrix per line, 16 numbers row by row, OpenCV axes

Images, depth images and poses belong together in the order of the sorted file names.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.poses import mend_pose, read_numbers
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.validation.images import first_size, image_pixels, masked_pixels

Up = Literal["y", "z"]

_FORMATS = ("PNG", "JPEG")
_DEPTH_MODES = ("I;16", "I;16B", "I")

_Z_UP_FROM_Y_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""(x, y, z) becomes (x, -z, y): right-handed stays right-handed."""


@dataclass(frozen=True)
class Recording:
    """A recording whose poses have been checked; images are read when asked for."""

    path: Path
    camera: Camera
    image_paths: tuple[Path, ...]
    depth_paths: tuple[Path, ...]

    poses: np.ndarray
    """`T_world_camera`, [n, 4, 4] float64: OpenCV axes, world z up [m]."""

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.image_paths)

    def frame(self, index: int) -> Frame:
        """One frame.

        Raises:
            FormatError: an image that is missing, broken, or of another size or kind.
        """
        size = (self.camera.width, self.camera.height)
        path, depth_path = self.image_paths[index], self.depth_paths[index]
        with naming(path):
            rgb, is_there = masked_pixels(path, _FORMATS, size)
        with naming(depth_path):
            depth = image_pixels(depth_path, _FORMATS, size, _DEPTH_MODES, "depth must be 16-bit")
        if is_there is not None:
            depth = np.where(is_there, depth, 0)
        try:
            return Frame(
                rgb=jnp.asarray(rgb.astype(np.float32) / np.float32(255.0)),
                depth=jnp.asarray(depth.astype(np.float32) / np.float32(1000.0)),
                T_world_camera=jnp.asarray(self.poses[index], dtype=jnp.float32),
                camera=self.camera,
            )
        except ValueError as error:
            raise FormatError(path, str(error)) from None

    def frames(self) -> Iterator[Frame]:
        """Every frame in order, read one by one."""
        return (self.frame(index) for index in range(len(self)))


def is_recording(path: Path) -> bool:
    """True if the folder looks like a recording."""
    return (path / "poses.txt").exists() and (path / "images").is_dir()


def read_recording(path: Path | str, up: Up = "y") -> Recording:
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
    poses = read_numbers(path / "poses.txt", columns=16).reshape(-1, 4, 4)
    image_paths, depth_paths = pair_images(path, found, measured, len(poses))
    source = path / "poses.txt"
    poses = np.stack(
        [mend_pose(source, f"pose {i} (line {i + 1})", pose) for i, pose in enumerate(poses)]
    )
    if up == "y":
        poses = _Z_UP_FROM_Y_UP @ poses
    camera = _read_camera(path / "K.txt", image_paths)
    return Recording(path, camera, image_paths, depth_paths, poses)


def pair_images(
    path: Path, images: Mapping[str, Path], depths: Mapping[str, Path], num_poses: int
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Pairs images with depth images by the names of their frames, which are in order.

    Of a frame whose image was deleted the depth image says that there was one, and the other way
    round: the pose is still known, and what is missing is noticed when it is read.

    Args:
        path: the capture, for messages.
        images: images by the names of their frames.
        depths: depth images by the names of their frames.
        num_poses: frames that have a pose.

    Raises:
        FormatError: there are more or fewer frames than poses.
    """
    names = sorted({*images, *depths})
    if len(names) != num_poses:
        counts = f"{len(images)} images, {len(depths)} depth images, {num_poses} poses"
        odd = next((name for name in images if name not in depths), None)
        beside = "" if odd is None else f", and no depth image of {images[odd].name}"
        raise FormatError(path, f"the numbers must be equal, found {counts}{beside}")

    def in_order(files: Mapping[str, Path]) -> tuple[Path, ...]:
        known, like = next(iter(files.items()))
        gone = lambda name: like.with_name(like.name.replace(known, name))
        return tuple(files.get(name) or gone(name) for name in names)

    return in_order(images), in_order(depths)


def _list_images(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        raise FormatError(folder, "the folder is missing")
    found = {p.stem: p for p in folder.iterdir() if p.suffix.lower() in (".png", ".jpg")}
    if not found:
        raise FormatError(folder, "the folder holds no image (*.png, *.jpg)")
    return found


def _read_camera(path: Path, images: Sequence[Path]) -> Camera:
    """Intrinsics from K.txt, the size from the first image that can be opened."""
    K = read_numbers(path, columns=3)
    if K.shape != (3, 3) or not np.all(np.isfinite(K)):
        raise FormatError(path, "expected a finite 3x3 matrix")
    with naming(images[0]):
        width, height = first_size(images, _FORMATS)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if not (fx > 0.0 and fy > 0.0):
        raise FormatError(path, f"focal lengths must be positive, got {fx:g} and {fy:g}")
    if not (0.0 <= cx < width and 0.0 <= cy < height):
        raise FormatError(
            path,
            f"the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} images: "
            "is K for another resolution?",
        )
    return Camera(width, height, float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5)
