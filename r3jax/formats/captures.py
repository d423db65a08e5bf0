"""Opens everything that can be trained on, evaluated or audited: runs, recordings, posed images."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from r3jax.formats.colmap.reader import find_model, read_colmap
from r3jax.formats.errors import FormatError, check_capture
from r3jax.formats.guesses import nearest_guess
from r3jax.formats.nerfstudio import find_transforms, read_transforms
from r3jax.formats.phones.arkit_scenes import is_arkit_scenes, read_arkit_scenes
from r3jax.formats.phones.polycam import is_polycam, read_polycam
from r3jax.formats.phones.record3d import is_record3d, read_record3d
from r3jax.formats.phones.stray_scanner import is_stray_scanner, read_stray_scanner
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.recordings import is_recording, read_recording
from r3jax.formats.ros.bag_reader import read_bag
from r3jax.formats.ros.bags import Topics, is_bag
from r3jax.formats.ros.rtabmap import (
    is_rtabmap_database,
    is_rtabmap_export,
    read_rtabmap_database,
    read_rtabmap_export,
)
from r3jax.formats.sequences.replica_slam import is_replica_slam, read_replica_slam
from r3jax.formats.sequences.scannet import is_scannet, is_sens, read_scannet, read_sens
from r3jax.formats.sequences.seven_scenes import is_seven_scenes, read_seven_scenes
from r3jax.formats.sequences.tum import is_tum, read_tum
from r3jax.frame import Frame
from r3jax.runs.reader import Run, read_run

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
)
"""Formats of posed images: a test for each, and its reader."""

_KNOWN = (
    "a run (run.json), a recording (poses.txt, images/), nerfstudio's transforms.json or NeRF's "
    "transforms_train.json, a COLMAP "
    "model (cameras.bin or cameras.txt, here or in sparse/0), raw data of Polycam (keyframes/), a "
    "recording of Record3D (.r3d, or EXR_RGBD/) or Stray Scanner (rgb.mp4, odometry.csv), a "
    "scene of ARKitScenes (lowres_wide.traj), ScanNet (.sens, or color/, depth/, pose/, "
    "intrinsic/), Replica-SLAM (traj.txt, results/), TUM (rgb.txt, depth.txt, groundtruth.txt) or "
    "7-Scenes (frame-*.color.png), a ROS bag (.bag, .mcap, .db3, or metadata.yaml), "
    "RTAB-Map (.db, or *_camera_poses.txt)"
)

_COMMON_NAME = re.compile(r"\d+|sparse|dense|colmap|undistorted|raw|seq-?\d+", re.IGNORECASE)
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


def open_capture(path: Path, up: Literal["y", "z"] = "y", topics: Topics | None = None) -> Capture:
    """Opens a run, a recording, or posed images of any format.

    Args:
        path: the folder, an app's archive, or nerfstudio's file.
        up: axis of a recording's world that points up; the others stay as they are.
        topics: names of a ROS bag's topics and frames; None: detected.

    Raises:
        FormatError: an unknown or a broken format.
        RunError: it is a run, but broken.
    """
    if topics is not None:
        if not is_bag(path):
            raise FormatError(path, "--topics was given, but this is not a ROS bag")
        return Capture(path, read_bag(path, topics))
    if path.is_file() and path.suffix == ".json":
        return Capture(path, read_transforms(path).fitted())
    if (path / "run.json").exists():
        return Capture(path, read_run(path))
    if is_recording(path):
        return Capture(path, read_recording(path, up))
    for fits, read in _FORMATS:
        if fits(path):
            return Capture(path, read(path).fitted())
    check_capture(path)
    guess = _below(path) or nearest_guess(path)
    raise FormatError(path, guess or f"this is neither {_KNOWN}")


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
