"""A folder with a COLMAP model as posed images, and quality measures of the reconstruction.

Shape symbols: m points; t track elements; n images.
"""

import itertools
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from r3jax.formats.colmap.binary import read_binary
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, ColmapPoints, pose_of
from r3jax.formats.colmap.text import read_text
from r3jax.formats.errors import FormatError
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import (
    IMAGE_FORMATS,
    PosedImages,
    Reconstruction,
    SparsePoints,
    find_images,
    find_mask,
)
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import below, check_relative
from r3jax.validation.images import small_gray

_MODEL_FOLDERS = (
    *(".", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap"),
    *("colmap_sparse/0", "colmap_text", "distorted/sparse/0", "distorted/sparse"),
    *("dense/sparse", "dense/0/sparse"),
)
"""Where COLMAP, its users, nerfstudio, instant-ngp and INRIA's converter put the model of a
capture."""

_NUMBERED = ("sparse", "colmap/sparse", "colmap_sparse", "distorted/sparse", ".")
"""Where models are numbered; the first of them may be missing."""

_MERGEABLE = 3
"""Minimum number of pictures in common for COLMAP to merge two models."""

_DENSE = (".", "dense", "dense/0")
"""Where COLMAP's undistorter puts images, their model and the depth of its stereo."""

_STEREO = ("geometric", "photometric")
"""Geometrically consistent depth is preferred."""

_MAX_EXTRA = 1.0
_FOCAL_RATIOS = (0.1, 10.0)
_SQUARE = 1.25
"""Pixels are square: no lens has focal lengths along x and y that differ by more than this."""
_FAILED = 0.5
"""Reconstructions with a smaller share of posed pictures are reported first."""
_MOST_NAMED = 5
"""Maximum number of pictures without a model to name."""
_SERIES = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""COLMAP's mapper calls a lens bogus whose distortion, or whose focal length by its longer side,
lies beyond; a model can still end with one when the last adjustment moves it. Terms of fisheyes
and of fractions (FULL_OPENCV) may be larger."""


def find_model(path: Path) -> Path | None:
    """Finds the folder of the model in a capture's folder; None if there is none."""
    for name in _MODEL_FOLDERS:
        folder = path / name
        if _holds_model(folder):
            return folder
    for name in _NUMBERED:
        if os.path.isdir(path / name):
            found = _numbered(path / name / "0")
            if found:
                return found[0]
    return None


def _holds_model(folder: Path) -> bool:
    return any((folder / f"cameras{suffix}").exists() for suffix in (".bin", ".txt"))


def find_stereo(path: Path) -> Path | None:
    """Finds an undistorted capture with depth of COLMAP's stereo in a folder; None: none."""
    for folder in (path / name for name in _DENSE):
        depths = folder / "stereo" / "depth_maps"
        endings = tuple(f".{kind}.bin" for kind in _STEREO)
        if _holds_model(folder / "sparse") and any(
            depth.name.endswith(endings) for depth in depths.rglob("*.bin")
        ):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Reads a model and checks its consistency. Binary files are preferred, as in COLMAP.

    Raises:
        FormatError: says which file is wrong and why.
    """
    suffix = ".bin" if (folder / "cameras.bin").exists() else ".txt"
    for name in (f"images{suffix}", f"points3D{suffix}"):
        if not (folder / name).exists():
            raise FormatError(
                folder / name,
                "the file is missing: copy the whole model, which is cameras, images and points3D",
            )
    model = read_binary(folder) if suffix == ".bin" else read_text(folder)
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
    """Reads a capture with poses from COLMAP. Images are in the order of their names.

    Args:
        path: the folder of the model, or the capture's, with the model in `sparse/0` or the like;
            if there are several, `sparse/1` and so on, the one with most images is taken. Where
            COLMAP's stereo has left depth (`dense/stereo/depth_maps`), its undistorted images with
            that depth; where only undistorted images are there, these.
        images: the folder that the images' names are relative to; by default the one of the usual
            names, beside the model or in one of the three folders above it, that holds most.

    Raises:
        FormatError: there is no model, or a file of it is damaged. Missing images are reported when
            they are read.
    """
    path = Path(path)
    dense = find_stereo(path)
    folder, models = _models(path)
    model = models[folder]
    ordered = sorted(model.images, key=lambda image: image.name)
    lenses = tuple(model.cameras[image.camera_id] for image in ordered)
    here = folder.resolve()
    names = dict(zip((image.name for image in ordered), lenses, strict=True))
    places = [path, here, *here.parents[:3]] if dense is None else [dense, path]
    found = images or find_images(places, names)
    if found is None and (undistorted := _undistorted(path)) is not None:
        return read_colmap(undistorted)  # the photos themselves were not kept
    found = found or path / "images"
    image_paths = tuple(below(Path(found), image.name) for image in ordered)
    depths = [_stereo_depth(dense, image.name) for image in ordered]
    masks = [find_mask(Path(found).parent, image.name) for image in ordered]
    unposed = _unposed(set(image_paths))
    return PosedImages(
        path=path,
        image_paths=image_paths,
        lenses=lenses,
        poses=np.stack([pose_of(image.quaternion, image.translation) for image in ordered]),
        depth_paths=tuple(depths),
        points=_sparse_points(model.points, {image.id: i for i, image in enumerate(ordered)}),
        remark=_left_out(folder, models, _larger(path, folder, model), unposed, Path(found)),
        mask_paths=tuple(masks) if any(masks) else None,
        is_stereo=any(depth is not None for depth in depths),
        reconstruction=reconstruction_of(model, len(unposed)),
    )


def _undistorted(path: Path) -> Path | None:
    """Finds what COLMAP's undistorter has written into a capture: images and their model."""
    places = (path / name for name in _DENSE if name != ".")
    is_one = lambda place: _holds_model(place / "sparse") and (place / "images").is_dir()
    return next(filter(is_one, places), None)


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
    dense = find_stereo(path)
    folder = find_model(path) if dense is None else dense / "sparse"
    if folder is None:
        what = "the folder contains no COLMAP model (no cameras.bin or cameras.txt)"
        raise FormatError(path, what if path.is_dir() else "there is no such folder")
    parts = _parts(path, folder) if dense is None else [folder]
    models = {part: read_model(part) for part in parts}
    return max(models, key=lambda part: len(models[part].images)), models


def _stereo_depth(dense: Path | None, name: str) -> Path | None:
    if dense is None:
        return None
    depths = dense / "stereo" / "depth_maps"
    found = (below(depths, f"{name}.{kind}.bin") for kind in _STEREO)
    return next((path for path in found if path.is_file()), None)


def _unposed(posed: set[Path]) -> list[Path]:
    """Lists pictures beside those of a model, in the order of their names.

    COLMAP's undistorter writes only the pictures with a pose; gaussian-splatting keeps all of them
    in input/.
    """
    suffixes = {path.suffix for path in posed}
    places = {path.parent for path in posed}
    beside = {file for place in places for file in _files(place)} - posed
    for place in places:
        if place.name == "images":
            taken = {file.name for file in posed | beside if file.parent == place}
            beside |= {f for f in _files(place.with_name("input")) if f.name not in taken}
    return sorted(file for file in beside if file.suffix in suffixes)


def _parts(path: Path, folder: Path) -> list[Path]:
    """Lists the models, one for every part of a capture that COLMAP could not join.

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


def _larger(path: Path, folder: Path, model: ColmapModel) -> dict[Path, ColmapModel]:
    """Reads the models that gaussian-splatting left in distorted/ and that have more pictures.

    Its converter undistorts only the first one, whatever the mapper has put there.
    """
    first = path / "distorted" / "sparse" / "0"
    if not os.path.isdir(first.parent) or first.parent.resolve() in folder.resolve().parents:
        return {}
    found: dict[Path, ColmapModel] = {}
    for part in _numbered(first):
        if part == first:
            continue
        with suppress(FormatError):  # damaged, and not needed here
            found[part] = read_model(part)
    return {part: one for part, one in found.items() if len(one.images) > len(model.images)}


def _left_out(
    folder: Path,
    models: Mapping[Path, ColmapModel],
    larger: Mapping[Path, ColmapModel],
    unposed: Sequence[Path],
    images: Path,
) -> str | None:
    """Writes sentences on the other models and the images that this one has no pose for."""
    number = len(models[folder].images)
    total = number + len(unposed)
    said: list[str] = []
    if unposed and number < _FAILED * total:
        said.append(
            f"The reconstruction failed for most pictures: only {number} of {total} have a pose, "
            "and the rest of this page is about these"
        )
    elif unposed:
        said.append(f"{number} of {total} pictures have a pose")
    if len(models) > 1:
        names = {image.name for model in models.values() for image in model.images}
        said += _other_models(folder, models, {name: below(images, name) for name in names})
    if larger:
        best = max(larger, key=lambda part: len(larger[part].images))
        said.append(
            f"{best} has {len(larger[best].images)} pictures, but gaussian-splatting's convert.py "
            "undistorts only the model 0 beside it: give this one the number 0 and run convert.py "
            f"--skip_matching again, or audit {best}"
        )
    if unposed:
        known = (*models.values(), *larger.values())
        names = {image.name for model in known for image in model.images}
        said += _nowhere([path.name for path in unposed if path.name not in names])
    broken = [part.name for part in _numbered(folder) if not _has_images(part)]
    if broken:
        names = ", ".join(f"{folder.parent.name}/{name}" for name in broken)
        said.append(f"the model in {names} has no images.bin and is left out")
    said += _odd_lenses(models[folder])
    text = "; ".join(said)
    return f"{text[0].upper()}{text[1:]}." if text else None


def _other_models(
    folder: Path, models: Mapping[Path, ColmapModel], paths: Mapping[str, Path]
) -> list[str]:
    """Names the models that were not joined, and where pictures in between would join them."""
    names = {part: sorted(i.name for i in model.images) for part, model in models.items()}
    own = set(names[folder])
    said: list[str] = []
    for part in models:
        if part == folder:
            continue
        others = [name for name in names[part] if name not in own]
        shared = len(names[part]) - len(others)
        text = f"{part.parent.name}/{part.name} "
        if not others:
            said.append(f"{text}has {shared} of the same and adds none")
            continue
        text += f"has {len(names[part])} ({names[part][0]} to {names[part][-1]})"
        if shared >= _MERGEABLE:
            text += f", {shared} of them in both: colmap model_merger may join them"
        elif pair := _gap([name for name in names[folder] if name in own], others, paths):
            text += f": pictures between {pair[0]} and {pair[1]} would join it"
        said.append(text)
    return [
        f"COLMAP did not join all: of its {len(models)} models {folder.parent.name}/{folder.name} "
        f"is used, with {len(own)} pictures; {'; '.join(said)}"
    ]


def _gap(
    own: Sequence[str], others: Sequence[str], paths: Mapping[str, Path]
) -> tuple[str, str] | None:
    """Finds where pictures in between would join two models: a picture of each that look alike.

    The most alike pair is taken if it shows nearly the same view, wherever the two are in order;
    else the first neighbors in the order of names.

    Args:
        own: names of the pictures of one model.
        others: of the other one.
        paths: where pictures lie; those that cannot be read only have their order.
    """
    of_both = sorted([(name, True) for name in own] + [(name, False) for name in others])
    pairs = [(a, b) for (a, first), (b, second) in itertools.pairwise(of_both) if first != second]
    if not pairs:
        return None
    looks = {name: _look(paths.get(name)) for name in _some(own) + _some(others)}
    for name in {name for pair in pairs for name in pair}:
        if name not in looks:
            looks[name] = _look(paths.get(name))

    def alike(pair: tuple[str, str]) -> float:
        a, b = (looks[name] for name in pair)
        return -1.0 if a is None or b is None else float(a @ b)

    best = max([*pairs, *itertools.product(_some(own), _some(others))], key=alike)
    return best if alike(best) >= _ALIKE else pairs[0]


_ALIKE = 0.75
"""Minimum correlation of small gray images of the same view. Of the lounge and the banana, pictures
that are five and more apart have 0.3 (90th percentile) and at most 0.59."""

_LOOKED_AT = 64
"""Pictures of each model that are compared."""

_SMALL = (16, 12)
"""Size at which pictures are compared [px]."""


def _some(names: Sequence[str]) -> list[str]:
    return list(names[:: max(1, -(-len(names) // _LOOKED_AT))])


def _look(path: Path | None) -> np.ndarray | None:
    """Reads a small gray image of mean 0 and length 1; None if it cannot be read."""
    if path is None:
        return None
    with suppress(ForeignFileError, OSError):
        small = small_gray(path, IMAGE_FORMATS, _SMALL).astype(np.float64).ravel()
        small -= small.mean()
        return small / max(float(np.linalg.norm(small)), 1e-9)
    return None


def _nowhere(names: list[str]) -> list[str]:
    """Describes pictures that belong to no model."""
    if not names:
        return []
    shown = ", ".join(names[:_MOST_NAMED])
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return [f"no model has {shown}{more}: take pictures between them and their neighbors"]


def _odd_lenses(model: ColmapModel) -> list[str]:
    """Names an implausible lens, which makes the poses and points unreliable."""
    odd = [
        f"camera {number} (focal lengths {lens.intrinsics[0]:.0f} and {lens.intrinsics[1]:.0f} px, "
        f"distortion {max(map(abs, lens.distortion.values()), default=0.0):.3g})"
        for number, lens in sorted(model.cameras.items())
        if not _is_plausible(lens)
    ]
    if not odd:
        return []
    return [
        f"{odd[0]} is not a plausible lens, so poses and points are likely wrong: reconstruct "
        "again with known intrinsics (--ImageReader.camera_params) or more overlap"
    ]


def _is_plausible(lens: Lens) -> bool:
    low, high = _FOCAL_RATIOS
    focals, side = lens.intrinsics[:2], max(lens.width, lens.height)
    if max(focals) > _SQUARE * min(focals):
        return False
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
        raise ForeignFileError(
            "the model has no image with a pose: COLMAP's mapper failed, so take more pictures "
            "that overlap and reconstruct again"
        )
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
    """Numbers points by index instead of by id. Tracks leave out images that are missing."""
    seen_point = np.repeat(np.arange(len(points)), points.track_lengths)
    known = np.array(sorted(index), np.int64)
    at = np.minimum(np.searchsorted(known, points.track_images), len(known) - 1)
    there = known[at] == points.track_images
    indices = np.array([index[number] for number in known.tolist()], np.int64)
    return SparsePoints(points.xyz, points.rgb, seen_point[there], indices[at[there]])


_MOST_POINTS = 20_000
"""Points whose angle of triangulation is computed."""


def reconstruction_of(model: ColmapModel, unposed: int) -> Reconstruction:
    """Computes the numbers of a model.

    Args:
        model: cameras, images and points.
        unposed: pictures beside its own that it has no pose for.
    """
    points, posed = model.points, len(model.images)
    error = points.error[points.error >= 0.0]
    median, p95 = np.percentile(error, [50.0, 95.0]) if len(error) else (None, None)
    lengths = points.track_lengths[points.track_lengths > 0]
    return Reconstruction(
        posed=posed,
        pictures=posed + unposed,
        error_median=None if median is None else float(median),
        error_p95=None if p95 is None else float(p95),
        track_length=float(lengths.mean()) if len(lengths) else None,
        angle=_median_angle(model),
    )


def _median_angle(model: ColmapModel) -> float | None:
    points = model.points
    centers = {i.id: pose_of(i.quaternion, i.translation)[:3, 3] for i in model.images}
    ends = np.cumsum(points.track_lengths)
    step = max(1, len(points) // _MOST_POINTS)
    angles: list[float] = []
    for index in range(0, len(points), step):
        track = points.track_images[ends[index] - points.track_lengths[index] : ends[index]]
        seen = [centers[image] for image in track.tolist() if image in centers]
        if len(seen) < 2:
            continue
        rays = np.stack(seen) - points.xyz[index]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return float(np.degrees(np.median(angles))) if angles else None
