"""A capture that another program is still writing, as a folder of only what is complete.

Readers refuse a folder whose numbers of images, depth images and poses differ, as they should. Of
a folder that grows, the frames that are there already are linked into a scratch folder, which is
read instead; in the folder itself nothing is written. Whether a linked image is whole shows when it
is read.
"""

import os
import time
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from r3jax.formats.recordings import is_recording

_IMAGES = (".png", ".jpg")
_SETTLED = 0.5
"""A last line without its end counts once the file has been left alone for so long [s]."""

_NUMBERS = 16
"""Of a pose."""


def stage(path: Path, scratch: Path) -> Path:
    """Links the complete frames of a growing capture.

    Args:
        path: the capture; nothing in it is changed.
        scratch: a folder of our own, the same from call to call.

    Returns:
        What to read: the scratch folder; or the capture itself where its format names every frame
        (a transforms.json), or is none that is known to grow.

    Raises:
        OSError: not permitted.
    """
    if is_recording(path):
        return _stage_recording(path, scratch)
    if path.is_dir() and any(path.glob("frame-*.color.*")):
        return _stage_numbered(path, scratch)
    return path


def _stage_recording(path: Path, scratch: Path) -> Path:
    """Images, depth images and lines of poses.txt belong together in their order."""
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
    """Names that certainly belong to the first poses.

    With as many names as poses all do. Otherwise, if names are numbers, only those before the
    first gap: a frame that is late would take another one's pose.
    """
    if len(stems) == poses or not all(stem.isdecimal() for stem in stems):
        return stems[:poses]
    numbers = [int(stem) for stem in stems]
    steps = [b - a for a, b in pairwise(numbers)]
    gap = next((i for i, step in enumerate(steps) if step > min(steps)), len(steps))
    return stems[: min(gap + 1, poses)]


def complete_lines(path: Path) -> list[str]:
    """Lines of a text of poses that are whole: 16 numbers and an end.

    Raises:
        OSError: not permitted.
    """
    text = path.read_text(errors="replace") if path.exists() else ""
    whole, _, rest = text.rpartition("\n")
    if rest.strip() and time.time() - path.stat().st_mtime > _SETTLED:
        whole = text
    lines = [line.strip() for line in whole.splitlines() if line.strip()]
    return [line for line in lines if len(line.split()) == _NUMBERS]


def _stage_numbered(path: Path, scratch: Path) -> Path:
    """Frames of 7-Scenes' layout: those with an image, a depth image and a pose."""
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
    """Makes a folder hold links to these files, and no others unless they are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {file.name: file for file in files}
    present = {entry.name for entry in os.scandir(folder) if entry.is_symlink()}
    for name in wanted.keys() - present:
        (folder / name).symlink_to(wanted[name].resolve())
    for name in () if keep else present - wanted.keys():
        (folder / name).unlink()
