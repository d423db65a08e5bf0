"""Opens everything that can be trained on, evaluated or audited: runs, recordings, posed images.

The content of an unsupported folder is guessed, and a command to convert it is suggested.
"""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from r3jax.formats.colmap.reader import find_model, read_colmap
from r3jax.formats.cut import Cut
from r3jax.formats.cut_views import cut_wide
from r3jax.formats.errors import FormatError, check_capture
from r3jax.formats.nerfstudio import find_transforms, read_transforms
from r3jax.formats.phones.archives import SUFFIXES, open_zip
from r3jax.formats.phones.arkit_scenes import is_arkit_scenes, read_arkit_scenes
from r3jax.formats.phones.polycam import is_polycam, read_polycam
from r3jax.formats.phones.record3d import is_record3d, read_record3d
from r3jax.formats.phones.stray_scanner import is_stray_scanner, read_stray_scanner
from r3jax.formats.posed_images import IMAGE_FORMATS, PosedImages
from r3jax.formats.recordings import is_recording, read_recording
from r3jax.formats.ros.bag_reader import read_bag
from r3jax.formats.ros.bags import Topics, is_bag
from r3jax.formats.ros.rtabmap import (
    is_rtabmap_database,
    is_rtabmap_export,
    read_rtabmap_database,
    read_rtabmap_export,
)
from r3jax.formats.sequences.llff import is_llff, read_llff
from r3jax.formats.sequences.replica_slam import is_replica_slam, read_replica_slam
from r3jax.formats.sequences.scannet import is_scannet, is_sens, read_scannet, read_sens
from r3jax.formats.sequences.seven_scenes import is_seven_scenes, read_seven_scenes
from r3jax.formats.sequences.tum import is_tum, read_tum
from r3jax.frame import Frame
from r3jax.runs.reader import Run, read_run
from r3jax.validation.database import check_database
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import first_size

_FORMATS: tuple[tuple[Callable[[Path], bool], Callable[[Path], PosedImages]], ...] = (
    (is_replica_slam, read_replica_slam),
    (is_tum, read_tum),
    (is_seven_scenes, read_seven_scenes),
    (lambda path: find_transforms(path) is not None, read_transforms),
    (lambda path: find_model(path) is not None, read_colmap),
    (is_polycam, read_polycam),
    (is_record3d, read_record3d),
    (is_stray_scanner, read_stray_scanner),
    (is_arkit_scenes, read_arkit_scenes),
    (is_scannet, read_scannet),
    (is_sens, read_sens),
    (is_rtabmap_export, read_rtabmap_export),
    (is_rtabmap_database, read_rtabmap_database),
    (is_bag, read_bag),
    (is_llff, read_llff),
)
"""Formats of posed images: a test for each, and its reader."""

_KNOWN = (
    "a run (run.json), a recording (poses.txt, images/), nerfstudio's transforms.json or NeRF's "
    "transforms_train.json, a COLMAP "
    "model (cameras.bin or cameras.txt, here or in sparse/0), raw data of Polycam (keyframes/), a "
    "recording of Record3D (.r3d, or EXR_RGBD/) or Stray Scanner (rgb.mp4, odometry.csv), a "
    "scene of ARKitScenes (lowres_wide.traj), ScanNet (.sens, or color/, depth/, pose/, "
    "intrinsic/), Replica-SLAM (traj.txt, results/), TUM (rgb.txt, depth.txt, groundtruth.txt) or "
    "7-Scenes (frame-*.color.png), LLFF (poses_bounds.npy), a ROS bag (.bag, .mcap, .db3, or "
    "metadata.yaml), RTAB-Map (.db, or *_camera_poses.txt)"
)

_COMMON_NAME = re.compile(r"\d+|sparse|dense|colmap|undistorted|raw|data|seq-?\d+", re.IGNORECASE)
"""Common folder names, which do not identify a capture."""

_MOST_BELOW = 100
"""Subfolders to search if the given folder is not a capture."""


