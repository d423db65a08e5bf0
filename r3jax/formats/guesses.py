"""Guesses the content of an unsupported folder, and suggests a command to convert it."""

import os
import re
from collections.abc import Callable
from pathlib import Path

from r3jax.formats.errors import FormatError
from r3jax.formats.phones.archives import SUFFIXES, open_zip
from r3jax.validation.database import check_database
from r3jax.validation.errors import ForeignFileError

_IMAGES = (".jpg", ".jpeg", ".png", ".heic", ".tif", ".tiff")
_VIDEOS = (".mp4", ".mov", ".m4v", ".avi")
_MODELS = (".ply", ".glb", ".obj", ".usdz", ".las", ".laz", ".e57")

_NO_COLORS = ("depth", "mask", "confidence", "conf", "normal", "semantic")
"""How folders of images begin that no structure from motion could use."""

_EXR_DEPTH = re.compile(r"depth/\d+\.exr$")
_POSES = re.compile(r"(pose|traj|extrinsic)[^/]*\.(txt|csv|json|npy)$", re.IGNORECASE)
"""Files by their names."""

_MARKS = ("keyframes/", "rgbd/", "odometry.csv", "lowres_wide.traj")
"""Beginnings of names by which phones' captures are known."""

_MOST = 2000
"""Names that are looked at in each folder."""


def nearest_guess(path: Path) -> str | None:
    """Describes what a folder or archive looks like and what to do with it, in one sentence.

    Args:
        path: it exists, and no reader took it.

    Returns:
        None where nothing can be guessed.
    """
    if path.is_file():
        return _of_archive(path)
    names = _names(path)
    found = (guess(path, names) for guess in _GUESSES)
    return next((sentence for sentence in found if sentence is not None), None)


def _names(path: Path) -> list[str]:
    """Lists names in a folder and in the folders below it, joined by a slash."""
    found: list[str] = []
    for entry in sorted(os.listdir(path))[:_MOST]:
        found.append(entry)
        if (path / entry).is_dir():
            found += [f"{entry}/{name}" for name in sorted(os.listdir(path / entry))[:_MOST]]
    return found


def _of_archive(path: Path) -> str | None:
    """Describes a zip archive or database that is damaged or has another content."""
    if path.suffix.lower() == ".db":
        return _of_database(path)
    if path.suffix.lower() not in SUFFIXES:
        return None
    try:
        names = list(open_zip(path).NameToInfo)[:_MOST]
    except FormatError as error:
        return error.reason
    tops = {top for top, _, rest in (n.partition("/") for n in names) if rest.startswith(_MARKS)}
    if len(tops) > 1:
        return "this archive holds several captures: unpack it and give one of its folders"
    unpacked = path.with_suffix("")
    for guess in _GUESSES:
        sentence = guess(unpacked, names)
        if sentence is not None:
            return f"unpack this archive first; {sentence}"
    return "this archive holds no capture that is known: unpack it and give the folder"


def _of_database(path: Path) -> str:
    try:
        check_database(path)
    except ForeignFileError as error:
        return f"{error}: copy it again"
    if not path.stat().st_size:
        return "the database is empty: copy it again"
    return (
        "this is no database of RTAB-Map: of COLMAP give the folder of a model (colmap mapper "
        f"--database_path {path} --image_path IMAGES --output_path OUT)"
    )


def _bags(path: Path, names: list[str]) -> str | None:
    found = [name for name in names if name.lower().endswith((".bag", ".mcap", ".db3"))]
    if not found or "metadata.yaml" in names:
        return None
    return f"this folder holds several ROS bags: give one of them, such as {path / found[0]}"


def _exr(path: Path, names: list[str]) -> str | None:
    if not any(name.startswith("EXR_RGBD/") or _EXR_DEPTH.match(name) for name in names):
        return None
    return (
        "this looks like Record3D's export EXR + JPG without metadata.json beside rgb/ and depth/: "
        "copy the whole folder EXR_RGBD off the phone again, or share the recording as .r3d"
    )


def _tum(path: Path, names: list[str]) -> str | None:
    lists = {"rgb.txt", "depth.txt", "groundtruth.txt"}
    missing = sorted(lists - set(names))
    if len(missing) > 1 or not {"rgb.txt", "depth.txt"} & set(names):
        return None
    told = f"this looks like a sequence of TUM RGB-D without {' and '.join(missing)}: "
    if missing == ["groundtruth.txt"]:
        return told + (
            "save the trajectory of your SLAM under this name (lines of timestamp tx ty tz qx qy "
            "qz qw, camera to world), or download the sequence again"
        )
    return told + "download the sequence again"


def _stray(path: Path, names: list[str]) -> str | None:
    if "rgb.mp4" not in names and "camera_matrix.csv" not in names:
        return None
    return (
        "this looks like a recording of Stray Scanner without odometry.csv: copy the whole folder "
        "off the phone again"
    )


def _frames(path: Path, names: list[str]) -> str | None:
    if not {"color", "depth"} <= set(names) or any(map(_POSES.match, names)):
        return None
    return (
        "this looks like an export of ScanNet without pose/ and intrinsic/: export them too "
        "(ScanNet's reader.py with --export_poses --export_intrinsics), or audit the .sens file"
    )


def _colmap(path: Path, names: list[str]) -> str | None:
    if not any(name.endswith("database.db") for name in names):
        return None
    return (
        "this looks like a COLMAP project without a model: colmap mapper --database_path "
        f"{path}/database.db --image_path {path}/images --output_path {path}/sparse"
    )


def _metashape(path: Path, names: list[str]) -> str | None:
    tables = [name for name in names if name.lower().endswith(".xml")]
    if not tables or not _count(names, _IMAGES):
        return None
    return (
        f"this looks like an export of Metashape: ns-process-data metashape --data {path} --xml "
        f"{path / tables[0]} --output-dir OUT, then audit OUT"
    )


def _video(path: Path, names: list[str]) -> str | None:
    videos = [name for name in names if name.lower().endswith(_VIDEOS)]
    if not videos or _count(names, _IMAGES) > len(videos):
        return None
    return (
        f"this looks like a video without poses: ns-process-data video --data {path / videos[0]} "
        "--output-dir OUT finds them by COLMAP, then audit OUT"
    )


def _images(path: Path, names: list[str]) -> str | None:
    if not _count(names, _IMAGES):
        return None
    poses = next((name for name in names if _POSES.search(name)), None)
    if poses is not None:
        return (
            f"these look like images with poses ({poses}) in a layout that is not known: write "
            "them into a transforms.json, or lay them out as a recording (images/, depth/, "
            "poses.txt, K.txt)"
        )
    found = [name for name in names if name.lower().endswith(_IMAGES)]
    colors = [name for name in found if not name.lower().startswith(_NO_COLORS)]
    folder = (path / (colors or found)[0]).parent
    return (
        f"these look like images without poses: ns-process-data images --data {folder} "
        "--output-dir OUT finds them by COLMAP, then audit OUT"
    )


def _model(path: Path, names: list[str]) -> str | None:
    if not _count(names, _MODELS):
        return None
    return (
        "this looks like a finished model without the images it was made of: export raw data of "
        "the scan"
    )


def _count(names: list[str], suffixes: tuple[str, ...]) -> int:
    return sum(name.lower().endswith(suffixes) for name in names)


_GUESSES: tuple[Callable[[Path, list[str]], str | None], ...] = (
    *(_bags, _exr, _tum, _stray, _frames, _colmap, _metashape, _video, _images, _model),
)
"""From the particular to the general."""
