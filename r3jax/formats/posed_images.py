"""Posed images, as described by a transforms.json or a COLMAP model.

Poses and points stay in the capture's own coordinates, neither rotated, centered nor scaled. A
COLMAP model without known positions is not in meters, and its world may be upside down.

Images may lie elsewhere than a capture's file says: programs that train splats keep the originals
in `input` and smaller copies in `images_2`, `images_4` and `images_8`; others leave them beside the
model.

Shape symbols: n images; m points; t observations.
"""

import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from r3jax.formats.depth import MILLIMETERS, DepthUnit, resample_depth, stored_depth
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.frame import Frame
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.images import first_size, image_pixels, image_size, masked_pixels

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")
"""What Pillow may try."""

_MEASURED = 5
"""Images of a lens whose size is compared with it: one may be another's namesake."""

_WHITE = 128
"""Pixels of a mask that are darker do not count."""

_MAX_DEPTH = 256 << 20
"""Floats of the largest image, and a header [bytes]."""


@dataclass(frozen=True)
class Reconstruction:
    """Quality measures of a structure from motion; None if the model does not contain them."""

    posed: int
    """Pictures with a pose in this model."""

    pictures: int
    """Pictures beside them, with or without a pose."""

    error_median: float | None
    """Median over the points of their mean reprojection error [px]."""

    error_p95: float | None
    """95th percentile of the same [px]."""

    track_length: float | None
    """Mean number of pictures that see a point."""

    angle: float | None
    """Median over the points of the widest angle between two of their rays [deg]."""


@dataclass(frozen=True)
class SparsePoints:
    """Points from structure from motion, and the images that see them."""

    xyz: np.ndarray
    """Positions in the capture's coordinates, [m, 3] float64."""

    rgb: np.ndarray
    """Colors, [m, 3] uint8."""

    seen_point: np.ndarray
    """Index of the point of every observation, [t] int64, ascending."""

    seen_image: np.ndarray
    """Index of the image of every observation, [t] int64."""

    def __len__(self) -> int:
        """Returns the number of points."""
        return len(self.xyz)

    def seen_by(self, image: int) -> np.ndarray:
        """Finds the indices of the points that an image sees, ascending."""
        return np.unique(self.seen_point[self.seen_image == image])


@dataclass(frozen=True)
class Pixels:
    """Reads the pixels of archives and videos."""

    rgb: Callable[[int], np.ndarray]
    """Colors of an image, [H, W, 3] uint8, of its lens' size; raises FormatError."""

    depth: Callable[[int], np.ndarray]
    """z-depth of an image, [h, w] float32 of any size, 0 no measurement; raises FormatError."""

    mask: Callable[[int], np.ndarray] | None = None
    """True where the pixels of an image count, [H, W]; None: all of them do."""

    has_images: bool = True
    """False if the images are missing."""


