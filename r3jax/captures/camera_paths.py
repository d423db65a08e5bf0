"""Reads and writes camera paths in nerfstudio's two layouts, in a capture's own coordinates.

    camera_path.json     saved by its viewer and read by `ns-render camera-path`
    transforms.json      frames with intrinsics, without images

nerfstudio's viewer saves paths in the coordinates of its training, which are rotated, centered and
scaled by default. If the training's dataparser_transforms.json lies beside the path, this is
undone. Otherwise the coordinates are assumed to be the capture's own, in which nerfstudio trains
with `--orientation-method none --center-method none --auto-scale-poses False`.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.files import write_atomic
from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.formats.nerfstudio import NAME, OPENGL_FROM_OPENCV, read_normalization
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.poses import mend_pose
from r3jax.geometry.cameras import Camera
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, check_type, parse_json, sealed, unsealed

_MAX_BYTES = 256 << 20
"""A pose takes some hundred bytes."""

_LEAST_ANGLE = 0.01
"""Minimum plausible angle of view [deg]."""

_FIELDS = {"camera_to_world": list[float], "fov": float}


@dataclass(frozen=True)
class CameraPath:
    """Poses to evaluate."""

    poses: np.ndarray
    """`T_world_camera`, [n, 4, 4] float64: OpenCV axes, the capture's own coordinates."""

    lenses: tuple[Lens, ...]
    """One per pose."""


def is_camera_path(path: Path) -> bool:
    """Returns True for a readable JSON file with a `camera_path`, False for any other file."""
    if path.suffix != ".json" or not path.is_file():
        return False
    try:
        content = parse_json(read_bytes(path, _MAX_BYTES))
    except (OSError, ForeignFileError):
        return False
    return isinstance(content, dict) and "camera_path" in content


def read_camera_path(path: Path) -> CameraPath:
    """Reads a camera_path.json.

    Raises:
        FormatError: the file is missing or damaged, or not a perspective path; a pose is not rigid,
            or an angle of view is invalid.
    """
    with naming(path):
        content = parse_json(read_bytes(path, _MAX_BYTES))
        content = unsealed(content) if isinstance(content, dict) else content
        kinds = {"render_width": float, "render_height": float}
        check_fields("camera path", content, {"camera_path": list[dict[str, Any]], **kinds})
        kind = content.get("camera_type", "perspective")
        if kind != "perspective":
            raise ForeignFileError(f"only perspective paths are supported, this is {kind!r:.40}")
        entries: list[dict[str, Any]] = content["camera_path"]
        if not entries:
            raise ForeignFileError("it holds no cameras")
        size = round(content["render_width"]), round(content["render_height"])
        matrices = [_matrix(i, entry) for i, entry in enumerate(entries)]
        lenses = [_lens(i, entry, size) for i, entry in enumerate(entries)]
    poses = [
        mend_pose(path, f"camera_path[{i}]", matrix @ OPENGL_FROM_OPENCV)
        for i, matrix in enumerate(matrices)
    ]
    return CameraPath(np.stack(poses), tuple(lenses))


def _matrix(index: int, entry: dict[str, Any]) -> np.ndarray:
    check_fields(f"camera_path[{index}]", entry, _FIELDS)
    values: list[float] = entry["camera_to_world"]
    if len(values) != 16:
        raise ForeignFileError(
            f"camera_path[{index}].camera_to_world must be 16 numbers, got {len(values)}"
        )
    return np.asarray(values, np.float64).reshape(4, 4)


def _lens(index: int, entry: dict[str, Any], size: tuple[int, int]) -> Lens:
    """Makes the lens of a keyframe, whose `fov` is the vertical angle of view [deg].

    `aspect` makes no difference to square pixels.
    """
    check_type(f"camera_path[{index}].fov", entry["fov"], float)
    if not _LEAST_ANGLE <= entry["fov"] < 180.0:
        raise ForeignFileError(
            f"camera_path[{index}].fov must lie in [{_LEAST_ANGLE:g}, 180) degrees, got "
            f"{entry['fov']:g}"
        )
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * math.radians(entry["fov"]))
    return Lens("PINHOLE", width, height, (focal, focal, 0.5 * width, 0.5 * height))


def write_camera_path(path: Path, poses: np.ndarray, camera: Camera, seconds: float = 2.0) -> None:
    """Writes a camera_path.json.

    Args:
        path: the file.
        poses: `T_world_camera`, [n, 4, 4].
        camera: camera of all poses; this layout cannot store off-center principal points.
        seconds: time between two poses of the path.

    Raises:
        OSError: for example, the disk is full or not writable.
    """
    fov = 2.0 * math.degrees(math.atan(0.5 * camera.height / float(camera.fy)))
    aspect = camera.width / camera.height
    cameras = [
        {
            "camera_to_world": (pose.astype(np.float64) @ OPENGL_FROM_OPENCV).reshape(-1).tolist(),
            "fov": fov,
            "aspect": aspect,
        }
        for pose in poses
    ]
    content = {
        "camera_type": "perspective",
        "render_width": camera.width,
        "render_height": camera.height,
        "fps": 1,
        "seconds": seconds * len(cameras),
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": cameras,
        # Fields that the viewer needs to show and edit the path.
        "keyframes": [
            {"matrix": c["camera_to_world"], "fov": fov, "aspect": aspect} for c in cameras
        ],
    }
    write_atomic(path, (json.dumps(sealed(content), indent=1) + "\n").encode())


def write_path_transforms(path: Path, poses: np.ndarray, camera: Camera) -> None:
    """Writes a transforms.json of poses whose images are still to be taken.

    Args:
        path: the file.
        poses: `T_world_camera`, [n, 4, 4].
        camera: of all poses.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    fx, fy, cx, cy = pinhole_lens(camera).params
    content = {
        "camera_model": "PINHOLE",
        "w": camera.width,
        "h": camera.height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "frames": [
            {
                "file_path": f"suggested/{number:03d}.png",
                "transform_matrix": (pose.astype(np.float64) @ OPENGL_FROM_OPENCV).tolist(),
            }
            for number, pose in enumerate(poses, start=1)
        ],
    }
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())


def path_of(path: Path, capture: object = None) -> CameraPath:
    """Reads the poses of a camera path, or of any capture.

    Args:
        path: the file or folder.
        capture: the capture whose coordinates to use; matters if a dataparser_transforms.json lies
            beside a camera_path.json.

    Raises:
        FormatError: the path is neither, or damaged.
        RunError: the path is a damaged run.
    """
    if is_camera_path(path):
        found, normalization = read_camera_path(path), path.parent / NAME
        if not normalization.exists():
            return found
        moved = capture.T_capture_original if isinstance(capture, PosedImages) else None
        poses = read_normalization(normalization).undone(found.poses, moved)
        return CameraPath(poses, found.lenses)
    source = open_capture(path, "z").source
    if isinstance(source, PosedImages):
        return CameraPath(source.poses, source.lenses)
    if not source.rows:
        raise FormatError(path, "the run has no views yet: no path to evaluate")
    poses = np.stack([row.pose for row in source.rows]).astype(np.float64)
    return CameraPath(poses, (pinhole_lens(source.camera),) * len(poses))
