"""A small tree of files in memory, and how it gets onto the disk."""

import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Folder:
    """A folder where a file is expected."""


@dataclass(frozen=True)
class Fifo:
    """A pipe nobody writes to: opening it blocks."""


@dataclass(frozen=True)
class Link:
    """A symbolic link."""

    target: str


Entry = bytes | Folder | Fifo | Link
Files = Mapping[str, Entry]


def lay_out(folder: Path, files: Files) -> None:
    """Writes the tree into a fresh folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, entry in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(entry, bytes):
            path.write_bytes(entry)
        elif isinstance(entry, Folder):
            path.mkdir()
        elif isinstance(entry, Fifo):
            os.mkfifo(path)
        else:
            path.symlink_to(entry.target)


def unsealed(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Without seals and hashes, as earlier versions wrote them: those would refuse all damage."""
    pattern = rb',\s*"seal": ?"[0-9a-f]{64}"|(?<=\n)comment sha256 [0-9a-f]{64}\n'
    return {
        name: re.sub(pattern, b"", data)
        for name, data in files.items()
        if not name.endswith("sha256.json")
    }


def pick_up(folder: Path) -> dict[str, bytes]:
    """The files below a folder: inverse of `lay_out`."""
    found = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in found}
