"""Polls a growing capture for new frames and corrected poses.

A frame counts once it can be read completely; until then it is tried again. Frames are identified
by their names, so they may arrive in any order.

Readers refuse a folder whose numbers of images, depth images and poses differ. For a growing
folder, the complete frames are therefore linked into a scratch folder, which is read instead;
nothing is written into the folder itself.
"""

import dataclasses
import os
import stat
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from r3jax.captures.source import Picture, Source, source_of
from r3jax.errors import InputError
from r3jax.formats.captures import open_capture
from r3jax.formats.recordings import is_recording
from r3jax.formats.ros.bags import Topics
from r3jax.formats.ros.growing import FollowedBag, growing_files
from r3jax.geometry.cameras import angle_between

_IMAGES = (".png", ".jpg")
_SETTLED = 0.5
"""A last line without a line end counts once the file has not changed for this long [s]."""

_NUMBERS = 16
"""Of a pose."""


def stage(path: Path, scratch: Path) -> Path:
    """Links the complete frames of a growing capture.

    Args:
        path: the capture; nothing in it is changed.
        scratch: a temporary folder, the same from call to call.

    Returns:
        The path to read: the scratch folder, or the capture itself if its format names every frame
        (a transforms.json) or is not one that is known to grow.

    Raises:
        OSError: permission denied.
    """
    if is_recording(path):
        return _stage_recording(path, scratch)
    if path.is_dir() and any(path.glob("frame-*.color.*")):
        return _stage_numbered(path, scratch)
    return path


def _stage_recording(path: Path, scratch: Path) -> Path:
    """Links images and depth images that belong to complete lines of poses.txt, in order."""
    images = _by_stem(path / "images")
    depths = _by_stem(path / "depth")
    lines = complete_lines(path / "poses.txt")
    paired = dict(zip(_in_order(sorted(images), len(lines)), lines, strict=False))
    whole = [stem for stem in sorted(paired) if stem in depths]
    _link(scratch / "images", [images[stem] for stem in whole])
    _link(scratch / "depth", [depths[stem] for stem in whole])
    if (path / "K.txt").exists():
        _link(scratch, [path / "K.txt"], keep=True)
    (scratch / "poses.txt").write_text("".join(f"{paired[stem]}\n" for stem in whole))
    return scratch


def _in_order(stems: list[str], poses: int) -> list[str]:
    """Returns the names that can be assigned to the first poses without doubt.

    With as many names as poses, these are all names. Otherwise, if names are numbers, only those
    before the first gap, because a delayed frame would shift the poses of the following ones.
    """
    if len(stems) == poses or not all(stem.isdecimal() for stem in stems):
        return stems[:poses]
    numbers = [int(stem) for stem in stems]
    steps = [b - a for a, b in pairwise(numbers)]
    gap = next((i for i, step in enumerate(steps) if step > min(steps)), len(steps))
    return stems[: min(gap + 1, poses)]


def complete_lines(path: Path) -> list[str]:
    """Reads the complete lines of a text file of poses: 16 numbers and a line end.

    Raises:
        OSError: permission denied.
    """
    text = path.read_text(errors="replace") if path.exists() else ""
    whole, _, rest = text.rpartition("\n")
    if rest.strip() and time.time() - path.stat().st_mtime > _SETTLED:
        whole = text
    lines = [line.strip() for line in whole.splitlines() if line.strip()]
    return [line for line in lines if len(line.split()) == _NUMBERS]


def _stage_numbered(path: Path, scratch: Path) -> Path:
    """Links the complete frames of a 7-Scenes folder: an image, a depth image and a pose each."""
    files = {entry.name: entry for entry in path.iterdir() if entry.name.startswith("frame-")}
    bases = {name.partition(".")[0] for name in files}
    kept: list[Path] = []
    for base in sorted(bases):
        pose = files.get(f"{base}.pose.txt")
        color = next((files[n] for s in _IMAGES if (n := f"{base}.color{s}") in files), None)
        depth = files.get(f"{base}.depth.png")
        if color and depth and pose and len(pose.read_text().split()) == _NUMBERS:
            kept += [color, depth, pose]
    _link(scratch, kept)
    return scratch


