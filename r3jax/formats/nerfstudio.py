"""Reads transforms.json of nerfstudio and other programs, and writes that of a run.

instant-ngp, Blender and phone apps also write it, each with some additional fields.

OpenGL camera axes (x right, y up, z backward), camera to world, pixel centers at +0.5
(https://docs.nerf.studio/quickstart/data_conventions.html).

Read, poses stay in the coordinates of the file, as do the points of `ply_file_path`: suggested
cameras are written in the same coordinates. `applied_transform` says how they were made of the
coordinates of an earlier program; it is kept and not undone. `applied_scale` is undone where there
are depth images, which were not scaled: poses are in their units again.

Written, they are in meters, world z up. Depth images are uint16; one step is
`depth_unit_scale_factor` meters; 0 is no measurement and `depth_beyond_range_value` means that
nothing lies within the sensor's range.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r3jax.exploration.config import BEYOND_RANGE, DEPTH_STEPS_PER_METRE
from r3jax.exploration.taken_views import StepRow
from r3jax.files import write_atomic
from r3jax.formats.depth import DepthUnit
from r3jax.formats.errors import naming
from r3jax.formats.lenses import DUAL_FISHEYE, PANORAMA, Lens
from r3jax.formats.posed_images import FOLDERS, IMAGE_FORMATS, PosedImages, find_mask
from r3jax.formats.poses import mend_pose
from r3jax.runs.reader import Run
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import below, read_bytes
from r3jax.validation.images import first_size
from r3jax.validation.json_text import check_fields, check_type, parse_json

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns the camera's axes: `T_world_opengl = T_world_opencv @ this`; its own inverse."""

_DEPTH = {
    "depth_unit_scale_factor": 1.0 / DEPTH_STEPS_PER_METRE,
    "depth_beyond_range_value": BEYOND_RANGE,
}
"""Meaning of the depth images of a run."""

_MAX_BYTES = 256 << 20
"""A frame takes a kilobyte."""

NAMES = ("transforms.json", "transforms_train.json")
"""nerfstudio's file, and that of NeRF's data sets, which are split."""

_DEPTH_PATHS = ("depth_file_path", "depth_path")
_DEPTH_SCALES = ("depth_unit_scale_factor", "integer_depth_scale")
"""Keys of nerfstudio, and of instant-ngp."""

_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
"""What may be missing from a name."""

_SIMPLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_MODELS = {
    **dict.fromkeys((*_SIMPLE, "PERSPECTIVE"), "OPENCV"),
    **dict.fromkeys(("OPENCV_FISHEYE", "FISHEYE"), "OPENCV_FISHEYE"),
    PANORAMA: PANORAMA,
    DUAL_FISHEYE: DUAL_FISHEYE,
}
"""Names of camera models, and which polynomial their k1, k2, ... belong to."""

_Fields = Mapping[str, Any]


def read_transforms(path: Path | str) -> PosedImages:
    """Reads a transforms.json. The images come in the order of the file.

    Intrinsics of a frame override those of the file. Without a principal point it is the image's
    center, without a size that of the image, or of another one where it is missing; names without a
    suffix get that of an image that exists.

    Args:
        path: the file, or the folder that holds one; of the data sets of NeRF, which are split,
            transforms_train.json is read.

    Raises:
        FormatError: the file is missing or damaged; a field is missing or of another type; a pose
            is not rigid; a camera is unknown; a path leads out of the folder. Images that are
            missing are noticed when they are read.
    """
    path = Path(path)
    path = find_transforms(path) or path
    if path.is_dir():
        path = path / NAMES[0]
    with naming(path):
        content = parse_json(read_bytes(path, _MAX_BYTES))
        if isinstance(content, list):
            raise ForeignFileError(
                "this is a list of poses as `ns-export cameras` writes it, in the coordinates of a "
                "training and without cameras: give the transforms.json of the data set"
            )
        check_fields("transforms", content, {"frames": list[dict[str, Any]]})
        frames: list[dict[str, Any]] = content["frames"]
        if not frames:
            raise ForeignFileError("it lists no frames")
        images = [_image(path.parent, i, frame) for i, frame in enumerate(frames)]
        images = _moved(path.parent, images)
        points = content.get("ply_file_path")
        check_type("ply_file_path", points, str | None)
        points_path = None if points is None else below(path.parent, points)
        moved, unit = _applied(content), _depth_unit(content)
        depths = [_depth(path.parent, i, frame) for i, frame in enumerate(frames)]
        masks = [_mask(path.parent, i, frame) for i, frame in enumerate(frames)]
        unmasked = _missing_masks(masks)
        masks = [None if mask is None or not os.path.isfile(mask) else mask for mask in masks]
        scale = _applied_scale(content)
    lenses = [
        _lens(path, f"frames[{i}]", {**content, **frame}, [image, *images])
        for i, (frame, image) in enumerate(zip(frames, images, strict=True))
    ]
    poses = np.stack([_pose(path, f"frames[{i}]", frame) for i, frame in enumerate(frames)])
    others = sorted(p.name for p in path.parent.glob("transforms_*.json") if p != path)
    remark = None
    if path.name in NAMES[1:] and others:
        remark = f"The views of {', '.join(others[:4])} are not among the images."
    if scale != 1.0:
        if any(depths):
            poses[:, :3, 3] /= scale
            moved = None if moved is None else moved / np.array([[scale]] * 3 + [[1.0]])
            points_path = None  # in the scaled coordinates, and depth says more
            remark = (
                f"The positions in transforms.json were scaled by {scale:g} (applied_scale): that "
                "is undone here, and lengths and suggested views are in the units of the depth."
            )
        else:
            remark = (
                f"The positions in transforms.json are scaled by {scale:g} (applied_scale), and "
                "so are all lengths here: without depth images that is not undone."
            )
    if unmasked is not None:
        remark = unmasked if remark is None else f"{unmasked} {remark}"
    return PosedImages(
        path=path,
        image_paths=tuple(images),
        lenses=tuple(lenses),
        poses=poses,
        depth_paths=tuple(depths),
        depth_unit=unit,
        points_path=points_path,
        T_capture_original=moved,
        remark=remark,
        mask_paths=tuple(masks) if any(masks) else None,
    )


