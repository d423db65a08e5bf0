"""Represents a capture as posed images with depth, from any device or program.

An audit needs about one pixel per voxel, and no more accuracy than a voxel. Images are therefore
subsampled, not averaged, and lenses are undistorted by taking the nearest pixel. Pixels of the
undistorted image that lie outside of the original one are missing.

Captures without depth get sparse depth images from points. If structure from motion records which
image sees which point, this is used; of a plain cloud (nerfstudio's `ply_file_path`) an image sees
the points that no nearer one hides.

Shape symbols: n images; m points; H, W image size; h, w size of a thinned image.
"""

import dataclasses
import functools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from r3jax.captures.alignment import Alignment, evenly_spaced
from r3jax.errors import InputError
from r3jax.formats.colmap.reader import main_model
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, distorted, pinhole_lens
from r3jax.formats.points import read_points
from r3jax.formats.posed_images import IMAGE_FORMATS, PosedImages, Reconstruction
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.runs.reader import Run
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import printable
from r3jax.validation.images import shown_top


class SamplingTable(NamedTuple):
    """Which pixel of an image each pixel of the thinned one takes."""

    row: np.ndarray
    """[h, w] int64."""

    column: np.ndarray
    """[h, w] int64."""

    is_there: np.ndarray
    """False where the image has no such pixel, [h, w]."""

    def take(self, image: np.ndarray) -> np.ndarray:
        """Thins an image [H, W, ...] to [h, w, ...]; samples outside of it are 0."""
        taken = image[self.row, self.column]
        taken[~self.is_there] = 0
        return taken


def thinned(camera: Camera, stride: int) -> Camera:
    """Returns the pinhole of every `stride`-th pixel, starting in the middle of the first block."""
    sides = (camera.width, camera.height)
    width, height = (len(taken(side, stride)) for side in sides)
    cx, cy = (
        (float(center) - taken(side, stride)[0] - 0.5) / stride + 0.5
        for center, side in zip((camera.cx, camera.cy), sides, strict=True)
    )
    return Camera(width, height, float(camera.fx) / stride, float(camera.fy) / stride, cx, cy)


@functools.lru_cache(maxsize=64)
def _thinned_pinhole(lens: Lens, stride: int) -> Camera:
    """Returns the pinhole of a lens's thinned images; frames by the thousand share a lens."""
    return thinned(lens.camera, stride)