def _by_stem(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        return {}
    return {entry.stem: entry for entry in folder.iterdir() if entry.suffix.lower() in _IMAGES}


def _link(folder: Path, files: Iterable[Path], *, keep: bool = False) -> None:
    """Fills a folder with links to these files; other links in it are removed unless `keep`."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {file.name: file for file in files}
    present = {entry.name for entry in os.scandir(folder) if entry.is_symlink()}
    for name in wanted.keys() - present:
        (folder / name).symlink_to(wanted[name].resolve())
    for name in () if keep else present - wanted.keys():
        (folder / name).unlink()


_MOVED, _TURNED = 0.02, 1.0
"""Corrections of poses below this are ignored [m], [deg]."""

_BATCH = 8
"""Maximum number of frames read at once, as a folder may contain thousands from the start."""

_AGAIN = 1.0
"""Interval after which a folder is scanned even if its time stamps have not changed [s]."""

_LARGE = (".png", ".jpg", ".jpeg")
"""Suffixes of files that are not checked one by one: the time of their folder shows new ones."""


@dataclass(frozen=True)
class Arrival:
    """A newly received frame."""

    name: str
    """Its name in reports."""

    index: int
    """Its index in the current source."""

    picture: Picture
    """Its colors and depth."""


class GrowingCapture:
    """The frames received so far of a growing capture, which is only read."""

    def __init__(self, path: Path, scratch: Path, topics: Topics | None = None):
        """Stores the arguments; nothing is read yet.

        Args:
            path: the capture, which need not exist yet.
            scratch: an empty temporary folder, which must exist as long as the source is read.
            topics: names of a ROS bag's topics and frames; None to detect them.
        """
        self._path, self._scratch, self._topics = path, scratch, topics
        self._bag: FollowedBag | None = None
        self._seen: object = None
        self._source: Source | None = None
        self._taken: dict[str, np.ndarray] = {}
        self._is_pending, self._when = False, 0.0
        self.waiting_for = "the first frame"
        """What the capture is waiting for; empty if all frames were read."""

    @property
    def source(self) -> Source | None:
        """The frames received so far, in the capture's order; None before the first."""
        if self._source is None or not self._taken:
            return None
        kept = [i for i, key in enumerate(_keys(self._source)) if key in self._taken]
        return subset(self._source, kept)

    def look(self) -> tuple[Source | None, list[Arrival], bool]:
        """Checks once for new frames.

        Returns:
            The current capture, some of its new frames, and whether poses of earlier frames were
            corrected.

        Raises:
            ValueError: the capture has no depth images, or is a bag that cannot be followed.
        """
        now = _signature(self._path)
        is_late = time.monotonic() - self._when > _AGAIN
        if now == self._seen and not self._is_pending and not is_late:
            return self._source, [], False
        self._when = time.monotonic()
        files = growing_files(self._path)
        if files and self._bag is None:
            self._bag = FollowedBag(self._path, self._topics)
        try:
            source = self._opened(files)
        except (ValueError, OSError) as error:  # incomplete, or not a capture
            self.waiting_for, self._is_pending = str(error), True
            return self._source, [], False
        if not source.is_dense:
            raise InputError("guidance needs depth images: this capture has none")
        self._seen, self._source = now, source
        return source, self._arrivals(source), self._has_moved(source)

    def _opened(self, files: list[Path]) -> Source:
        """Opens the frames that are complete so far.

        Raises:
            ValueError, OSError: there are none.
        """
        path = self._path.resolve()
        if self._bag is not None and files:
            return source_of(self._bag.images(files), path.stem)
        staged = stage(self._path, self._scratch)
        images = open_capture(staged, "z", self._topics).source
        return source_of(images, (path.parent if path.is_file() else path).name)

    def _arrivals(self, source: Source) -> list[Arrival]:
        """Reads the first of the new frames that can be read."""
        found: list[Arrival] = []
        self._is_pending, self.waiting_for = False, ""
        for index, key in enumerate(_keys(source)):
            if key in self._taken:
                continue
            if len(found) == _BATCH:
                self._is_pending = True
                break
            try:
                picture = source.read(index)
            except (ValueError, OSError) as error:
                self._is_pending, self.waiting_for = True, str(error)
                continue
            self._taken[key] = source.poses[index]
            found.append(Arrival(source.labels[index], index, picture))
        return found

    def _has_moved(self, source: Source) -> bool:
        """Records corrected poses of frames that are in the map; returns True if there are any."""
        moved = False
        for index, key in enumerate(_keys(source)):
            if key not in self._taken:
                continue
            before, after = self._taken[key], source.poses[index]
            step = float(np.linalg.norm(before[:3, 3] - after[:3, 3]))
            if step > _MOVED or angle_between(before, after) > np.radians(_TURNED):
                moved, self._taken[key] = True, after
        return moved

    def again(self, source: Source) -> Iterator[Arrival]:
        """Yields all frames that were read before and can still be read, one by one."""
        for index, key in enumerate(_keys(source)):
            if key not in self._taken:
                continue
            try:
                picture = source.read(index)
            except (ValueError, OSError):  # it was deleted meanwhile
                continue
            yield Arrival(source.labels[index], index, picture)


def subset(source: Source, indices: list[int]) -> Source:
    """Selects frames of a capture by index."""
    photograph, photo_of = source.photograph, source.photo_of
    return dataclasses.replace(
        source,
        poses=source.poses[indices],
        lenses=tuple(source.lenses[i] for i in indices),
        labels=tuple(source.labels[i] for i in indices),
        read=lambda index: source.read(indices[index]),
        photograph=photograph and (lambda index, by: photograph(indices[index], by)),
        photo_of=None if photo_of is None else photo_of[indices],
    )


def _keys(source: Source) -> list[str]:
    """Returns a unique key for each frame: its label, and a number among equal labels."""
    count: Counter[str] = Counter()
    keys: list[str] = []
    for label in source.labels:
        keys.append(f"{label}/{count[label]}")
        count[label] += 1
    return keys


def _signature(path: Path) -> object:
    """Returns a value that changes when a frame is added.

    It consists of the modification times of the folder and of its small files.
    """
    try:
        found = path.stat()
        if not stat.S_ISDIR(found.st_mode):
            return found.st_mtime_ns, found.st_size
        entries = [e for e in os.scandir(path) if not e.name.lower().endswith(_LARGE)]
        told = [(e.name, e.stat().st_mtime_ns, e.stat().st_size) for e in entries]
        return found.st_mtime_ns, tuple(sorted(told))
    except OSError:
        return None
