"""Numbered checkpoints in a folder: each whole or absent, and with the hash of all its files.

Orbax writes the arrays. Of what it wrote the SHA-256 of every file is kept in `sha256.json`; with
it in place the checkpoint gets its name, a number. A checkpoint without that file is of an
earlier version of this package, and read unchecked.

Of a checkpoint only the files are deleted that it lists; one of an earlier version holds what Orbax
writes.
"""

import errno
import glob
import hashlib
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from r3jax import files
from r3jax.files import is_link, remove, remove_own, sync_folder, whole_folder, write_atomic
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_relative, check_tree, read_bytes
from r3jax.validation.json_text import check_type, parse_json

Tables = Mapping[str, Mapping[str, np.ndarray]]
"""Named arrays, by table."""

_HASHES = "sha256.json"
_MAX_BYTES = 16 << 20
_ORBAX = "_CHECKPOINT_METADATA"
"""A file in every checkpoint, by which its folder is known."""

_STRAGGLING = 0.5
"""After an error Orbax's other threads write and report no longer than this [s]."""

_DIGITS = 6
_OF_ORBAX = (
    "_*",
    "manifest.ocdbt",
    "commit_success.txt",
    "d/*",
    "array_metadatas/*",
    "ocdbt.process_*/**/*",
)
"""Files of a checkpoint without hashes."""


def make_folder(folder: Path) -> None:
    """Makes the folder of checkpoints, and ends deletions that were cut off.

    Raises:
        OSError: it is a link, or cannot be made.
    """
    if is_link(folder):
        raise files.NotOursError(folder, "a folder of checkpoints must not be a link")
    files.make_folder(folder)
    for path in folder.glob("[0-9]*"):
        if _has_number(path) and (path / _HASHES).is_file() and not (path / _ORBAX).exists():
            discard(path)


def numbered(folder: Path) -> list[Path]:
    """Lists the checkpoints in a folder, oldest first."""
    if is_link(folder):
        return []
    found = [path for path in folder.glob("[0-9]*") if _is_checkpoint(path)]
    return sorted(found, key=lambda path: int(path.name))


def _is_checkpoint(path: Path) -> bool:
    return _has_number(path) and (path / _ORBAX).is_file()


def _has_number(path: Path) -> bool:
    is_number = path.name.isdecimal() and path.name.isascii() and len(path.name) >= _DIGITS
    return is_number and not is_link(path)


def discard(path: Path) -> None:
    """Deletes a checkpoint that `numbered` has named; what else lies in it stays.

    Raises:
        OSError: not permitted.
    """
    try:
        names = [glob.escape(name) for name in _read_hashes(path)] + [_HASHES]
    except (OSError, ForeignFileError):  # none are there, or they are damaged
        names = [*_OF_ORBAX, _HASHES]
    # First what tells a checkpoint: one that is half deleted must not look like one.
    remove(path / _ORBAX)
    remove_own(path.parent, [f"{path.name}/{name}" for name in names])


def write_checkpoint(path: Path, tables: Tables) -> None:
    """Writes one: it is there as a whole, or not at all.

    Args:
        path: a number in an existing folder, in which no other process writes.
        tables: the arrays.

    Raises:
        OSError: the disk is full, not writable, ...; or something of that name is there that is
            no checkpoint.
    """
    import orbax.checkpoint as ocp

    try:
        with whole_folder(path) as writing:
            with _quiet(), ocp.PyTreeCheckpointer() as checkpointer:
                checkpointer.save(writing.resolve(), dict(tables), force=True)
            _write_hashes(writing)
            if _is_checkpoint(path):
                discard(path)
        sync_folder(path.parent)
    except (ValueError, RuntimeError) as error:  # how Orbax's storage reports a full disk
        is_full = "RESOURCE_EXHAUSTED" in str(error) or "No space left" in str(error)
        reason = os.strerror(errno.ENOSPC) if is_full else " ".join(str(error).split())[:300]
        raise OSError(errno.ENOSPC if is_full else errno.EIO, reason, str(path)) from error


def _write_hashes(folder: Path) -> None:
    hashes = {name: _sha256(path) for name, path in _files(folder).items()}
    write_atomic(folder / _HASHES, json.dumps(hashes, indent=1, sort_keys=True).encode())


def _files(folder: Path) -> dict[str, Path]:
    files = (path for path in folder.rglob("*") if not path.is_dir())
    return {path.relative_to(folder).as_posix(): path for path in files if path.name != _HASHES}


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_arrays(path: Path) -> dict[str, Any]:
    """Reads the arrays of a checkpoint, nested as they were written.

    Raises:
        ForeignFileError: it is damaged, or cannot be read.
        OSError: it is not there, or not permitted.
    """
    import jax
    import orbax.checkpoint as ocp

    check_tree(path)
    _check_hashes(path)
    try:
        with _quiet(), ocp.PyTreeCheckpointer() as checkpointer:
            tree = checkpointer.metadata(path.resolve()).item_metadata.tree
            # NumPy: device arrays would cut 64-bit numbers short.
            as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
            args = ocp.args.PyTreeRestore(restore_args=as_numpy)
            arrays = checkpointer.restore(path.resolve(), args=args)
    except Exception as error:  # whatever a damaged file makes Orbax's storage raise
        raise ForeignFileError(" ".join(str(error).split())[:500]) from None
    if not isinstance(arrays, dict):
        raise ForeignFileError("it does not hold tables of arrays")
    return arrays


def _check_hashes(folder: Path) -> None:
    try:
        stored = _read_hashes(folder)
    except FileNotFoundError:
        return
    found = _files(folder)
    for name, sha256 in stored.items():
        if name not in found:
            raise ForeignFileError(f"{name[:80]} is missing")
        if _sha256(found[name]) != sha256:
            raise ForeignFileError(f"{name[:80]} is damaged: its SHA-256 is not the one kept")


def _read_hashes(folder: Path) -> dict[str, str]:
    stored = parse_json(read_bytes(folder / _HASHES, _MAX_BYTES))
    check_type(_HASHES, stored, dict[str, str])
    for name in stored:
        check_relative(name)
    return stored


@contextmanager
def _quiet() -> Generator[None]:
    """Keeps Orbax from printing tracebacks of an error that it also raises.

    An error leaves it when Orbax's other threads have ended: none of them writes any more.
    """
    log, hook = logging.getLogger("absl"), sys.unraisablehook
    level = log.level
    log.setLevel(logging.CRITICAL + 1)  # every thread of Orbax logs a traceback
    if not isinstance(hook, _WithoutLoops):
        sys.unraisablehook = _WithoutLoops(hook)
    try:
        yield
        sys.unraisablehook = hook
    except BaseException:
        time.sleep(_STRAGGLING)  # the hook stays, but is gone when the process ends
        raise
    finally:
        log.setLevel(level)


class _WithoutLoops:
    """Leaves out what arrays report that fail after the first one: Orbax has closed their loop."""

    def __init__(self, hook: Callable[[Any], Any]):
        """Stores the hook that receives everything else."""
        self._hook = hook

    def __call__(self, unraisable: Any) -> None:
        """Handles Python's `sys.unraisablehook`."""
        if str(unraisable.exc_value) != "Event loop is closed":
            self._hook(unraisable)
