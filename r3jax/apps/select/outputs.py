"""Writes the reduced capture as a data set for other programs, and `selection.json`.

The format of a transforms.json or a COLMAP model is preserved, with fewer frames. A transforms.json
keeps all other keys. A COLMAP model keeps the cameras, keypoints and points of the kept frames and
the remaining parts of their tracks, in the form (binary or text) in which it was read. For every
other format a transforms.json is written, with depth in millimeters and the voxels as points.
Pictures are links to the originals, or copies; the capture itself is never modified.
"""

import dataclasses
import glob
import io
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from r3jax.apps.select.select import Selected
from r3jax.files import make_folder, place_link, remove_own, write_atomic
from r3jax.formats.captures import Capture
from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.model import NO_POINT, ColmapImage, ColmapModel, ColmapPoints
from r3jax.formats.colmap.reader import main_model
from r3jax.formats.colmap.text import write_text
from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV, find_transforms
from r3jax.formats.points import voxel_points, write_points
from r3jax.formats.posed_images import COPIES, PosedImages
from r3jax.plots.pictures import png
from r3jax.runs.reader import Run
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import below, read_bytes
from r3jax.validation.json_text import parse_json

RECORD = "selection.json"

_MAX_BYTES = 256 << 20
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
"""Lists of a transforms.json that name frames."""

_PATHS = ("depth_file_path", "depth_path", "mask_path")
"""Files of a frame beside its picture."""

_LARGEST_DEPTH = 65.0
"""Largest depth in millimeters that fits into 16 bits [m]."""


@dataclasses.dataclass(frozen=True)
class Written:
    """Paths of the written files."""

    data_set: Path
    """The transforms.json, or the folder of the COLMAP model."""

    record: Path
    """selection.json."""