def _mask(folder: Path, index: int, frame: dict[str, Any]) -> Path | None:
    """Returns the mask that a frame names, or one of its image's name in `masks`; else None."""
    name = frame.get("mask_path")
    check_type(f"frames[{index}].mask_path", name, str | None)
    if name is not None:
        return below(folder, name)
    image = Path(frame["file_path"])
    return find_mask(folder, str(image.relative_to(image.parts[0]) if image.parts[1:] else image))


def _missing_masks(masks: list[Path | None]) -> str | None:
    """Describes masks that the file names and that are not there."""
    gone = [mask for mask in masks if mask is not None and not os.path.isfile(mask)]
    if not gone:
        return None
    return f"{len(gone)} of {len(masks)} masks are missing ({gone[0]}): nothing is masked there."


def _moved(folder: Path, images: list[Path]) -> list[Path]:
    """Finds the images in another of the usual folders if all are missing where the file says."""
    if any(map(os.path.exists, images)) or len({image.name for image in images}) < len(images):
        return images
    for name in FOLDERS:
        others = [folder / name / image.name for image in images]
        if any(map(os.path.exists, others)):
            return others
    return images


def find_transforms(path: Path) -> Path | None:
    """Finds transforms.json in a folder, else the training views of a split data set."""
    found = (path / name for name in NAMES if path.is_dir())
    return next((file for file in found if file.exists()), None)


def _image(folder: Path, index: int, frame: _Fields) -> Path:
    check_fields(f"frames[{index}]", frame, {"file_path": str})
    path = below(folder, frame["file_path"])
    if path.suffix in _SUFFIXES or path.exists():
        return path
    found = [path.with_name(path.name + suffix) for suffix in _SUFFIXES]
    return next((candidate for candidate in found if candidate.exists()), path)


def _depth(folder: Path, index: int, frame: _Fields) -> Path | None:
    key = next((key for key in _DEPTH_PATHS if key in frame), _DEPTH_PATHS[0])
    name = frame.get(key)
    check_type(f"frames[{index}].{key}", name, str | None)
    return None if name is None else below(folder, name)


def _depth_unit(content: _Fields) -> DepthUnit:
    """Reads the unit from nerfstudio's or instant-ngp's key.

    Without a key, integers are millimeters and floats are meters.

    nerfstudio itself takes floats without a key for millimeters, but users store meters.
    """
    beyond = content.get("depth_beyond_range_value")
    check_type("depth_beyond_range_value", beyond, int | None)
    given = {key: content[key] for key in _DEPTH_SCALES if content.get(key) is not None}
    for key, scale in given.items():
        check_type(key, scale, float)
        if not 1e-12 < scale < 1e6:
            raise ForeignFileError(f"the {key} {scale:g} makes no sense")
    if not given:
        return DepthUnit(beyond_range=beyond)
    scales = [float(scale) for scale in given.values()]
    if max(scales) > 1.001 * min(scales):
        both = " and ".join(f"{key} {scale:g}" for key, scale in given.items())
        raise ForeignFileError(f"it has two units of depth, {both}: remove the wrong one")
    floats = scales[0] if _DEPTH_SCALES[0] in given else DepthUnit.metres_per_unit
    return DepthUnit(scales[0], beyond, metres_per_unit=floats)