@dataclass(frozen=True)
class Capture:
    """Posed images on disk, with or without depth."""

    path: Path
    source: Run | PosedImages

    @property
    def run(self) -> Run | None:
        """The run, if it is one."""
        return self.source if isinstance(self.source, Run) else None

    @property
    def name(self) -> str:
        """The folder's name, or that of an archive without its suffix.

        If that is a common name, it starts with the parent folders: `scan-sparse-0`.
        """
        path = self.path.resolve()
        if path.is_file():
            path = path.parent if path.suffix == ".json" else path.with_suffix("")
        names = [path.name]
        while _COMMON_NAME.fullmatch(path.name) and path.parent.name:
            path = path.parent
            names.insert(0, path.name)
        return "-".join(names)

    def __len__(self) -> int:
        return len(self.source.rows if isinstance(self.source, Run) else self.source)

    def frames(self) -> Iterator[Frame]:
        """Iterates over every frame in order, reading one at a time."""
        return self.source.frames()

    @property
    def models(self) -> Path:
        """Folder of the models; nothing is written into captures of other programs."""
        if self.run is not None:
            return self.path / "models"
        return Path("runs") / self.name / "models"


def open_capture(
    path: Path,
    up: Literal["y", "z"] = "y",
    topics: Topics | None = None,
    cut: Cut | None = None,
) -> Capture:
    """Opens a run, a recording, or posed images of any format.

    Photos of 360 degrees and fisheyes of nearly 180 are cut into pinhole views.

    Args:
        path: the folder, an app's archive, or nerfstudio's file.
        up: axis of a recording's world that points up; the others stay as they are.
        topics: names of a ROS bag's topics and frames; None: detected.
        cut: how 360 photos are cut; None: by default.

    Raises:
        FormatError: an unknown or a broken format.
        RunError: it is a run, but broken.
    """
    if topics is not None:
        if not is_bag(path):
            raise FormatError(path, "--topics was given, but this is not a ROS bag")
        return Capture(path, cut_wide(read_bag(path, topics), cut))
    if path.is_file() and path.suffix == ".json":
        return Capture(path, cut_wide(read_transforms(path).fitted(), cut))
    if (path / "run.json").exists():
        return Capture(path, read_run(path))
    if is_recording(path):
        return Capture(path, read_recording(path, up))
    for fits, read in _FORMATS:
        if fits(path):
            try:
                return Capture(path, cut_wide(read(path).fitted(), cut))
            except FormatError as error:
                raise _with_model_beside(error, path, read) from error
    check_capture(path)
    guess = _below(path) or nearest_guess(path)
    raise FormatError(path, guess or f"this is neither {_KNOWN}")


def _with_model_beside(
    error: FormatError, path: Path, read: Callable[[Path], PosedImages]
) -> FormatError:
    """Names the COLMAP model of a folder whose transforms.json cannot be read, if it has one."""
    model = find_model(path) if read is read_transforms else None
    if model is None:
        return error
    return FormatError(error.path, f"{error.reason}; its COLMAP model may be whole: give {model}")


def _below(path: Path) -> str | None:
    """Finds a subfolder that is a capture, if the folder itself is not."""
    if not path.is_dir():
        return None
    folders = sorted(entry for entry in path.iterdir() if entry.is_dir())[:_MOST_BELOW]
    found = [folder for folder in folders if _is_known(folder)]
    if not found:
        return None
    many = f" (and {len(found) - 1} more)" if found[1:] else ""
    return f"this is not a capture, but {found[0]} is one{many}: give that folder"


def _is_known(path: Path) -> bool:
    """Checks whether a folder looks like a supported format, complete or not."""
    is_ours = (path / "run.json").exists() or is_recording(path)
    return is_ours or any(fits(path) for fits, _ in _FORMATS)


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
        if entry.startswith("."):
            continue
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
    for name in names:
        cameras = PurePosixPath(name).with_stem("cameras")
        if name.endswith(("points3D.txt", "points3D.bin")) and str(cameras) not in names:
            return (
                f"this looks like a COLMAP model, but {path / name} has no {cameras.name} beside "
                "it: copy the whole model, or write it again (colmap model_converter)"
            )
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
    if _are_panoramas(path, colors):
        return (
            "these look like 360 photos without poses: COLMAP finds them with --ImageReader."
            "camera_model EQUIRECTANGULAR (version 4 or later), or its panorama_sfm.py; then audit "
            "the folder of the photos and of sparse/0"
        )
    return (
        f"these look like images without poses: ns-process-data images --data {folder} "
        "--output-dir OUT finds them by COLMAP, then audit OUT"
    )


def _are_panoramas(path: Path, names: list[str]) -> bool:
    """Checks whether the first image that can be opened is twice as wide as high."""
    with suppress(ForeignFileError, OSError):
        width, height = first_size((path / name for name in names), IMAGE_FORMATS)
        return width == 2 * height
    return False


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
