"""The state of a training on disk, saved with Orbax, and the settings that it belongs to."""

import hashlib
import json
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.checkpoints import discard, make_folder, numbered, read_arrays, write_checkpoint
from r3jax.files import (
    clear_partial,
    disown_folder,
    is_link,
    lock_folder,
    own_folder,
    remove_own,
    write_atomic,
)
from r3jax.splatting.errors import CheckpointError
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train_step import TrainState
from r3jax.splatting.views import Views
from r3jax.validation.errors import ForeignFileError, check_version
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import parse_json

KEPT = 2
"""Older checkpoints are deleted."""

FORMAT_VERSION = 1
"""Raised whenever older checkpoints can no longer be read."""

_SETTINGS = "training.json"
_MAX_BYTES = 16 << 20


def settings_record(config: TrainConfig, views: Views, extent: float) -> dict[str, Any]:
    """Records what must not change when training resumes: settings, views and extent.

    The budget of intersections is left out: the result does not depend on it.
    """
    record = config.as_record()
    del record["raster"]["max_intersections"]
    digest = hashlib.sha256()
    for array in (views.rgb, views.T_world_camera, *jax.tree.leaves(views.cameras)):
        digest.update(np.ascontiguousarray(array).tobytes())
    seen = {"views": len(views), "width": views.width, "height": views.height}
    seen |= {"views_hash": digest.hexdigest(), "extent": extent}
    return {"format": FORMAT_VERSION} | seen | _flat(record)


def _flat(record: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flattens nested settings to one level, `raster.backend` for one inside another."""
    flat: dict[str, Any] = {}
    for name, value in record.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


@contextmanager
def only_training(folder: Path, *, is_new: bool) -> Generator[None]:
    """Locks the folder, so that no other process trains in it.

    Args:
        folder: of the checkpoints.
        is_new: make the folder.

    Raises:
        CheckpointError: another process does.
        OSError: the folder cannot be written, is a link, or holds something else.
    """
    if is_new:
        make_folder(folder)
    elif not numbered(folder):  # nothing is written into a folder that holds no training
        raise CheckpointError(folder, "there is no checkpoint to resume from")
    own_folder(folder, "training")
    try:
        lock = lock_folder(folder)
    except BlockingIOError:
        raise CheckpointError(folder, "another process is training here") from None
    with lock:
        clear_partial(folder)
        make_folder(folder)
        yield


def begin_checkpoints(folder: Path, settings: dict[str, Any], *, overwrite: bool = False) -> None:
    """Prepares a folder for a new training; with `overwrite`, deletes the one that is there.

    Raises:
        CheckpointError: there is a training already.
        OSError: the disk is full, not writable, ...
    """
    older = numbered(folder)
    if older and not overwrite:
        raise CheckpointError(
            folder,
            "a training was stored here already: resume it, overwrite it, or choose another folder",
        )
    for old in older:
        discard(old)
    make_folder(folder)
    write_atomic(folder / _SETTINGS, json.dumps(settings, indent=1).encode())


def save_checkpoint(folder: Path, state: TrainState) -> None:
    """Saves the state, then drops all but the newest two.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    tables = {"state": {name: np.asarray(leaf) for name, leaf in _named(state).items()}}
    write_checkpoint(folder / f"{int(state.step):07d}", tables)
    for old in numbered(folder)[:-KEPT]:
        discard(old)


def remove_checkpoints(folder: Path) -> None:
    """Deletes a training's checkpoints, and the folder if it holds nothing else; never a link.

    Raises:
        OSError: a checkpoint cannot be deleted.
    """
    if is_link(folder):
        return
    for old in numbered(folder):
        discard(old)
    disown_folder(folder)
    remove_own(folder.parent, [f"{folder.name}/{name}" for name in (_SETTINGS, "lock")])


def _named(state: Any) -> dict[str, Any]:
    """Names the arrays of a state (or of nested tables), such as `scene.means`."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def read_checkpoint(folder: Path, settings: dict[str, Any], like: TrainState) -> TrainState:
    """Reads the newest state of a training with these settings.

    Args:
        folder: where it was saved.
        settings: of the training that is to go on; see `settings_record`.
        like: a state of the same shapes; its values are not used.

    Returns:
        The newest one that is whole: a damaged one costs the steps since the one before.

    Raises:
        CheckpointError: there is none, it belongs to other settings (the message names them), or
            none can be read.
    """
    _check_settings(folder, settings)
    failure = CheckpointError(folder, "there is no checkpoint to resume from")
    for path in reversed(numbered(folder)):
        try:
            return _state_of(read_arrays(path), like)
        except (OSError, ForeignFileError) as error:
            failure = CheckpointError(
                path, f"cannot be read ({error}), nor any before it: overwrite it to start again"
            )
    raise failure


def _state_of(stored: dict[str, Any], like: TrainState) -> TrainState:
    """Builds a state from its arrays. Earlier versions of this package nested them, by field.

    Raises:
        ForeignFileError: arrays that are missing or of another shape, and numbers that no
            training would have gone on with.
    """
    arrays = {name.removeprefix("state."): x for name, x in _named(stored).items()}
    leaves: list[jax.Array] = []
    for name, wanted in _named(like).items():
        leaf = arrays.get(name)
        if leaf is None or leaf.shape != wanted.shape or leaf.dtype != wanted.dtype:
            found = "missing" if leaf is None else f"{leaf.dtype}{leaf.shape}"
            raise ForeignFileError(f"{name} is {found}, not {wanted.dtype}{wanted.shape}")
        if not np.isfinite(leaf).all():
            raise ForeignFileError(f"{name} has numbers that are not finite")
        leaves.append(jnp.array(leaf))  # a copy: training gives its buffers away
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _check_settings(folder: Path, settings: dict[str, Any]) -> None:
    path = folder / _SETTINGS
    try:
        stored = parse_json(read_bytes(path, _MAX_BYTES))
        if not isinstance(stored, dict):
            raise ForeignFileError("not a table of settings")
        check_version(stored.get("format"), FORMAT_VERSION)
    except (OSError, ValueError) as error:
        raise CheckpointError(path, f"cannot be read ({error})") from None
    names = sorted(stored.keys() | settings.keys())
    changed = [
        f"{name} (stored {stored.get(name)}, now {settings.get(name)})"
        for name in names
        if stored.get(name) != settings.get(name)
    ]
    if changed:
        raise CheckpointError(
            folder, f"the checkpoint is of another training: {', '.join(changed):.1000} differ"
        )
