"""What is audited: posed pictures with some depth, whoever recorded them.

Shape symbols: n pictures; h, w size of a thinned picture.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np

from r3jax.apps.audit.alignment import Alignment
from r3jax.apps.audit.sampling import sampling_table, thinned
from r3jax.apps.audit.sparse import sparse_depth
from r3jax.formats.captures import PosedImages
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.formats.ply_points import read_points
from r3jax.formats.recordings import Recording
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.trace.reader import Run

MAX_SIDE = 640
"""Pictures are thinned out until their longer side has no more pixels."""

_MAX_POINTS = 500_000
"""Larger clouds are thinned out: a voxel needs one point."""

Picture = tuple[np.ndarray, np.ndarray]
"""Colors [h, w, 3] uint8 and z-depth [h, w] float32 in the capture's units; 0: unknown."""

Kind = Literal["depth", "tracks", "cloud"]


@dataclass(frozen=True)
class Source:
    """Posed pictures, in the capture's own coordinates, read one by one."""

    name: str
    """What the reader calls the capture."""

    poses: np.ndarray
    """`T_world_camera`, [n, 4, 4] float64: OpenCV axes."""

    lenses: tuple[Lens, ...]
    """One per picture."""

    labels: tuple[str, ...]
    """Names of the pictures."""

    kind: Kind
    """Where depth comes from: depth images, tracks of points, or a cloud of points."""

    is_metric: bool
    """True if a unit is a meter."""

    up: np.ndarray | None
    """The vertical, [3], where the format says so."""

    stride: int
    """Every so many pixels are read."""

    read: Callable[[int], Picture]
    """The thinned picture of an index."""

    has_images: bool = True
    """False where only points are there: their colors say nothing about noise."""

    remark: str | None = None
    """What the capture holds beside its pictures, a sentence."""

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.poses)

    @property
    def is_dense(self) -> bool:
        """True if depth images say where space is free."""
        return self.kind == "depth"

    def camera(self, index: int) -> Camera:
        """The pinhole of a thinned picture."""
        return thinned(self.lenses[index].camera, self.stride)

    def frame(self, index: int, alignment: Alignment) -> Frame:
        """One picture in the audit's coordinates.

        Raises:
            FormatError, RunError: a file is missing or broken.
        """
        rgb, depth = self.read(index)
        return Frame(
            rgb=jnp.asarray(rgb.astype(np.float32) / np.float32(255.0)),
            depth=jnp.asarray(depth * np.float32(alignment.scale)),
            T_world_camera=jnp.asarray(
                alignment.poses(self.poses[index : index + 1])[0], dtype=jnp.float32
            ),
            camera=self.camera(index),
            far=True,  # in units of the audit
        )


def source_of(capture: Run | Recording | PosedImages, name: str) -> Source:
    """Any capture, to be audited.

    Args:
        capture: what was opened; a recording with its poses as they are (`up="z"`).
        name: for the reader.

    Raises:
        FormatError: no pictures, neither depth nor points, a damaged cloud, or a lens that cannot
            be straightened.
    """
    if not len(capture.rows if isinstance(capture, Run) else capture):
        raise FormatError(capture.path, "there are no views to audit")
    if isinstance(capture, PosedImages):
        return dataclasses.replace(_of_images(capture, name), remark=capture.remark)
    if isinstance(capture, Run):
        poses = np.stack([row.pose for row in capture.rows]).astype(np.float64)
        labels = tuple(f"view {row.step + 1}" for row in capture.rows)
        up = np.array([0.0, 0.0, 1.0])
        camera = capture.camera
    else:
        poses, labels, up = capture.poses, tuple(p.name for p in capture.image_paths), None
        camera = capture.camera
    lens = pinhole_lens(camera)
    stride = _stride([lens])
    table = sampling_table(lens, stride)

    def read(index: int) -> Picture:
        frame = capture.frame(index)
        rgb = np.rint(np.asarray(frame.rgb) * np.float32(255.0)).astype(np.uint8)
        return table.take(rgb), table.take(np.asarray(frame.depth))

    return Source(name, poses, (lens,) * len(poses), labels, "depth", True, up, stride, read)


def _of_images(images: PosedImages, name: str) -> Source:
    stride = _stride(images.lenses)
    with naming(images.path):
        for lens in set(images.lenses):
            sampling_table(lens, stride)  # refuses a lens that it does not know
    labels = tuple(path.name for path in images.image_paths)
    if any(path is not None for path in images.depth_paths):
        return Source(
            name, images.poses, images.lenses, labels, "depth", True, None, stride,
            lambda index: _read_dense(images, index, stride),
        )  # fmt: skip
    has_images = any(path.is_file() for path in images.image_paths)
    if images.points is not None and len(images.points.seen_point):
        kind: Kind = "tracks"
        xyz, rgb = images.points.xyz, images.points.rgb
        order = np.argsort(images.points.seen_image, kind="stable")
        seen = images.points.seen_point[order]
        ends = np.searchsorted(images.points.seen_image[order], np.arange(len(images) + 1))
    else:
        kind = "cloud"
        xyz, rgb = _cloud(images)
        seen, ends = np.arange(len(xyz)), None

    def read(index: int) -> Picture:
        part = seen if ends is None else seen[ends[index] : ends[index + 1]]
        camera = thinned(images.lenses[index].camera, stride)
        depth, colors = sparse_depth(
            camera, images.poses[index], xyz[part], rgb[part], hides=ends is None
        )
        if has_images:
            colors = sampling_table(images.lenses[index], stride).take(images.rgb(index))
        return colors, depth

    return Source(
        name, images.poses, images.lenses, labels, kind, False, None, stride, read, has_images
    )


def _stride(lenses: tuple[Lens, ...] | list[Lens]) -> int:
    """One for all pictures: resolutions are compared between them."""
    return max(-(-max(lens.width, lens.height) // MAX_SIDE) for lens in lenses)


def _read_dense(images: PosedImages, index: int, stride: int) -> Picture:
    table = sampling_table(images.lenses[index], stride)
    depth = images.depth(index)
    if depth is None:
        depth = np.zeros((images.lenses[index].height, images.lenses[index].width), np.float32)
    return table.take(images.rgb(index)), table.take(depth)


def _cloud(images: PosedImages) -> tuple[np.ndarray, np.ndarray]:
    """Points that nobody says who sees: those of a model without tracks, or of a PLY."""
    if images.points is not None and len(images.points):
        xyz, rgb = images.points.xyz, images.points.rgb
    elif images.points_path is not None:
        xyz, rgb = read_points(images.points_path)
    else:
        raise FormatError(
            images.path,
            "there are neither depth images nor points: an audit needs one of them (COLMAP's "
            "points3D, nerfstudio's ply_file_path or depth_file_path)",
        )
    if len(xyz) == 0:
        raise FormatError(images.points_path or images.path, "there are no points in it")
    if len(xyz) > _MAX_POINTS:
        chosen = np.random.default_rng(0).choice(len(xyz), _MAX_POINTS, replace=False)
        xyz, rgb = xyz[chosen], rgb[chosen]
    return xyz, rgb
