"""A growing capture, looked at again and again: which frames are new, which poses were corrected.

A frame counts once it can be read whole; one that cannot is tried again. Frames are known by their
names, so they may come in any order.
"""

import dataclasses
import os
import stat
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r3jax.apps.audit.live.staging import stage
from r3jax.apps.audit.source import Picture, Source, source_of
from r3jax.formats.captures import open_capture
from r3jax.formats.ros.growing.bag import FollowedBag, growing_files
from r3jax.formats.ros.names import Topics
from r3jax.geometry.cameras import angle_between

_MOVED, _TURNED = 0.02, 1.0
"""Poses that were corrected by less stay where they are [m], [deg]."""

_BATCH = 8
"""Frames that are read at once at most: a folder may hold thousands from the start."""

_AGAIN = 1.0
"""A folder is looked at again after so long, whatever its times say [s]."""

_LARGE = (".png", ".jpg", ".jpeg")
"""Files that are not looked at one by one: their folder says when another one comes."""


@dataclass(frozen=True)
class Arrival:
    """A frame that has come in."""

    name: str
    """Its name, for the reader."""

    index: int
    """Its number in the source as it is now."""

    picture: Picture
    """Its colors and depth."""


class GrowingCapture:
    """What has come in of a capture; reads it, and writes nothing into it."""

    def __init__(self, path: Path, scratch: Path, topics: Topics | None = None):
        """Looks at nothing yet.

        Args:
            path: the capture, which may not be there yet.
            scratch: an empty folder of our own, which stays until the source is read no more.
            topics: names of a ROS bag's topics and frames; None: all are guessed.
        """
        self._path, self._scratch, self._topics = path, scratch, topics
        self._bag: FollowedBag | None = None
        self._seen: object = None
        self._source: Source | None = None
        self._taken: dict[str, np.ndarray] = {}
        self._is_pending, self._when = False, 0.0
        self.waiting_for = "the first frame"
        """Why nothing more comes in, in words; empty if all is in."""

    @property
    def source(self) -> Source | None:
        """The frames that came in so far, in the capture's order; None before the first."""
        if self._source is None or not self._taken:
            return None
        kept = [i for i, key in enumerate(_keys(self._source)) if key in self._taken]
        return subset(self._source, kept)

    def look(self) -> tuple[Source | None, list[Arrival], bool]:
        """Looks once.

        Returns:
            The capture as it is now, some frames that are new in it, and whether poses of earlier
            ones were corrected.

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
            self._bag = FollowedBag(self._path, files, self._topics)
        try:
            source = self._opened(files)
        except (ValueError, OSError) as error:  # half of it is written; or it is none
            self.waiting_for, self._is_pending = str(error), True
            return self._source, [], False
        if not source.is_dense:
            raise ValueError("guidance needs depth images: this capture has none")
        self._seen, self._source = now, source
        return source, self._arrivals(source), self._has_moved(source)

    def _opened(self, files: list[Path]) -> Source:
        """The frames that are whole by now; raises ValueError, OSError where none is."""
        path = self._path.resolve()
        if self._bag is not None and files:
            return source_of(self._bag.images(files), path.stem)
        staged = stage(self._path, self._scratch)
        images = open_capture(staged, "z", self._topics).source
        return source_of(images, (path.parent if path.is_file() else path).name)

    def _arrivals(self, source: Source) -> list[Arrival]:
        """The first of the new frames that can be read."""
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
        """True if poses of frames that are in were corrected; takes note of them."""
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
        """All frames that came in and can still be read, one by one."""
        for index, key in enumerate(_keys(source)):
            if key not in self._taken:
                continue
            try:
                picture = source.read(index)
            except (ValueError, OSError):  # it has gone since
                continue
            yield Arrival(source.labels[index], index, picture)


def subset(source: Source, indices: list[int]) -> Source:
    """Some of the frames of a capture."""
    return dataclasses.replace(
        source,
        poses=source.poses[indices],
        lenses=tuple(source.lenses[i] for i in indices),
        labels=tuple(source.labels[i] for i in indices),
        read=lambda index: source.read(indices[index]),
    )


def _keys(source: Source) -> list[str]:
    """Names of all frames; equal ones get numbers."""
    count: Counter[str] = Counter()
    keys: list[str] = []
    for label in source.labels:
        keys.append(f"{label}/{count[label]}")
        count[label] += 1
    return keys


def _signature(path: Path) -> object:
    """What changes when a frame comes in: times of the folders, and of the texts in them."""
    try:
        found = path.stat()
        if not stat.S_ISDIR(found.st_mode):
            return found.st_mtime_ns, found.st_size
        entries = [e for e in os.scandir(path) if not e.name.lower().endswith(_LARGE)]
        told = [(e.name, e.stat().st_mtime_ns, e.stat().st_size) for e in entries]
        return found.st_mtime_ns, tuple(sorted(told))
    except OSError:
        return None