def taken(side: int, stride: int) -> np.ndarray:
    """Returns the indices of the pixels taken from `side` pixels in a row; at least one."""
    return np.arange(min(stride // 2, side - 1), side, stride)


def lens_of(camera: Camera) -> np.ndarray:
    """Returns fx, fy, cx and cy on the host, [4] float64 [px]."""
    return np.array([float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)])


def ray_lengths(shape: tuple[int, ...], lens: np.ndarray) -> np.ndarray:
    """Computes the lengths of the pixels' rays (x, y, 1), [h, w]: depth along the ray over z.

    Args:
        shape: h, w.
        lens: fx, fy, cx, cy, [4].
    """
    fx, fy, cx, cy = lens
    x, y = (np.arange(shape[1]) + 0.5 - cx) / fx, (np.arange(shape[0]) + 0.5 - cy) / fy
    return np.sqrt(1.0 + x**2 + y[:, None] ** 2)


@functools.lru_cache(maxsize=8)
def sampling_table(lens: Lens, stride: int) -> SamplingTable:
    """Computes the position of each pixel of `thinned(lens.camera, stride)` in the lens's image.

    Raises:
        ForeignFileError: a lens whose distortion is not known here.
    """
    column, row = np.meshgrid(taken(lens.width, stride), taken(lens.height, stride))
    if not lens.is_pinhole:
        fx, fy, cx, cy = lens.intrinsics
        x, y = distorted(lens, (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy)
        column, row = np.floor(fx * x + cx), np.floor(fy * y + cy)
    is_there = (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
    column, row = np.where(is_there, column, 0), np.where(is_there, row, 0)
    return SamplingTable(row.astype(np.int64), column.astype(np.int64), is_there)


class Projected(NamedTuple):
    """Where points lie in an image, [m] each."""

    column: np.ndarray
    """[px], of any value."""

    row: np.ndarray
    """[px], of any value."""

    z: np.ndarray
    """Along the camera's axis, in the points' unit."""

    is_in: np.ndarray
    """True within the image and before the camera; False where a point is NaN."""


def projected(
    camera: Camera, pose: np.ndarray, points: np.ndarray, nearest: float = 0.0
) -> Projected:
    """Projects points into an image, hidden or not.

    Args:
        camera: its pinhole.
        pose: `T_world_camera`, [4, 4].
        points: [m, 3] in the same world.
        nearest: z from which on a point is before the camera.
    """
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    is_ahead = z > nearest
    safe = np.where(is_ahead, z, 1.0)
    column = float(camera.fx) * x / safe + float(camera.cx)
    row = float(camera.fy) * y / safe + float(camera.cy)
    is_in = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return Projected(column, row, z, is_ahead & is_in)


_BLOCKS_ACROSS = 80
"""Blocks per row of an image, in which the nearest point of a cloud hides the others."""

_SLACK = 1.05
"""Points at most this many times as far as the nearest one of their block are seen."""


def sparse_depth(
    camera: Camera, pose: np.ndarray, xyz: np.ndarray, rgb: np.ndarray, *, hides: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Projects the points that an image shows: z-depth [H, W] float32 and colors [H, W, 3] uint8.

    Args:
        camera: of the image.
        pose: `T_world_camera`, [4, 4], in the points' coordinates.
        xyz: points, [m, 3].
        rgb: their colors, [m, 3] uint8.
        hides: True if a point hides those behind it.

    Returns:
        0 and black in pixels without a point; the nearest one where there are several.
    """
    shape = (camera.height, camera.width)
    depth, colors = np.full(shape, np.inf, np.float32), np.zeros((*shape, 3), np.uint8)
    column, row, z, is_in = projected(camera, pose, xyz)
    kept = np.flatnonzero(is_in)
    row, column, z = row[kept].astype(np.int64), column[kept].astype(np.int64), z[kept]
    if hides and len(kept):
        side = max(1, round(shape[1] / _BLOCKS_ACROSS))
        wide = -(-shape[1] // side)
        block = (row // side) * wide + column // side
        nearest = np.full(wide * -(-shape[0] // side), np.inf)
        np.minimum.at(nearest, block, z)
        is_front = z <= _SLACK * nearest[block]
        kept, row, column, z = kept[is_front], row[is_front], column[is_front], z[is_front]
    order = np.argsort(-z, kind="stable")  # the nearest is written last
    depth[row[order], column[order]] = z[order]
    colors[row[order], column[order]] = rgb[kept[order]]
    return np.where(np.isfinite(depth), depth, np.float32(0.0)), colors


MAX_SIDE = 640
"""Images are thinned out until their longer side has no more pixels."""

_FEWEST_POINTS = 50
"""Minimum number of points; reconstructions have thousands."""

_MAX_POINTS = 500_000
"""Larger clouds are thinned out: a voxel needs one point."""

Picture = tuple[np.ndarray, np.ndarray]
"""Colors [h, w, 3] uint8 and z-depth [h, w] float32 in the capture's units; 0: unknown."""

Kind = Literal["depth", "stereo", "sweep", "model", "tracks", "cloud", "photos"]
"""Where depth comes from: a depth camera; COLMAP's stereo; our own sweep of planes; a trained
splat; points with tracks; a cloud of points; nowhere yet (`surfaces.with_surfaces` adds it)."""

Photograph = tuple[np.ndarray, np.ndarray]
"""Colors [h, w, 3] uint8 of a thinned image, and brightness in [0, 1], [h, w] float32, as means
over its blocks; both are 0 where the lens has no pixel."""


@dataclass(frozen=True)
class Source:
    """Posed images, in the capture's own coordinates, read one by one."""

    name: str
    """Name of the capture in reports."""

    poses: np.ndarray
    """`T_world_camera`, [n, 4, 4] float64: OpenCV axes."""

    lenses: tuple[Lens, ...]
    """One per image."""

    labels: tuple[str, ...]
    """Names of the images."""

    kind: Kind
    """Where depth comes from."""

    is_metric: bool
    """True if the capture's unit is a meter."""

    up: np.ndarray | None
    """The vertical, [3]; None if the format does not define it."""

    stride: int
    """Stride of the pixels that are read."""

    read: Callable[[int], Picture]
    """Reads the thinned image with an index."""

    has_images: bool = True
    """False if the images are missing and there is only depth or points: colors are not known."""

    remark: str | None = None
    """Remark on the capture for reports, in sentences."""

    photograph: Callable[[int, int], Photograph] | None = None
    """Reads an image of an index for a comparison with others, thinned by a stride; None: there are
    no images."""

    reconstruction: Reconstruction | None = None
    """Quality measures of the structure from motion; None if the format has none."""

    photo_of: np.ndarray | None = None
    """Number of the photo that each image was cut from, [n]; None: each is a photo of its own."""

    top: Callable[[int], tuple[int, int]] | None = None
    """Reads where the top of an image's photo lies in its pixels (`shown_top`); None: above."""

    def __len__(self) -> int:
        """Returns the number of images."""
        return len(self.poses)

    @property
    def is_dense(self) -> bool:
        """True if depth images say where space is free."""
        return self.kind not in ("tracks", "cloud", "photos")

    @property
    def is_complete(self) -> bool:
        """True if a depth camera measured the surfaces: what it does not show was not in view.

        Otherwise a surface may be in view of many images and have no point: it is not known.
        """
        return self.kind == "depth"

    def some(self, most: int, among: np.ndarray | None = None) -> np.ndarray:
        """Picks at most `most` images, evenly spread over the capture, ascending.

        Of a photo that was cut into views all are picked, or none: evenly spaced ones might all
        look in the same direction.

        Args:
            most: how many.
            among: indices to choose from; None: all.
        """
        among = np.arange(len(self)) if among is None else among
        if self.photo_of is None or len(among) <= most:
            return among[evenly_spaced(len(among), most)]
        photos, counts = np.unique(self.photo_of[among], return_counts=True)
        chosen = photos[evenly_spaced(len(photos), max(1, most // int(counts.max())))]
        return among[np.isin(self.photo_of[among], chosen)][:most]

    def camera(self, index: int) -> Camera:
        """Returns the pinhole of a thinned image."""
        return _thinned_pinhole(self.lenses[index], self.stride)

    def with_depth(self, scale: float = 1.0, *, is_along_ray: bool = False) -> "Source":
        """Returns the capture with its depth images converted; depth from points is refused.

        Args:
            scale: all depths are multiplied by this.
            is_along_ray: True if they are distances along the pixels' rays: they become z.

        Raises:
            ValueError: depth comes from points; or a scale that is not positive.
        """
        if not self.is_complete:
            raise InputError("--depth-scale and --depth-along-ray are for depth images: here "
                             "depth comes from points")  # fmt: skip
        if not 0.0 < scale < np.inf:
            raise InputError(f"--depth-scale must be positive, got {scale}")

        def read(index: int) -> Picture:
            rgb, depth = self.read(index)
            camera = self.camera(index)
            lengths = ray_lengths(depth.shape, lens_of(camera)) if is_along_ray else 1.0
            return rgb, (scale * depth / lengths).astype(np.float32)

        return dataclasses.replace(self, read=read)

    def try_read(self, index: int) -> Picture | FormatError:
        """Reads one thinned image, or returns why it cannot be read."""
        try:
            return self.read(index)
        except FormatError as error:
            return error

    def frame(self, index: int, alignment: Alignment) -> Frame:
        """Reads one image in the audit's coordinates.

        Raises:
            FormatError, RunError: a file is missing or broken.
        """
        return self.framed(self.read(index), index, alignment)

    def framed(self, picture: Picture, index: int, alignment: Alignment) -> Frame:
        """Converts an image that has been read into the audit's coordinates."""
        rgb, depth = picture
        return Frame(
            rgb=jnp.asarray(rgb.astype(np.float32) / np.float32(255.0)),
            depth=jnp.asarray(depth * np.float32(alignment.scale)),
            T_world_camera=jnp.asarray(
                alignment.poses(self.poses[index : index + 1])[0], dtype=jnp.float32
            ),
            camera=self.camera(index),
            far=True,  # in units of the audit
        )


def source_of(capture: Run | PosedImages, name: str, *, can_compute: bool = False) -> Source:
    """Creates a source for an audit from any capture.

    Args:
        capture: the opened capture; for a recording, with unchanged poses (`up="z"`).
        name: name of the capture in reports.
        can_compute: True if `with_surfaces` will add depth: photos alone are enough then.

    Raises:
        FormatError: no images, neither depth nor points, a damaged cloud, or a lens that cannot
            be straightened.
    """
    if not len(capture.rows if isinstance(capture, Run) else capture):
        raise FormatError(capture.path, "there are no views to audit")
    if isinstance(capture, PosedImages):
        return _of_images(capture, name, can_compute)
    poses = np.stack([row.pose for row in capture.rows]).astype(np.float64)
    labels = tuple(f"view {row.step + 1}" for row in capture.rows)
    up = np.array([0.0, 0.0, 1.0])
    lens = pinhole_lens(capture.camera)
    stride = _stride([lens])
    table = sampling_table(lens, stride)

    def read(index: int) -> Picture:
        frame = capture.frame(index)
        rgb = np.rint(np.asarray(frame.rgb) * np.float32(255.0)).astype(np.uint8)
        return table.take(rgb), table.take(np.asarray(frame.depth))

    return Source(name, poses, (lens,) * len(poses), labels, "depth", True, up, stride, read)


def _of_images(images: PosedImages, name: str, can_compute: bool) -> Source:
    if len(images) > 2 and np.ptp(images.poses, axis=0).max() == 0.0:
        raise FormatError(
            images.path,
            f"the poses of all {len(images)} images are equal: they were not found yet, so run the "
            "structure from motion or the tracking first",
        )
    stride = _stride(images.lenses)
    with naming(images.path):
        for lens in set(images.lenses):
            sampling_table(lens, stride)  # refuses unknown lenses
    labels = tuple(printable(path.name) for path in images.image_paths)
    has_images = images.has_images
    remark = images.remark
    if not has_images:
        none = (
            f"None of the {len(images)} pictures was found (the first should be "
            f"{images.image_paths[0]}): their sharpness, exposure and colors are not known."
        )
        if images.image_paths[0].parent.is_file():  # git without symbolic links
            none += f" {images.image_paths[0].parent} is a file: restore the folder it stands for."
        remark = none if remark is None else f"{none} {remark}"
    if hidden := _hidden_share(images) if has_images else 0.0:
        masked = f"Masks hide {100 * hidden:.0f} % of the pictures."
        remark = masked if remark is None else f"{remark} {masked}"
    remark = None if remark is None else printable(remark)
    photograph = (lambda index, by: _photograph(images, index, by)) if has_images else None
    top = (lambda index: _top(images, index)) if has_images and images.pixels is None else None
    if any(path is not None for path in images.depth_paths):
        is_camera = not images.is_stereo
        return Source(
            name, images.poses, images.lenses, labels, "depth" if is_camera else "stereo",
            is_camera, images.up, stride,
            lambda index: _read_dense(images, index, stride, has_images), has_images, remark,
            photograph, images.reconstruction, images.photo_of, top,
        )  # fmt: skip
    if can_compute and has_images and not images.points and images.points_path is None:
        return Source(
            name, images.poses, images.lenses, labels, "photos", False, images.up, stride,
            lambda index: _read_colors(images, index, stride), has_images, remark, photograph,
            images.reconstruction, images.photo_of, top,
        )  # fmt: skip
    if images.points is not None and len(images.points.seen_point):
        kind: Kind = "tracks"
        xyz, rgb = images.points.xyz, images.points.rgb
        count = len(np.unique(images.points.seen_point))
        order = np.argsort(images.points.seen_image, kind="stable")
        seen = images.points.seen_point[order]
        ends = np.searchsorted(images.points.seen_image[order], np.arange(len(images) + 1))
    else:
        kind = "cloud"
        xyz, rgb = _cloud(images)
        seen, ends = np.arange(len(xyz)), None
        count = len(xyz)
    if count < _FEWEST_POINTS:
        raise FormatError(
            images.points_path or images.path,
            f"there are no depth images, and only {count} points, fewer than {_FEWEST_POINTS}: the "
            "reconstruction failed, so take more pictures that overlap and reconstruct again",
        )
    _check_points(images, xyz, seen if ends is not None else None)

    def read(index: int) -> Picture:
        part = seen if ends is None else seen[ends[index] : ends[index + 1]]
        camera = thinned(images.lenses[index].camera, stride)
        depth, colors = sparse_depth(
            camera, images.poses[index], xyz[part], rgb[part], hides=ends is None
        )
        if has_images:
            colors, is_there = _thinned_colors(images, index, stride)
            depth[~is_there] = 0.0
        return colors, depth

    return Source(
        name, images.poses, images.lenses, labels, kind, False, images.up, stride, read, has_images,
        remark, photograph, images.reconstruction, images.photo_of, top,
    )  # fmt: skip


_MOST_CHECKED = 100_000
"""Pairs of a point and an image that are checked."""

_BEHIND = 0.5
"""Maximum share of points behind the cameras that see them, or of cameras that see no point."""


def _check_points(images: PosedImages, xyz: np.ndarray, seen: np.ndarray | None) -> None:
    """Refuses points that contradict the cameras: behind them, or of another scene or scale.

    Args:
        images: the capture.
        xyz: its points, [m, 3].
        seen: None if nothing says which image sees which point; else that of its points is
            checked.
    """
    rng = np.random.default_rng(0)
    centers = images.poses[:, :3, 3]
    if seen is not None and images.points is not None:
        some = rng.permutation(len(images.points.seen_point))[:_MOST_CHECKED]
        point, image = images.points.seen_point[some], images.points.seen_image[some]
        axes = images.poses[image, :3, 2]
        behind = float((np.einsum("ij,ij->i", xyz[point] - centers[image], axes) <= 0.0).mean())
        if behind > _BEHIND:
            raise FormatError(
                images.path,
                f"{100 * behind:.0f} % of the points lie behind the cameras that see them: the "
                "poses are of another convention (COLMAP's take the world to the camera, with z "
                "forward), or points and poses are of different reconstructions",
            )
        return
    some = xyz[rng.permutation(len(xyz))[: _MOST_CHECKED // len(images) + 1]]
    blind = [
        not projected(lens.camera, pose, some).is_in.any()
        for lens, pose in zip(images.lenses, images.poses, strict=True)
    ]
    if np.mean(blind) > _BEHIND:
        middle = np.median(some, axis=0)
        apart = float(np.linalg.norm(middle - np.median(centers, axis=0)))
        size = float(np.linalg.norm(np.ptp(some, axis=0)))
        spread = float(np.linalg.norm(np.ptp(centers, axis=0)))
        raise FormatError(
            images.points_path or images.path,
            f"{sum(blind)} of {len(blind)} cameras have none of its points in view: the points "
            f"span {size:.3g} and the cameras {spread:.3g}, {apart:.3g} apart, so they are of "
            "another scene, scale or coordinate system; give the points of these poses",
        )


def _top(images: PosedImages, index: int) -> tuple[int, int]:
    with suppress(ForeignFileError, OSError):  # what cannot be read is named when all are
        return shown_top(images.image_paths[index], IMAGE_FORMATS)
    return 0, -1


def _stride(lenses: tuple[Lens, ...] | list[Lens]) -> int:
    """Chooses one stride for all images, as resolutions are compared between them."""
    return max(-(-max(lens.width, lens.height) // MAX_SIDE) for lens in lenses)


def _read_dense(images: PosedImages, index: int, stride: int, has_images: bool) -> Picture:
    table = sampling_table(images.lenses[index], stride)
    depth = images.depth(index)
    if depth is None:
        depth = np.zeros((images.lenses[index].height, images.lenses[index].width), np.float32)
    if not has_images:
        return np.zeros((*table.row.shape, 3), np.uint8), table.take(depth)
    colors, is_there = _thinned_colors(images, index, stride)
    return colors, np.where(is_there, table.take(depth), np.float32(0.0))


def _read_colors(images: PosedImages, index: int, stride: int) -> Picture:
    colors, _ = _thinned_colors(images, index, stride)
    return colors, np.zeros(colors.shape[:2], np.float32)


def _thinned_colors(images: PosedImages, index: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Reads colors [h, w, 3] uint8 of a thinned image, and the mask of its pixels, [h, w]."""
    table = sampling_table(images.lenses[index], stride)
    rgb, mask = images.masked_rgb(index)
    return table.take(rgb), table.is_there if mask is None else table.take(mask)


_MEASURED = 12
"""Images whose masks are measured."""


def _hidden_share(images: PosedImages) -> float:
    """Measures the share of the pictures that masks and alpha channels cut out, of some."""
    if images.pixels is not None and images.pixels.mask is None:
        return 0.0
    shares: list[float] = []
    # At random: the views of a photo that was cut follow each other.
    some = np.random.default_rng(0).permutation(len(images))[:_MEASURED]
    for index in np.sort(some).tolist():
        with suppress(FormatError):  # what cannot be read is named when all are
            mask = images.masked_rgb(index)[1]
            shares.append(0.0 if mask is None else float(1.0 - mask.mean()))
    return float(np.mean(shares)) if shares else 0.0


def _photograph(images: PosedImages, index: int, stride: int) -> Photograph:
    table = sampling_table(images.lenses[index], stride)
    rgb, mask = images.masked_rgb(index)
    gray = rgb[..., 0] * _BRIGHTNESS[0]  # channel by channel: photos may have 100 megapixels
    for channel in (1, 2):
        gray += rgb[..., channel] * _BRIGHTNESS[channel]
    # A pixel of the thinned image is at the middle of its block: an odd window has one, too.
    smooth = ndimage.uniform_filter(gray, stride | 1) if stride > 1 else gray
    colors, brightness = table.take(rgb), table.take(smooth)
    if mask is not None:
        brightness = np.where(table.take(mask), brightness, np.float32(0.0))
    return colors, brightness


_BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255.0)
"""Weights of red, green and blue, of 8 bits."""


NO_SURFACES = (
    "there are neither depth images nor points: an audit needs one of them (COLMAP's points3D, "
    "nerfstudio's ply_file_path or depth_file_path) or a splat trained on the photos (--model)"
)
"""What is said where nothing tells where surfaces lie."""


def _cloud(images: PosedImages) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points without tracks: no image is known to see them (as in a PLY)."""
    if images.points is not None and len(images.points):
        xyz, rgb = images.points.xyz, images.points.rgb
    elif images.points_path is not None:
        xyz, rgb = read_points(images.points_path)
    else:
        is_file = images.path.suffix == ".json"
        model = None
        with suppress(FormatError):  # of another capture: it is only named
            model = main_model(images.path.parent) if is_file else None
        beside = (
            "" if model is None else f"; the COLMAP model beside it has points: audit {model[0]}"
        )
        absent = (
            ""
            if images.has_images
            else f"; photos would do, but {images.image_paths[0]} is missing: copy them there"
        )
        raise FormatError(images.path, f"{NO_SURFACES}{absent}{beside}")
    if len(xyz) > _MAX_POINTS:
        chosen = np.random.default_rng(0).choice(len(xyz), _MAX_POINTS, replace=False)
        xyz, rgb = xyz[chosen], rgb[chosen]
    return xyz, rgb
