"""Exports a run as a self-contained folder for other trainers: images, poses, points.

    nerfstudio     images/ depth/ points.ply transforms.json
    colmap         images/ depth/ points.ply sparse/0/{cameras,images,points3D}.bin
    colmap-text    the same with .txt

Poses are those of the run: meters, z up, neither rotated, centered nor scaled. Depth images are
copies: uint16 in steps of 0.2 mm. COLMAP has no place for depth; it lies beside the images.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from r3jax.files import check_vacant, make_folder, whole_folder, write_atomic
from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.model import (
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    colmap_pose,
    points_without_tracks,
)
from r3jax.formats.colmap.text import write_text
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.formats.nerfstudio import transforms_of, write_transforms
from r3jax.formats.points import voxel_points, write_points
from r3jax.mapping.state import MapState
from r3jax.runs.reader import Run

Format = Literal["nerfstudio", "colmap", "colmap-text"]

_POINTS = "points.ply"


def export_run(
    run: Run, out: Path, kind: Format, on_view: Callable[[], None] = lambda: None
) -> int:
    """Writes the folder, either completely or not at all.

    Args:
        run: a run with at least one view.
        out: a folder that does not exist yet, or is empty.
        kind: what to write.
        on_view: called after every view that is copied.

    Returns:
        The number of points: centers of the map's voxels; 0 where the run has no stored map.

    Raises:
        FormatError: the run has no views, or `out` is no name of a folder.
        RunError: the stored map or an image cannot be read, or is not what was recorded.
        OSError: `out` holds something; the disk is full, not writable, ...
    """
    if not run.rows:
        raise FormatError(run.path, "the run has no views yet")
    if "\0" in str(out):
        raise FormatError(Path(repr(out.name)), "this cannot be the name of a folder")
    check_vacant(out)
    xyz, rgb = _map_points(run)
    with whole_folder(out) as partial:
        _fill(partial, run, kind, (xyz, rgb), on_view)
    return len(xyz)


def write_data_set(run: Run, map_state: MapState) -> None:
    """Writes transforms.json and the points that 3DGS starts from into the run's own folder.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    points = run.path / "exports" / _POINTS
    make_folder(points.parent)
    write_points(points, *voxel_points(map_state))
    write_transforms(run, points.relative_to(run.path).as_posix())


def _map_points(run: Run) -> tuple[np.ndarray, np.ndarray]:
    if not run.checkpoint_steps():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    return voxel_points(run.checkpoint()[1])


def _fill(
    out: Path,
    run: Run,
    kind: Format,
    points: tuple[np.ndarray, np.ndarray],
    on_view: Callable[[], None],
) -> None:
    xyz, rgb = points
    for name in ("images", "depth"):
        make_folder(out / name)
    for row in run.rows:
        run.images(row.step)  # says what is wrong with them
        image = run.image_path(row.step)
        write_atomic(out / "images" / image.name, image.read_bytes())
        write_atomic(out / "depth" / image.name, run.depth_path(row.step).read_bytes())
        on_view()
    if len(xyz):
        write_points(out / _POINTS, xyz, rgb)
    if kind == "nerfstudio":
        _write_transforms(out, run, _POINTS if len(xyz) else None)
        return
    model = model_of(run, xyz, rgb)
    folder = out / "sparse" / "0"
    make_folder(folder)
    (write_binary if kind == "colmap" else write_text)(folder, model)


def _write_transforms(out: Path, run: Run, points: str | None) -> None:
    content = transforms_of(run, points)
    for frame, row in zip(content["frames"], run.rows, strict=True):
        name = run.image_path(row.step).name
        frame |= {"file_path": f"images/{name}", "depth_file_path": f"depth/{name}"}
    write_atomic(out / "transforms.json", (json.dumps(content, indent=1) + "\n").encode())


def posed_model(
    lens: Lens, names: Sequence[str], poses: np.ndarray, points: ColmapPoints
) -> ColmapModel:
    """Makes a model of images from one camera, without keypoints, numbered from 1.

    Args:
        lens: the camera of all images.
        names: n paths of the images, relative to the folder of the images.
        poses: `T_world_camera`, [n, 4, 4].
        points: the points.
    """
    images: list[ColmapImage] = []
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        quaternion, translation = colmap_pose(pose)
        none = np.zeros((0, 2))
        images.append(
            ColmapImage(number, name, 1, quaternion, translation, none, np.zeros(0, np.int64))
        )
    return ColmapModel({1: lens}, tuple(images), points)


def model_of(run: Run, xyz: np.ndarray, rgb: np.ndarray) -> ColmapModel:
    """Makes the model of a run.

    It has the run's views and its one camera; its points have no tracks.

    Args:
        run: a run.
        xyz: points in the world, such as the map's voxels, [m, 3] [m].
        rgb: their colors, [m, 3] uint8.
    """
    names = [run.image_path(row.step).name for row in run.rows]
    poses = np.stack([row.pose for row in run.rows]).astype(np.float64)
    return posed_model(pinhole_lens(run.camera), names, poses, points_without_tracks(xyz, rgb))
