"""A folder with a COLMAP model as posed images."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from r3jax.formats.colmap.binary import read_binary
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, ColmapPoints, pose_of
from r3jax.formats.colmap.text import read_text
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import PosedImages, SparsePoints, find_images
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import below, check_relative

_MODEL_FOLDERS = (
    *(".", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap"),
    *("colmap_sparse/0", "colmap_text"),
)
"""Where COLMAP, its users, nerfstudio and instant-ngp put the model of a capture."""

_MAX_EXTRA = 1.0
_FOCAL_RATIOS = (0.1, 10.0)
_SERIES = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""COLMAP's mapper calls a lens bogus whose distortion, or whose focal length by its longer side,
lies beyond; a model can still end with one when the last adjustment moves it. Terms of fisheyes
and of fractions (FULL_OPENCV) may be larger."""


def find_model(path: Path) -> Path | None:
    """Finds the folder of the model in a capture's folder; None if there is none."""
    for name in _MODEL_FOLDERS:
        folder = path / name
        if any((folder / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Reads a model and checks that its parts fit together. Binary goes first, as in COLMAP.

    Raises:
        FormatError: says which file is wrong and why.
    """
    if (folder / "cameras.bin").exists():
        model, suffix = read_binary(folder), ".bin"
    else:
        model, suffix = read_text(folder), ".txt"
    try:
        _check_images(model)
    except ForeignFileError as error:
        raise FormatError(folder / f"images{suffix}", str(error)) from None
    try:
        _check_points(model.points)
    except ForeignFileError as error:
        raise FormatError(folder / f"points3D{suffix}", str(error)) from None
    return model


def read_colmap(path: Path | str, images: Path | str | None = None) -> PosedImages:
    """Reads a capture that COLMAP has posed. Its images come in the order of their names.

    Args:
        path: the folder of the model, or the capture's, with the model in `sparse/0` or the like;
            if there are several, `sparse/1` and so on, the one with most images is taken.
        images: the folder that the images' names are relative to; by default the one of the usual
            names, beside the model or in one of the three folders above it, that holds most.

    Raises:
        FormatError: there is no model, or a file of it is damaged. Images that are missing are
            noticed when they are read.
    """
    path = Path(path)
    folder, models = _models(path)
    model = models[folder]
    ordered = sorted(model.images, key=lambda image: image.name)
    lenses = tuple(model.cameras[image.camera_id] for image in ordered)
    here = folder.resolve()
    names = dict(zip((image.name for image in ordered), lenses, strict=True))
    found = images or find_images([path, here, *here.parents[:3]], names) or path / "images"
    image_paths = tuple(below(Path(found), image.name) for image in ordered)
    return PosedImages(
        path=path,
        image_paths=image_paths,
        lenses=lenses,
        poses=np.stack([pose_of(image.quaternion, image.translation) for image in ordered]),
        depth_paths=(None,) * len(ordered),
        points=_sparse_points(model.points, {image.id: i for i, image in enumerate(ordered)}),
        remark=_left_out(folder, models, image_paths),
    )


def main_model(path: Path) -> tuple[Path, ColmapModel] | None:
    """Returns the model of a capture that `read_colmap` takes, and its folder; None without one.

    Raises:
        FormatError: as `read_model`.
    """
    if find_model(path) is None:
        return None
    folder, models = _models(path)
    return folder, models[folder]


def _models(path: Path) -> tuple[Path, dict[Path, ColmapModel]]:
    """Returns all models of a capture, and the folder of the one with most images."""
    folder = find_model(path)
    if folder is None:
        what = "the folder holds no COLMAP model (no cameras.bin or cameras.txt)"
        raise FormatError(path, what if path.is_dir() else "there is no such folder")
    models = {part: read_model(part) for part in _parts(path, folder)}
    return max(models, key=lambda part: len(models[part].images)), models


def _parts(path: Path, folder: Path) -> list[Path]:
    """Finds all numbered models of a capture.

    A part without its images is left out where another one is whole: some keep only a piece of it.
    """
    if not folder.name.isdecimal() or folder.resolve() == path.resolve():
        return [folder]
    parts = _numbered(folder)
    return [part for part in parts if _has_images(part)] or parts


def _numbered(folder: Path) -> list[Path]:
    """Lists the model and those of other numbers beside it."""
    found = [part for part in folder.parent.iterdir() if part.name.isdecimal()]
    return sorted((p for p in found if find_model(p) == p), key=lambda p: int(p.name))


def _has_images(folder: Path) -> bool:
    return any((folder / f"images{suffix}").exists() for suffix in (".bin", ".txt"))


def _left_out(
    folder: Path, models: Mapping[Path, ColmapModel], image_paths: tuple[Path, ...]
) -> str | None:
    """Describes the other models, and the images without a pose in this one."""
    posed = set(image_paths)
    suffixes = {path.suffix for path in posed}
    beside = {file for place in {path.parent for path in posed} for file in _files(place)}
    num_unposed = sum(file.suffix in suffixes for file in beside - posed)
    number = len(posed)
    said = [f"{number} of {number + num_unposed} pictures have a pose"] if num_unposed else []
    if len(models) > 1:
        others = [str(len(models[part].images)) for part in models if part != folder]
        said.append(
            f"COLMAP did not join all: of its {len(models)} models {folder.parent.name}/"
            f"{folder.name} is used, with {number} pictures; the other "
            f"{'has' if len(others) == 1 else 'ones have'} {', '.join(others)}"
        )
    broken = [part.name for part in _numbered(folder) if not _has_images(part)]
    if broken:
        names = ", ".join(f"{folder.parent.name}/{name}" for name in broken)
        said.append(f"the model in {names} has no images.bin and is left out")
    said += _odd_lenses(models[folder])
    text = "; ".join(said)
    return f"{text[0].upper()}{text[1:]}." if text else None


def _odd_lenses(model: ColmapModel) -> list[str]:
    """Names an implausible lens: poses and points that were fitted with it are wrong, too."""
    odd = [
        f"camera {number} (focal length {max(lens.intrinsics[:2]):.0f} px, distortion "
        f"{max(map(abs, lens.distortion.values()), default=0.0):.3g})"
        for number, lens in sorted(model.cameras.items())
        if not _is_plausible(lens)
    ]
    if not odd:
        return []
    return [
        f"{odd[0]} is no real lens, so poses and points are likely wrong: reconstruct again with "
        "known intrinsics (--ImageReader.camera_params) or more overlap"
    ]


def _is_plausible(lens: Lens) -> bool:
    low, high = _FOCAL_RATIOS
    focals, side = lens.intrinsics[:2], max(lens.width, lens.height)
    is_bent = any(abs(value) > _MAX_EXTRA for value in lens.distortion.values())
    if is_bent and lens.model in _SERIES:
        return False
    return all(low < focal / side < high for focal in focals)


def _files(folder: Path) -> list[Path]:
    # os.path: a name of a foreign file may be longer than a folder's can be.
    if not os.path.isdir(folder):
        return []
    return [entry for entry in folder.iterdir() if entry.is_file()]


def _check_images(model: ColmapModel) -> None:
    if not model.images:
        raise ForeignFileError("the model holds no images")
    ids: set[int] = set()
    names: set[str] = set()
    for image in model.images:
        check_relative(image.name)
        if image.id in ids or image.name in names:
            raise ForeignFileError(f"the image {image.id} ({image.name[:80]!r}) occurs twice")
        ids.add(image.id)
        names.add(image.name)
        _check_image(image, model.cameras)


def _check_image(image: ColmapImage, cameras: Mapping[int, Lens]) -> None:
    which = f"image {image.id} ({image.name[:80]!r})"
    if image.camera_id not in cameras:
        raise ForeignFileError(f"{which}: there is no camera {image.camera_id}")
    if not np.all(np.isfinite(image.keypoints)):
        raise ForeignFileError(f"{which}: keypoints that are not finite")
    try:
        pose_of(image.quaternion, image.translation)
    except ForeignFileError as error:
        raise ForeignFileError(f"{which}: {error}") from None


def _check_points(points: ColmapPoints) -> None:
    if not np.all(np.isfinite(points.xyz)):
        bad = points.ids[np.argmin(np.isfinite(points.xyz).all(axis=1))]
        raise ForeignFileError(f"the position of point {bad} is not finite")
    if len(np.unique(points.ids)) != len(points.ids):
        raise ForeignFileError("a point occurs twice")


def _sparse_points(points: ColmapPoints, index: Mapping[int, int]) -> SparsePoints:
    """Points by index instead of by id. What a track says of images that are gone is left out."""
    seen_point = np.repeat(np.arange(len(points)), points.track_lengths)
    known = np.array(sorted(index), np.int64)
    at = np.minimum(np.searchsorted(known, points.track_images), len(known) - 1)
    there = known[at] == points.track_images
    indices = np.array([index[number] for number in known.tolist()], np.int64)
    return SparsePoints(points.xyz, points.rgb, seen_point[there], indices[at[there]])
