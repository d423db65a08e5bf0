"""Captures of phone apps: a folder, or a zip archive of one, whose frames become posed images.

Apps hand on both, and both are read alike. Nothing is unpacked onto the disk. An archive may hold
its files under one folder at its top.
"""

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.formats.depth import DEPTH_MODES, MILLIMETERS, keep_confident, stored_depth
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import IMAGE_FORMATS, Pixels, PosedImages, left_out
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular, read_bytes
from r3jax.validation.images import image_pixels, image_size
from r3jax.validation.json_text import parse_json

SUFFIXES = (".zip", ".r3d")
"""Names of files that are zip archives."""

_MAX_IMAGE = 64 << 20
"""A phone's image takes a few megabytes."""

_MAX_TEXT = 64 << 20
"""A pose takes some hundred bytes."""

_MAX_MEMBERS = 200_000
"""Files of an archive; ten times those of the longest recordings."""

_CONFIDENCE_MODES = ("L", *DEPTH_MODES)

_NOT_THE_USERS = "__MACOSX"
"""Folder that macOS adds to its archives."""


@dataclass(frozen=True)
class Archive:
    """Files by their names below the top of a capture; slashes separate folders."""

    path: Path
    """The folder or the archive."""

    top: str = ""
    """Folder in it where the capture begins, with a slash at its end; empty: it is all of it."""

    zipped: zipfile.ZipFile | None = None
    """The opened archive; None: a folder."""

    def where(self, name: str) -> Path:
        """Returns the path of a file, for messages; that of a member of an archive is no file."""
        return self.path / f"{self.top}{name}"

    def has(self, name: str) -> bool:
        """Returns True if there is a file of this name."""
        if self.zipped is None:
            return self.where(name).is_file()
        return self.top + name in self.zipped.NameToInfo

    def names(self, folder: str, suffix: str) -> list[str]:
        """Names of the files in a folder that end like this, sorted, without their suffix."""
        if self.zipped is None:
            place = self.where(folder)
            found = [p.name for p in place.iterdir()] if place.is_dir() else []
        else:
            start, members = f"{self.top}{folder}/", self.zipped.NameToInfo
            found = [name.removeprefix(start) for name in members if name.startswith(start)]
        return sorted(
            name.removesuffix(suffix)
            for name in found
            if name.endswith(suffix) and "/" not in name and not name.startswith(".")
        )

    def read(self, name: str, limit: int = _MAX_TEXT) -> bytes:
        """Reads a file of at most `limit` bytes.

        Raises:
            FormatError: missing, too large, or damaged.
        """
        with naming(self.where(name)):
            if self.zipped is None:
                return read_bytes(self.where(name), limit)
            return _unpack(self.zipped, self.top + name, limit)

    def json(self, name: str) -> Any:
        """Reads a JSON file.

        Raises:
            FormatError: missing, or not JSON.
        """
        data = self.read(name)
        with naming(self.where(name)):
            return parse_json(data)

    def rgb(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """Reads an image of this width and height, [H, W, 3] uint8.

        Raises:
            FormatError: missing, damaged, or of another size.
        """
        data = self.read(name, _MAX_IMAGE)
        with naming(self.where(name)):
            return image_pixels(data, IMAGE_FORMATS, size)

    def size(self, name: str) -> tuple[int, int]:
        """Reads the width and height of an image [px].

        Raises:
            FormatError: missing, or damaged.
        """
        data = self.read(name, _MAX_IMAGE)
        with naming(self.where(name)):
            return image_size(data, IMAGE_FORMATS)

    def depth_steps(self, name: str) -> np.ndarray:
        """Reads a depth image as it is stored, [h, w]; see `stored_depth`.

        Raises:
            FormatError: missing, damaged, or no depth image.
        """
        data = self.read(name, _MAX_IMAGE)
        with naming(self.where(name)):
            return stored_depth(data)

    def confidence(self, name: str) -> np.ndarray:
        """Reads an image of levels of confidence, [h, w] of whole numbers.

        Raises:
            FormatError: missing, damaged, or colored.
        """
        data, wanted = self.read(name, _MAX_IMAGE), "confidence must be a gray image"
        with naming(self.where(name)):
            return image_pixels(data, IMAGE_FORMATS, None, _CONFIDENCE_MODES, wanted)


def _unpack(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Reads one member, whose length must be the recorded one."""
    info = archive.NameToInfo.get(name)
    if info is None:
        raise ForeignFileError("the file is missing in the archive")
    if info.file_size > limit:
        raise ForeignFileError(
            f"it claims to unpack to {info.file_size >> 20} MiB, more than {limit >> 20} MiB: it "
            "is something else"
        )
    try:
        with archive.open(info) as file:
            return file.read(limit)
    except Exception as error:  # zlib, struct, passwords, methods that are not known, ...
        raise ForeignFileError(
            f"it cannot be unpacked ({error!s:.200}): copy the archive again"
        ) from None


def find_archive(path: Path, *marks: str) -> Archive | None:
    """Opens the folder or archive in which all these names are found, at its top or one below.

    Returns:
        None where they are not, or below more than one folder, or where there is no such folder
        or archive.

    Raises:
        FormatError: an archive that is damaged.
    """
    if path.is_dir():
        zipped = None
        below = sorted(p.name for p in path.iterdir() if not p.name.startswith("."))
        tops = {"", *(f"{name}/" for name in below)}
        for mark in marks:
            tops = {top for top in tops if (path / f"{top}{mark}").exists()}
    elif path.is_file() and path.suffix.lower() in SUFFIXES:
        zipped = open_zip(path)
        tops = set[str].intersection(*(_tops(zipped, mark) for mark in marks))
    else:
        return None
    if "" not in tops and len(tops) != 1:
        return None  # of several, the user has to choose
    return Archive(path, "" if "" in tops else tops.pop(), zipped)


def _tops(zipped: zipfile.ZipFile, mark: str) -> set[str]:
    """Finds where in an archive a file or a folder of this name is.

    It is at the top, or in a folder there.
    """
    found: set[str] = set()
    for name in zipped.NameToInfo:
        first, slash, rest = name.partition("/")
        below = {"": name, first + slash: rest} if slash else {"": name}
        found |= {top for top, it in below.items() if it == mark or it.startswith(f"{mark}/")}
    return {top for top in found if not top.startswith(_NOT_THE_USERS)}


def open_zip(path: Path) -> zipfile.ZipFile:
    """Opens a zip archive.

    Raises:
        FormatError: missing, or damaged.
    """
    with naming(path):
        check_regular(path)
        try:
            zipped = zipfile.ZipFile(path)
        except Exception as error:  # cut off, no archive, seeks before the beginning, ...
            raise ForeignFileError(
                f"this is not a complete zip archive ({error!s:.200}): copy or export it again"
            ) from None
        if len(zipped.NameToInfo) > _MAX_MEMBERS:
            raise ForeignFileError(
                f"the archive has {len(zipped.NameToInfo):,} files, more than {_MAX_MEMBERS:,}: "
                "unpack it and give its folder"
            )
        return zipped


def is_there(path: Path, *marks: str) -> bool:
    """Returns True if a folder or a whole archive holds these names, at its top or one below."""
    try:
        return find_archive(path, *marks) is not None
    except FormatError:
        return False


@dataclass(frozen=True)
class Shot:
    """One frame: names of its files in the archive, and what was read of it."""

    image: str
    depth: str
    confidence: str
    """Need not exist: then all depth counts."""

    lens: Lens
    """Lens of the color image."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4]: OpenCV axes."""


def complete_shots(
    archive: Archive, shots: Sequence[Shot], total: int, advice: str, *, images: bool = True
) -> tuple[list[Shot], str | None]:
    """Leaves out the frames without a depth image or an image.

    Args:
        archive: that holds them.
        shots: those that have a pose and a camera.
        total: how many frames the app lists.
        advice: what to do where no frame is left, a part of a sentence.
        images: False where the images are no files of the archive.

    Returns:
        The others, and a remark on how many are left out.

    Raises:
        FormatError: none is left.
    """
    kept = [
        shot
        for shot in shots
        if archive.has(shot.depth) and (not images or archive.has(shot.image))
    ]
    if not kept:
        raise FormatError(archive.path, advice)
    return kept, left_out(total - len(kept), total)


def confident_depth(archive: Archive, shot: Shot, best: int) -> np.ndarray:
    """Reads a depth image in millimeters, [h, w] float32 [m], where the sensor was sure.

    Raises:
        FormatError: a file is missing or damaged, or the sizes differ.
    """
    depth = MILLIMETERS.depth(archive.depth_steps(shot.depth))
    if not archive.has(shot.confidence):
        return depth
    levels = archive.confidence(shot.confidence)
    with naming(archive.where(shot.confidence)):
        return keep_confident(depth, levels, best)


def posed_images(
    archive: Archive,
    shots: Sequence[Shot],
    *,
    depth: Callable[[Shot], np.ndarray],
    rgb: Callable[[Shot], np.ndarray] | None = None,
    up: np.ndarray | None,
    remark: str | None,
    path: Path | None = None,
) -> PosedImages:
    """Joins frames to posed images.

    Args:
        archive: that holds their files.
        shots: at least one.
        depth: reads the depth of a frame, [h, w] float32.
        rgb: reads the colors of a frame, [H, W, 3] uint8; None: from its image in the archive.
        up: the vertical of their world, [3]; None: not known.
        remark: what is left out.
        path: what the capture is called in messages; None: as the archive.
    """
    chosen = list(shots)

    def from_archive(shot: Shot) -> np.ndarray:
        return archive.rgb(shot.image, (shot.lens.width, shot.lens.height))

    read = rgb or from_archive
    return PosedImages(
        path=path or archive.path,
        image_paths=tuple(archive.where(shot.image) for shot in chosen),
        lenses=tuple(shot.lens for shot in chosen),
        poses=np.stack([shot.pose for shot in chosen]),
        depth_paths=tuple(archive.where(shot.depth) for shot in chosen),
        pixels=Pixels(lambda index: read(chosen[index]), lambda index: depth(chosen[index])),
        up=up,
        remark=remark,
    )