def _applied(content: _Fields) -> np.ndarray | None:
    """Combines `applied_transform` and `applied_scale` in one 4x4 matrix."""
    rows = content.get("applied_transform")
    if rows is None and content.get("applied_scale") is None:
        return None
    move = np.eye(4) if rows is None else _matrix("applied_transform", rows)
    move[:3] *= _applied_scale(content)
    return move


def _applied_scale(content: _Fields) -> float:
    """Reads the factor of all positions; 1 if the file contains none."""
    scale = content.get("applied_scale")
    check_type("applied_scale", scale, float | None)
    if scale is None:
        return 1.0
    if not 1e-9 < scale < 1e9:
        raise ForeignFileError(f"invalid applied_scale {scale:g}")
    return float(scale)


def _matrix(name: str, rows: Any, size: int = 4) -> np.ndarray:
    """Reads a square matrix, whose last row may be left out."""
    check_type(name, rows, list[list[float]])
    if [len(row) for row in rows] not in ([size] * (size - 1), [size] * size):
        raise ForeignFileError(f"`{name}` must be a {size - 1}x{size} or a {size}x{size} matrix")
    matrix = np.eye(size)
    matrix[: len(rows)] = rows
    return matrix


def _pose(path: Path, which: str, frame: _Fields) -> np.ndarray:
    """Reads `T_world_camera` in OpenCV axes."""
    name = f"{which}.transform_matrix"
    with naming(path):
        check_fields(which, frame, {"transform_matrix": list[Any]})
        matrix = _matrix(name, frame["transform_matrix"])
    return mend_pose(path, name, matrix @ OPENGL_FROM_OPENCV)


def _lens(path: Path, which: str, fields: _Fields, images: Sequence[Path]) -> Lens:
    """Reads the camera of one frame; `images` begin with the frame's own."""
    with naming(path):
        try:
            width, height = _size(fields, images)
            return _lens_of(fields, width, height)
        except ForeignFileError as error:
            raise ForeignFileError(f"{which}: {error}") from None


def _size(fields: _Fields, images: Sequence[Path]) -> tuple[int, int]:
    if "w" in fields and "h" in fields:
        return _whole(fields, "w"), _whole(fields, "h")
    with naming(images[0]):
        try:
            return first_size(images, IMAGE_FORMATS)
        except FileNotFoundError:
            reason = "the file is missing, and its size is not in transforms.json (w, h)"
            raise ForeignFileError(reason) from None


def _whole(fields: _Fields, name: str) -> int:
    """Reads a size, which instant-ngp writes with a decimal point."""
    value = _value(fields, name)
    if value != int(value):
        raise ForeignFileError(f"`{name}` must be a whole number, got {value:g}")
    return int(value)


def _value(fields: _Fields, name: str, otherwise: float | None = None) -> float:
    value = fields.get(name, otherwise)
    check_type(name, value, float)
    return float(value)