def write_data_set(
    found: Selected,
    capture: Capture,
    folder: Path,
    *,
    copies: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> Written:
    """Writes the reduced capture; an earlier selection in the folder is replaced.

    Args:
        found: the selection.
        capture: the opened capture.
        folder: output folder, made by r3jax.
        copies: copy the pictures instead of linking them.
        on_frame: called after each frame.

    Raises:
        FormatError, RunError: a picture is missing or broken.
        OSError: for example, the disk is full or not writable.
    """
    files = _Files(folder, copies)
    _clear(folder)
    source, kept = capture.source, found.kept
    # Views cut from 360 photos are in no file of the capture: they are written.
    original = source if isinstance(source, PosedImages) and source.photo_of is None else None
    if original and (transforms := _transforms_of(original.path)) is not None:
        data_set = _reduce_transforms(transforms, original, kept, files, on_frame)
    elif original and (found_model := _model_of(original)) is not None:
        data_set = _reduce_model(*found_model, original, kept, files, on_frame)
    else:
        data_set = _write_transforms(found, source, kept, files, on_frame)
    record = folder / RECORD
    content = {**record_of(found), "capture_path": str(capture.path.resolve())}
    content["files"] = [*files.written, "selection.html"]
    write_atomic(record, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    return Written(data_set, record)


def _clear(folder: Path) -> None:
    """Deletes the files that an earlier selection has written, and no others."""
    try:
        names = parse_json(read_bytes(folder / RECORD, _MAX_BYTES))["files"]
        patterns = [glob.escape(str(name)) for name in names]
    except (OSError, ForeignFileError, KeyError, TypeError):
        return
    remove_own(folder, [*patterns, RECORD])


class _Files:
    """Files of the data set, recorded as they are written."""

    def __init__(self, folder: Path, copies: bool):
        self.folder, self._copies = folder, copies
        self.written: list[str] = []

    def path(self, name: str) -> Path:
        """Returns the path of a file to write, and makes its folder."""
        path = below(self.folder, name)
        make_folder(path.parent)
        if name not in self.written:
            self.written.append(name)
        return path

    def write(self, name: str, data: bytes) -> None:
        write_atomic(self.path(name), data)

    def take(self, name: str, original: Path) -> None:
        """Links or copies a file of the capture; a missing file is skipped."""
        if not original.is_file():
            return
        if self._copies or not place_link(self.path(name), original.resolve()):
            self.write(name, original.read_bytes())


def _transforms_of(path: Path) -> Path | None:
    return path if path.suffix == ".json" else find_transforms(path)


def _reduce_transforms(
    path: Path,
    source: PosedImages,
    kept: np.ndarray,
    files: _Files,
    on_frame: Callable[[], None],
) -> Path:
    """Writes the file with fewer frames, and links the files that they name."""
    content = parse_json(read_bytes(path, _MAX_BYTES))
    frames: list[dict[str, Any]] = [content["frames"][i] for i in kept.tolist()]
    for index, frame in zip(kept.tolist(), frames, strict=True):
        original = source.image_paths[index]
        files.take(_relative(original, path.parent), original)
        for key in _PATHS:
            if isinstance(name := frame.get(key), str):
                files.take(name, below(path.parent, name))
        _take_mask(source, index, path.parent, files)
        on_frame()
    if isinstance(points := content.get("ply_file_path"), str):
        files.take(points, below(path.parent, points))
    names = {frame["file_path"] for frame in frames}
    splits = {
        key: [name for name in content[key] if name in names]
        for key in _SPLITS
        if isinstance(content.get(key), list)
    }
    for other in sorted(path.parent.glob("transforms_*.json")):
        if other != path:  # views that NeRF's data sets hold out for tests
            _take_split(other, files)
    if not all(splits.values()):  # nerfstudio refuses a list without frames, and missing ones
        content = {key: value for key, value in content.items() if key not in _SPLITS}
        splits = {}
    reduced = {**content, **splits, "frames": frames}
    files.write(path.name, (json.dumps(reduced, indent=1) + "\n").encode())
    return files.folder / path.name


def _take_split(path: Path, files: _Files) -> None:
    files.take(path.name, path)
    frames = parse_json(read_bytes(path, _MAX_BYTES)).get("frames", [])
    for frame in frames:
        name = below(path.parent, frame["file_path"])
        for candidate in (name, name.with_name(f"{name.name}.png")):
            files.take(_relative(candidate, path.parent), candidate)


def _take_mask(source: PosedImages, index: int, folder: Path, files: _Files) -> None:
    """Links the mask of an image, which lies in `folder` even if no file names it."""
    mask = None if source.mask_paths is None else source.mask_paths[index]
    if mask is not None:
        files.take(_relative(mask, folder), mask)


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _model_of(source: PosedImages) -> tuple[Path, ColmapModel] | None:
    return main_model(source.path) if source.path.is_dir() else None


def _reduce_model(
    model_folder: Path,
    model: ColmapModel,
    source: PosedImages,
    kept: np.ndarray,
    files: _Files,
    on_frame: Callable[[], None],
) -> Path:
    """Writes the model of fewer images, and links them and their smaller copies."""
    ordered = sorted(model.images, key=lambda image: image.name)
    chosen = [ordered[i] for i in kept.tolist()]
    for index, image in zip(kept.tolist(), chosen, strict=True):
        original = source.image_paths[index]
        root = original.parents[len(Path(image.name).parts) - 1]
        plain = root.name
        for copy in COPIES:
            plain = plain.removesuffix(copy)
        files.take(f"images/{image.name}", root.with_name(plain) / image.name)
        if plain == root.name:
            files.take(f"images/{image.name}", original)
        for copy in COPIES:
            files.take(f"images{copy}/{image.name}", root.with_name(plain + copy) / image.name)
        _take_mask(source, index, root.parent, files)
        on_frame()
    is_binary = (model_folder / "cameras.bin").exists()
    for name in ("cameras", "images", "points3D"):
        files.path(f"sparse/0/{name}{'.bin' if is_binary else '.txt'}")
    folder = files.folder / "sparse" / "0"
    (write_binary if is_binary else write_text)(folder, reduced_model(model, chosen))
    return folder


def reduced_model(model: ColmapModel, chosen: Iterable[ColmapImage]) -> ColmapModel:
    """Returns the model of some of its images: their cameras, and the points that they still see.

    A model whose points have no tracks keeps all points. Ids stay.

    Args:
        model: as it was read.
        chosen: images of it.
    """
    images = sorted(chosen, key=lambda image: image.id)
    ids = np.array([image.id for image in images], np.int64)
    points = model.points
    owner = np.repeat(np.arange(len(points)), points.track_lengths)
    stays = np.isin(points.track_images, ids)
    lengths = np.bincount(owner[stays], minlength=len(points))
    is_left = lengths > 0 if len(points.track_images) else np.ones(len(points), dtype=bool)
    known = points.ids[is_left]

    def seen(image: ColmapImage) -> ColmapImage:
        there = np.isin(image.point_ids, known)
        return dataclasses.replace(image, point_ids=np.where(there, image.point_ids, NO_POINT))

    return ColmapModel(
        {number: model.cameras[number] for number in {image.camera_id for image in images}},
        tuple(seen(image) for image in images),
        ColmapPoints(
            known, points.xyz[is_left], points.rgb[is_left], points.error[is_left],
            lengths[is_left], points.track_images[stays], points.track_keypoints[stays],
        ),
    )  # fmt: skip


def _write_transforms(
    found: Selected,
    source: Run | PosedImages,
    kept: np.ndarray,
    files: _Files,
    on_frame: Callable[[], None],
) -> Path:
    """Writes a transforms.json of a capture that comes without one."""
    frames: list[dict[str, Any]] = []
    # nerfstudio takes depth of all frames or of none.
    has_depth = isinstance(source, Run) or any(path is not None for path in source.depth_paths)
    for index in kept.tolist():
        lens, pose = found.source.lenses[index], found.source.poses[index]
        name = _image_name(source, index)
        frame = {"file_path": f"images/{name}", **_lens_fields(lens)}
        _take_image(source, index, frame["file_path"], files)
        if isinstance(source, PosedImages) and source.photo_of is not None:
            # nerfstudio takes masks of all frames or of none.
            frame["mask_path"] = f"masks/{Path(name).stem}.png"
            files.write(frame["mask_path"], _mask_png(source.masked_rgb(index)[1], lens))
        if has_depth:
            depth = _depth(source, index)
            depth = np.zeros((lens.height, lens.width)) if depth is None else depth
            frame["depth_file_path"] = f"depth/{Path(name).stem}.png"
            files.write(frame["depth_file_path"], _depth_png(depth))
        frame["transform_matrix"] = (pose @ OPENGL_FROM_OPENCV).tolist()
        frames.append(frame)
        on_frame()
    content: dict[str, Any] = {"depth_unit_scale_factor": 0.001, "frames": frames}
    # nerfstudio expects the camera model at the top level, not in the frames.
    if len(models := {frame["camera_model"] for frame in frames}) == 1:
        content["camera_model"] = models.pop()
    points, colors = voxel_points(found.whole)
    if found.source.has_images:
        back = found.survey.alignment.points_back(points).astype(np.float32)
        write_points(files.path("points.ply"), back, colors)
        content["ply_file_path"] = "points.ply"
    files.write("transforms.json", (json.dumps(content, indent=1) + "\n").encode())
    return files.folder / "transforms.json"


def _image_name(source: Run | PosedImages, index: int) -> str:
    if isinstance(source, Run):
        return source.image_path(source.rows[index].step).name
    name = source.image_paths[index].name
    return name if source.pixels is None else f"{index:05d}_{Path(name).stem}.png"


def _take_image(source: Run | PosedImages, index: int, name: str, files: _Files) -> None:
    if isinstance(source, Run):
        files.take(name, source.image_path(source.rows[index].step))
    elif source.pixels is None:
        files.take(name, source.image_paths[index])
    else:
        files.write(name, png(source.rgb(index)))


def _depth(source: Run | PosedImages, index: int) -> np.ndarray | None:
    if isinstance(source, Run):
        return np.asarray(source.frame(source.rows[index].step).depth)
    return source.depth(index)


def _mask_png(mask: np.ndarray | None, lens: Lens) -> bytes:
    """Encodes a mask as PNG: white where the pixels of an image count."""
    gray = np.full((lens.height, lens.width), 255, np.uint8)
    if mask is not None:
        gray[~mask] = 0
    buffer = io.BytesIO()
    Image.fromarray(gray).save(buffer, format="png")
    return buffer.getvalue()


def _depth_png(depth: np.ndarray) -> bytes:
    """Encodes depth in millimeters as PNG; 0 where none is known."""
    known = np.where(np.isfinite(depth) & (depth < _LARGEST_DEPTH), depth, 0.0)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(1000.0 * known).astype(np.uint16)).save(buffer, format="png")
    return buffer.getvalue()


def _lens_fields(lens: Lens) -> dict[str, Any]:
    """Describes a camera by nerfstudio's fields."""
    fx, fy, cx, cy = lens.intrinsics
    pinhole = pinhole_lens(lens.camera)
    is_fisheye = "FISHEYE" in lens.model
    fields = {"camera_model": "OPENCV_FISHEYE" if is_fisheye else "OPENCV", "w": pinhole.width,
              "h": pinhole.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}  # fmt: skip
    named = {"k1": lens.named.get("k", 0.0), **lens.distortion}
    return fields | {k: named[k] for k in ("k1", "k2", "k3", "k4", "p1", "p2") if k in named}


def record_of(found: Selected) -> dict[str, Any]:
    """Returns the numbers of selection.json."""
    source, choice, used = found.source, found.choice, found.used
    names = _unique(source.labels)
    labels = lambda numbers: [names[int(i)] for i in numbers]
    return {
        "format": 1,
        "capture": source.name,
        "surfaces_from": source.kind,
        "frames": len(source),
        "kept": labels(found.kept),
        "order": labels(used[choice.order]),
        "gain": choice.gain.tolist(),
        "renderability": choice.renderability.tolist(),
        "renderability_of_all": float(choice.of_all.mean()),
        "targets": found.settings.targets,
        "num_targets": found.targets,
        "is_complete": choice.is_complete,
        "scenes": int(found.scenes.max()) + 1,
        "dropped": {names[index]: why for index, why in sorted(found.reasons.items())},
        "blur_px": {
            names[int(index)]: round(float(found.quality.blur[i]), 2)
            for i, index in enumerate(used)
            if found.quality.is_compared[i]
        },
        "notes": list(found.notes),
        "voxel_size": found.survey.length(found.survey.voxel_size),
    }


def _unique(labels: Sequence[str]) -> list[str]:
    """Labels frames, with their numbers where pictures of folders share names."""
    if len(set(labels)) == len(labels):
        return list(labels)
    return [f"{number:05d} {label}" for number, label in enumerate(labels)]