@dataclass(frozen=True)
class PosedImages:
    """Images with their cameras and poses. Missing files are reported when they are read."""

    path: Path
    """The file or folder of the capture."""

    image_paths: tuple[Path, ...]
    """One per image; not all of them need to exist."""

    lenses: tuple[Lens, ...]
    """One per image."""

    poses: np.ndarray
    """`T_world_camera`, [n, 4, 4] float64: OpenCV axes, the capture's own coordinates."""

    depth_paths: tuple[Path | None, ...]
    """One per image; None where there is no depth image."""

    depth_unit: DepthUnit = MILLIMETERS
    """Meaning of the numbers in all depth images."""

    points: SparsePoints | None = None
    """None if the capture has none."""

    points_path: Path | None = None
    """A PLY with further points, of which nothing says who sees them: see `read_points`."""

    T_capture_original: np.ndarray | None = None
    """Where the program that wrote the capture moved it: takes points [4, 4] from the coordinates
    it was given to those of the poses; None: it does not say."""

    pixels: Pixels | None = None
    """Reads the pixels in place of the paths, which are names then; None: the paths are files."""

    depth_lenses: tuple[Lens, ...] | None = None
    """One per image, where depth has a camera of its own at the same place; None: a depth image
    covers what its image covers."""

    up: np.ndarray | None = None
    """The vertical, [3] in the capture's coordinates; None: unknown."""

    remark: str | None = None
    """A sentence on images that were left out; None: nothing was left out."""

    mask_paths: tuple[Path | None, ...] | None = None
    """One per image: black pixels of these images do not count (people, the sky, a turntable);
    None: there are no masks."""

    is_stereo: bool = False
    """True if depth was computed from the images, not measured: its holes are not known, and its
    unit is the poses'."""

    reconstruction: Reconstruction | None = None
    """Quality measures of the structure from motion; None: unknown."""

    photo_of: np.ndarray | None = None
    """Number of the photo that each image was cut from, [n]; None: each is a photo of its own."""

    @property
    def has_images(self) -> bool:
        """True unless all images are missing."""
        if self.pixels is not None:
            return self.pixels.has_images
        return any(path.is_file() for path in self.image_paths)

    def __len__(self) -> int:
        """Returns the number of images."""
        return len(self.image_paths)

    def with_depth(self, folder: Path, unit: DepthUnit) -> "PosedImages":
        """Adds the depth images of a folder: 16-bit PNGs of the images' names.

        For formats that have no place for depth. Images without a PNG there have no depth.
        """
        candidates = [folder / f"{path.stem}.png" for path in self.image_paths]
        found = tuple(path if path.is_file() else None for path in candidates)
        return dataclasses.replace(self, depth_paths=found, depth_unit=unit)

    def fitted(self) -> "PosedImages":
        """Scales the lenses to the size of the image files, if only that differs.

        Images are often reduced after their cameras were found. Of each lens the size of most of
        the first images that are there counts.
        """
        if self.pixels is not None:
            return self
        paths: dict[Lens, list[Path]] = {}
        for lens, path in zip(self.lenses, self.image_paths, strict=True):
            paths.setdefault(lens, []).append(path)
        lenses = {lens: _fitted(lens, of_lens) for lens, of_lens in paths.items()}
        changed = [(lens, now) for lens, now in lenses.items() if now != lens]
        if not changed:
            return self
        (lens, now), *_ = changed
        said = (
            f"The images have {now.width} x {now.height} pixels, their cameras were said to have "
            f"{lens.width} x {lens.height}: focal lengths and principal points are scaled."
        )
        return dataclasses.replace(
            self,
            lenses=tuple(lenses[lens] for lens in self.lenses),
            remark=f"{self.remark} {said}" if self.remark else said,
        )

    def frame(self, index: int) -> Frame:
        """Reads one image and its depth, which is sampled at its nearest pixels if sizes differ.

        Raises:
            FormatError: the image has distortion (undistort it first), there is no depth image,
                or a file is missing, broken, of another size, or of another unit of depth.
        """
        lens, path = self.lenses[index], self.image_paths[index]
        if not lens.is_pinhole:
            raise FormatError(
                path,
                f"the image is distorted ({lens.model}): undistort the capture first, for example "
                "by COLMAP's image_undistorter",
            )
        depth_path = self.depth_paths[index]
        if depth_path is None:
            raise FormatError(path, "it has no depth image")
        rgb, is_there = self.masked_rgb(index)
        depth = self.depth(index)
        if depth is not None and is_there is not None:
            depth = np.where(is_there, depth, np.float32(0.0))
        try:
            return Frame(
                rgb=jnp.asarray(rgb.astype(np.float32) / np.float32(255.0)),
                depth=jnp.asarray(depth),
                T_world_camera=jnp.asarray(self.poses[index], dtype=jnp.float32),
                camera=lens.camera,
            )
        except ValueError as error:
            raise FormatError(depth_path, str(error)) from None

    def rgb(self, index: int) -> np.ndarray:
        """Reads the pixels of one image as they are, distortion included, [H, W, 3] uint8.

        Raises:
            FormatError: the file is missing, broken or of another size.
        """
        return self.masked_rgb(index)[0]

    def masked_rgb(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Reads the pixels of one image, and which of them alpha and mask do not cut out.

        Returns:
            [H, W, 3] uint8 as `rgb`, and [H, W] bool; None: all of them count.

        Raises:
            FormatError: the file is missing, broken or of another size.
        """
        if self.pixels is not None:
            mask = None if self.pixels.mask is None else self.pixels.mask(index)
            return self.pixels.rgb(index), mask
        path, lens = self.image_paths[index], self.lenses[index]
        with naming(path):
            rgb, is_there = masked_pixels(path, IMAGE_FORMATS, (lens.width, lens.height))
        mask_path = None if self.mask_paths is None else self.mask_paths[index]
        if mask_path is None:
            return rgb, is_there
        with naming(mask_path):
            mask = image_pixels(mask_path, IMAGE_FORMATS).max(axis=2) >= _WHITE
        mask = resample_depth(mask, lens)
        return rgb, mask if is_there is None else mask & is_there

    def depth(self, index: int) -> np.ndarray | None:
        """Reads the depth of one image, pixel by pixel as in `rgb`, [H, W] float32; None without.

        0 means no measurement, inf nothing within range.

        Raises:
            FormatError: the file is missing, broken, or no depth image.
        """
        path = self.depth_paths[index]
        if path is None:
            return None
        if self.pixels is not None:
            stored = self.pixels.depth(index)
        else:
            with naming(path):
                stored = self.depth_unit.depth(stored_depth(read_bytes(path, _MAX_DEPTH)))
        own = None if self.depth_lenses is None else self.depth_lenses[index]
        return resample_depth(stored, self.lenses[index], own)

    def frames(self) -> Iterator[Frame]:
        """Iterates over every frame in order, reading one at a time."""
        return (self.frame(index) for index in range(len(self)))


def _fitted(lens: Lens, images: list[Path]) -> Lens:
    """Scales the lens to the size of its images; unchanged if their sides have another ratio."""
    sizes: Counter[tuple[int, int]] = Counter()
    for image in images:
        # What is wrong with an image is said when its pixels are read.
        with suppress(ForeignFileError, OSError):
            sizes[image_size(image, IMAGE_FORMATS)] += 1
        if sizes.total() == _MEASURED:
            break
    (size, _), *_ = sizes.most_common(1) or [((0, 0), 0)]
    return lens.resized(*size) if lens.has_shape(*size) else lens


COPIES = ("_2", "_4", "_8")
"""What the names of folders of smaller copies end with."""

FOLDERS = ("images", "input", *(f"images{copy}" for copy in COPIES), ".")
"""Where images lie, beside a model or above it."""


def find_images(places: Iterable[Path], names: Mapping[str, Lens]) -> Path | None:
    """Finds the folder that holds most of the images; None: none of them is anywhere.

    Args:
        places: folders that hold it, under one of the usual names; the first goes first.
        names: of the images, and the lens of each. Images of another shape than their lenses' were
            undistorted since, and go last.
    """
    best, most = None, (False, 0)
    for folder in (place / name for place in places for name in FOLDERS):
        # os.path: a name of a foreign file may be longer than a file's can be.
        there = [name for name in names if os.path.isfile(folder / name)]
        if there and (found := (_fits(folder, there, names), len(there))) > most:
            best, most = folder, found
    return best


def find_mask(folder: Path, name: str) -> Path | None:
    """Finds the mask of an image: `masks/NAME.png`, as COLMAP has them, or of the same stem.

    Args:
        folder: that holds the folder of the masks.
        name: of the image, below the folder of the images.
    """
    masks = folder / "masks"
    places = (masks / f"{name}.png", masks / Path(name).with_suffix(".png"))
    # os.path: a name of a foreign file may be longer than a file's can be.
    return next((place for place in places if os.path.isfile(place)), None)


def _fits(folder: Path, there: list[str], names: Mapping[str, Lens]) -> bool:
    """Checks whether the first image that can be opened has the shape of its lens."""
    with suppress(ForeignFileError, OSError):
        size = first_size((folder / name for name in there), IMAGE_FORMATS)
        return names[there[0]].has_shape(*size)
    return False


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


def left_out(count: int, total: int, frames: str = "frames") -> str | None:
    """Describes the frames that are left out, in a sentence; None if there are none.

    Args:
        count: of those that are left out.
        total: how many there are.
        frames: what they are called.
    """
    if not count:
        return None
    return f"{count} of {total} {frames} without an image, depth or a pose are left out."