def _lens_of(fields: _Fields, width: int, height: int) -> Lens:
    if fields.get("camera_model") == PANORAMA:
        return Lens(PANORAMA, width, height, (float(width), float(height)))
    if fields.get("camera_model") == DUAL_FISHEYE:
        return Lens(DUAL_FISHEYE, width, height, (_value(fields, "fov"),))
    if "K" in fields and "fl_x" not in fields:
        K = _matrix("K", fields["K"], size=3)
        fields = {**fields, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    fx, fy = _focal_lengths(fields, width, height)
    values = (fx, fy, _value(fields, "cx", 0.5 * width), _value(fields, "cy", 0.5 * height))
    name = fields.get("camera_model", "OPENCV")
    check_type("camera_model", name, str)
    if name not in _MODELS:
        raise ForeignFileError(
            f"the camera model {name[:40]!r} is not known, only {', '.join(_MODELS)}"
        )
    k1, k2, k3, k4, p1, p2 = (_value(fields, k, 0.0) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if _MODELS[name] == "OPENCV_FISHEYE" or fields.get("is_fisheye") is True:
        return Lens("OPENCV_FISHEYE", width, height, (*values, k1, k2, k3, k4))
    if k4:
        raise ForeignFileError(
            "k4 is a parameter of fisheye cameras, but the model is a perspective one"
        )
    if k3:
        return Lens("FULL_OPENCV", width, height, (*values, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    if k1 or k2 or p1 or p2:
        return Lens("OPENCV", width, height, (*values, k1, k2, p1, p2))
    return Lens("PINHOLE", width, height, values)


def _focal_lengths(fields: _Fields, width: int, height: int) -> tuple[float, float]:
    """Reads `fl_x` and `fl_y`, else computes both from the angles of view.

    If only one axis is given, it serves both.
    """
    sides = {"x": width, "y": height}
    found: list[float] = []
    for axis, side in sides.items():
        if f"fl_{axis}" in fields:
            found.append(_value(fields, f"fl_{axis}"))
        elif f"camera_angle_{axis}" in fields:
            angle = _value(fields, f"camera_angle_{axis}")
            if not 0.0 < angle < math.pi:
                raise ForeignFileError(f"camera_angle_{axis} must lie in (0, pi), got {angle:g}")
            found.append(0.5 * side / math.tan(0.5 * angle))
    if not found:
        raise ForeignFileError("there is no focal length (fl_x) and no camera_angle_x")
    return found[0], found[-1]


def transforms_of(run: Run, points: str | None = None) -> dict[str, Any]:
    """Builds the content of transforms.json.

    Args:
        run: a run with at least one view.
        points: path of a point cloud relative to the run folder, where there is one.
    """
    content = (
        {"camera_model": "OPENCV"}
        | _lens_fields(run)
        | _DEPTH
        | {"frames": [_frame_fields(run, row, run.path) for row in run.rows]}
    )
    return content if points is None else content | {"ply_file_path": points}


def write_transforms(run: Run, points: str | None = None) -> Path:
    """Writes transforms.json into the run folder.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    return _write(run.path, transforms_of(run, points))


def write_team_transforms(folder: Path, runs: Sequence[Run], points: str | None = None) -> Path:
    """Writes one transforms.json for runs in a folder; each frame has the lens that took it.

    Args:
        folder: that holds the run folders.
        runs: in it; of one world, with cameras that may differ.
        points: path of a point cloud relative to the folder, where there is one.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    frames = [
        _frame_fields(run, row, folder) | _lens_fields(run) for run in runs for row in run.rows
    ]
    content = {"camera_model": "OPENCV"} | _DEPTH | {"frames": frames}
    return _write(folder, content if points is None else content | {"ply_file_path": points})


def _lens_fields(run: Run) -> dict[str, Any]:
    camera = run.camera
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }


def _frame_fields(run: Run, row: StepRow, folder: Path) -> dict[str, Any]:
    return {
        "file_path": run.image_path(row.step).relative_to(folder).as_posix(),
        "depth_file_path": run.depth_path(row.step).relative_to(folder).as_posix(),
        "transform_matrix": (row.pose.astype(np.float64) @ OPENGL_FROM_OPENCV).tolist(),
    }


def _write(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "transforms.json"
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())
    return path


NAME = "dataparser_transforms.json"

_MAX_NORMALIZATION = 1 << 20
"""It takes a few hundred bytes."""


class Normalization(NamedTuple):
    """The transformation from original coordinates to those of a training."""

    T: np.ndarray
    """Rigid, [4, 4]."""

    scale: float
    """Applied after it."""

    def undone(self, poses: np.ndarray, T_capture_original: np.ndarray | None) -> np.ndarray:
        """Transforms poses back to a capture's own coordinates, [n, 4, 4].

        Args:
            poses: camera to the training's coordinates, [n, 4, 4].
            T_capture_original: takes original points to the capture's coordinates, a similarity
                [4, 4]; None: they are the same.
        """
        original = poses.copy()
        original[:, :3, 3] /= self.scale
        original = np.linalg.inv(self.T) @ original
        if T_capture_original is None:
            return original
        found = T_capture_original @ original
        found[:, :3, :3] /= np.cbrt(np.linalg.det(T_capture_original[:3, :3]))
        return found


def read_normalization(path: Path) -> Normalization:
    """Reads a dataparser_transforms.json.

    Raises:
        FormatError: missing or damaged, a transform that is not rigid, or a scale that is none.
    """
    with naming(path):
        content = parse_json(read_bytes(path, _MAX_NORMALIZATION))
        check_fields("dataparser", content, {"transform": list[list[float]], "scale": float})
        rows, scale = content["transform"], float(content["scale"])
        if [len(row) for row in rows] not in ([4] * 3, [4] * 4):
            raise ForeignFileError("`transform` must be a 3x4 or a 4x4 matrix")
        if not 1e-9 < scale < 1e9:
            raise ForeignFileError(f"the scale {scale:g} makes no sense")
    matrix = np.eye(4)
    matrix[: len(rows)] = rows
    return Normalization(mend_pose(path, "the transform", matrix), scale)
