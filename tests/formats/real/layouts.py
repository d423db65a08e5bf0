"""Layouts as files of real captures have them: names, headings, extra files, number formats.

Every oddity here was seen in a public file or in the source of the program that writes it. The
pictures are plain colors with a brighter corner, so that a flip, a swap of frames or of channels
shows; depth is larger in the same corner.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from r3jax.formats.poses import quaternion_of
from tests.formats.colmap_models import random_pose
from tests.formats.sequences import encoded

NUM = 3

POSES = np.stack([random_pose(seed) for seed in (2, 4, 5)])
"""`T_world_camera` in the capture's own coordinates; OpenCV axes."""

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Files = dict[str, bytes]


@dataclass(frozen=True)
class Layout:
    """A capture and what a reader must find in it."""

    name: str
    files: Callable[[], Files]
    size: tuple[int, int]
    """Width and height of the pictures."""

    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px], pixel centers at halves."""

    given: str = "."
    """What the user types, relative to the capture's folder."""

    frames: tuple[int, ...] = (0, 1, 2)
    """Which of `POSES` are there, in order."""

    model: str = "PINHOLE"
    up: tuple[float, float, float] | None = None
    has_depth: bool = True
    has_points: bool = False
    remark: tuple[str, ...] = ()
    """Words that the remark must hold; none: there is no remark."""

    poses_off: float = 1e-6
    """Rounding of the format."""

    extra: Files = field(default_factory=dict[str, bytes])
    """Files that the program leaves beside, too."""


def color(index: int) -> tuple[int, int, int]:
    """Of a picture's lower right; its upper left quarter is white."""
    return (200 - 60 * index, 30, 40 + 60 * index)


def pixels(index: int, width: int, height: int) -> np.ndarray:
    """A picture [height, width, 3] uint8."""
    found = np.full((height, width, 3), color(index), np.uint8)
    found[: height // 2, : width // 2] = 255
    return found


def meters(index: int, width: int, height: int) -> np.ndarray:
    """z-depth [height, width] float32: 1.2, 1.4, 1.6 m, and 1 m more in the upper left quarter."""
    found = np.full((height, width), 1.2 + 0.2 * index, np.float32)
    found[: height // 2, : width // 2] += 1.0
    return found


def picture(index: int, size: tuple[int, int], kind: str = "jpeg") -> bytes:
    """The picture as a file."""
    return encoded(pixels(index, *size), kind)


def depth_png(index: int, size: tuple[int, int], steps: float = 1000.0) -> bytes:
    """Writes depth as a 16-bit PNG with the given steps per meter."""
    return encoded(np.rint(steps * meters(index, *size)).astype(np.uint16))


def quaternion(pose: np.ndarray) -> list[float]:
    """x, y, z, w."""
    w, x, y, z = quaternion_of(pose[:3, :3])
    return [x, y, z, w]


def text(data: object) -> bytes:
    """JSON as bytes."""
    return json.dumps(data).encode()


def lfs_pointer() -> bytes:
    """What a clone without Git LFS has in place of a large file."""
    return b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4e" * 32 + b"\nsize 91\n"


def cloud() -> bytes:
    """A binary PLY of eight points, with the normals that COLMAP and 3DGS write."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    lines = [f"property float {name}" for name in names]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 8", *lines, "end_header"]
    rows = b"".join(struct.pack("<6f3B", i, i % 2, 2.0, 0, 0, 1, 9, 8, 7) for i in range(8))
    return ("\n".join(head) + "\n").encode() + rows
