"""The state of a training on disk, saved with Orbax, and the settings that it belongs to."""

import hashlib
import json
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from r3jax.files import lock_folder, write_atomic
from r3jax.foreign.errors import ForeignFileError
from r3jax.foreign.files import check_tree, read_bytes
from r3jax.foreign.json_text import parse_json
from r3jax.foreign.versions import check_version
from r3jax.splatting.errors import CheckpointError
from r3jax.splatting.train_step import TrainState
from r3jax.splatting.training_config import TrainConfig
from r3jax.splatting.views import Views

KEPT = 2
"""Older checkpoints are deleted."""

FORMAT_VERSION = 1
"""Raised whenever older checkpoints can no longer be read."""

_SETTINGS = "training.json"
_MAX_BYTES = 16 << 20


def settings_record(config: TrainConfig, views: Views, extent: float) -> dict[str, Any]:
    """What must be the same for a training to go on: settings, views and extent.

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
    """Nested settings as one level, `raster.backend` for one inside another."""
    flat: dict[str, Any] = {}
    for name, value in record.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


@contextmanager
def only_training(folder: Path, *, is_new: bool) -> Generator[None]:
    """Within it no other process trains in the folder.

    Args:
        folder: of the checkpoints.
        is_new: make the folder.

    Raises:
        CheckpointError: another process does.
        OSError: the folder cannot be written.
    """
    if is_new:
        folder.mkdir(parents=True, exist_ok=True)
    else:
        _newest(folder)  # nothing is written into a folder that holds no training
    try:
        lock = lock_folder(folder)
    except BlockingIOError:
        raise CheckpointError(folder, "another process is training here") from None
    with lock:
        yield


def begin_checkpoints(folder: Path, settings: dict[str, Any], *, overwrite: bool = False) -> None:
    """Prepares a folder for a new training; with `overwrite`, deletes the one that is there.

    Raises:
        CheckpointError: there is a training already.
        OSError: the disk is full, not writable, ...
    """
    older = _checkpoints(folder)
    if older and not overwrite:
        raise CheckpointError(
            folder,
            "a training was stored here already: resume it, overwrite it, or choose another folder",
        )
    for old in older:
        shutil.rmtree(old)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / _SETTINGS, json.dumps(settings, indent=1).encode())


def save_checkpoint(folder: Path, state: TrainState) -> None:
    """Saves the state, then drops all but the newest two.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        # Orbax writes under a temporary name and renames: a checkpoint is whole or absent.
        checkpointer.save((folder / f"{int(state.step):07d}").resolve(), state, force=True)
        checkpointer.wait_until_finished()
    for old in _checkpoints(folder)[:-KEPT]:
        shutil.rmtree(old)


def _checkpoints(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("[0-9]*") if p.is_dir() and p.name.isdigit())


def _newest(folder: Path) -> Path:
    found = _checkpoints(folder)
    if not found:
        raise CheckpointError(folder, "there is no checkpoint to resume from")
    return found[-1]


def read_checkpoint(folder: Path, settings: dict[str, Any], like: TrainState) -> TrainState:
    """The newest state of a training with these settings.

    Args:
        folder: where it was saved.
        settings: of the training that is to go on; see `settings_record`.
        like: a state of the same shapes; its values are not used.

    Raises:
        CheckpointError: there is none, it belongs to other settings (the message names them), or
            it cannot be read.
    """
    import orbax.checkpoint as ocp

    newest = _newest(folder)
    _check_settings(folder, settings)
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    to_shape: Callable[[jax.Array], jax.ShapeDtypeStruct] = lambda x: jax.ShapeDtypeStruct(
        x.shape, x.dtype, sharding=sharding
    )
    try:
        check_tree(newest)
        with ocp.StandardCheckpointer() as checkpointer:
            state = checkpointer.restore(newest.resolve(), jax.tree.map(to_shape, like))
        _check_state(state, like)
    except Exception as error:  # whatever a damaged file makes Orbax's storage raise
        raise CheckpointError(
            newest, f"cannot be read ({error!s:.500}); delete it to fall back on the one before"
        ) from None
    return state


def _check_state(state: TrainState, like: TrainState) -> None:
    """Refuses a state of other shapes, and numbers that no training would have gone on with."""
    for (path, leaf), wanted in zip(
        jax.tree_util.tree_leaves_with_path(state), jax.tree.leaves(like), strict=True
    ):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if leaf.shape != wanted.shape or leaf.dtype != wanted.dtype:
            raise ForeignFileError(f"{name} is {leaf.dtype}{leaf.shape}, not {wanted.shape}")
        if not np.isfinite(leaf).all():
            raise ForeignFileError(f"{name} has numbers that are not finite")


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
