"""The folder of a trained model: its Gaussians, and the record of its training.

models/NAME/
scene.ply      the Gaussians
points.ply     their centers, for programs that show points (`r3jax train` writes it)
history.csv    loss, PSNR and size at every step
train.json     views, settings, versions; sealed
checkpoints/   where an interrupted training goes on
"""

import contextlib
import csv
import hashlib
import io
import json
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.files import (
    MARKER,
    check_own,
    clear_partial,
    lock_folder,
    own_folder,
    write_atomic,
)
from r3jax.kernels.constants import SH0
from r3jax.splatting.errors import SceneFileError
from r3jax.splatting.ply import write_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import FitResult, History
from r3jax.splatting.views import Views
from r3jax.validation.errors import ForeignFileError, check_version
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_type, parse_json, sealed, unsealed

RECORD_FORMAT = 1
"""Format version of train.json."""

_MAX_BYTES = 64 << 20

_KINDS = {
    "data": str,
    "resolution": int,
    "train_views": list[int],
    "test_views": list[int],
    "config": dict[str, Any],
}
"""The fields used of train.json."""


@dataclass(frozen=True)
class TrainedModel:
    """A model, and the record of its training."""

    path: Path
    """The PLY file."""

    record: dict[str, Any]
    """The content of train.json; empty if there is none."""

    is_here: bool
    """True if the model was trained on the given capture."""

    @property
    def train_views(self) -> list[int] | None:
        """Numbers of the views trained on, in the capture; None if not known."""
        return self.record.get("train_views") if self.is_here else None

    @property
    def background(self) -> np.ndarray:
        """Background color of the training [3]; black if it was random."""
        is_white = self.record.get("config", {}).get("background") == "white"
        return np.full(3, 1.0 if is_white else 0.0, dtype=np.float32)


def find_model(
    models: Path, data: Path, name: str = "last", path: Path | None = None
) -> TrainedModel:
    """Finds a model of a capture and reads its record.

    Args:
        models: folder of the capture's models.
        data: the capture.
        name: the model's name among them.
        path: the model's file or folder, if it lies elsewhere.

    Raises:
        SceneFileError: there is no such model, or its train.json is damaged.
    """
    model = path or models / name / "scene.ply"
    if model.is_dir():
        model = model / "scene.ply"
    if not model.is_file():
        found = sorted(path.parent.name for path in models.glob("*/scene.ply"))
        known = f"there are: {', '.join(found)} (--name)" if found else "there is none yet"
        raise SceneFileError(
            model, f"there is no such model; {known}; `r3jax train {data}` makes one"
        )
    source = model.parent / "train.json"
    try:
        record = _read_record(source) if source.exists() else {}
    except (ForeignFileError, OSError) as error:
        raise SceneFileError(source, f"the file cannot be read ({error})") from error
    is_inside = models.resolve() in model.resolve().parents
    is_same = "data" in record and Path(record["data"]).resolve() == data.resolve()
    return TrainedModel(model, record, bool(record) and (is_inside or is_same))


def newest_name(models: Path) -> str | None:
    """Finds the default model: `last`, else the newest, else None."""
    found = sorted(models.glob("*/scene.ply"), key=lambda path: path.stat().st_mtime)
    names = [path.parent.name for path in found]
    return "last" if "last" in names else next(reversed(names), None)


def _read_record(path: Path) -> dict[str, Any]:
    """Reads train.json, and checks the fields that are used.

    Raises:
        ForeignFileError: it is damaged.
        OSError: it cannot be read.
    """
    record = parse_json(read_bytes(path, _MAX_BYTES))
    check_type("train.json", record, dict[str, Any])
    check_version(record.get("format", 1), RECORD_FORMAT)  # the first ones did not say
    record = unsealed(record)
    for name, kind in _KINDS.items():
        if name in record:
            check_type(name, record[name], kind)
    for name in ("train_views", "test_views"):
        if min(record.get(name, ()), default=0) < 0:
            raise ForeignFileError(f"`{name}` holds a negative number")
    if record.get("resolution", 1) < 1 or "\0" in record.get("data", ""):
        raise ForeignFileError("`resolution` or `data` is invalid")
    return record


def check_free(folder: Path, *, replace: bool) -> None:
    """Refuses a folder with a model, unless it may be changed, or one that is not a model's.

    Raises:
        SceneFileError: a model.
        NotOursError: something else.
    """
    check_own(folder, "model", "give another --name")
    present = {path.name for path in folder.iterdir()} if folder.is_dir() else set[str]()
    if present - {"lock", MARKER} and not replace:
        raise SceneFileError(
            folder,
            "this holds a model: --resume goes on with it, --overwrite replaces it, "
            "--name NAME makes another",
        )


@contextlib.contextmanager
def only_writer(folder: Path, *, replace: bool) -> Generator[None]:
    """Makes the folder, and locks it against other processes.

    Raises:
        SceneFileError: another process is training here, or see `check_free`.
        OSError: the folder cannot be made, or a link is in the way.
    """
    own_folder(folder, "model", "give another --name")
    try:
        lock = lock_folder(folder)
    except BlockingIOError:
        raise SceneFileError(folder, "another process is training here") from None
    with lock:
        check_free(folder, replace=replace)  # another process may have been faster
        clear_partial(folder)
        yield


def write_model(
    folder: Path,
    result: FitResult,
    data: Path,
    views: Views,
    split: tuple[np.ndarray, np.ndarray],
    config: TrainConfig,
    packages: dict[str, str],
) -> None:
    """Writes the Gaussians, the history and train.json.

    Args:
        folder: where to.
        result: of the training.
        data: the capture trained on.
        views: the views trained on.
        split: numbers of the views trained on, and of those held out.
        config: settings of the training.
        packages: versions of the software.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    write_scene(folder / "scene.ply", result.scene)
    history = _history_csv(result.history)
    write_atomic(folder / "history.csv", history)
    training, held_out = split
    record = {
        "format": RECORD_FORMAT,
        "data": str(data),
        "resolution": max(views.width, views.height),
        "train_views": training.tolist(),
        "test_views": held_out.tolist(),
        "config": config.as_record(),
        "packages": packages,
        "history_sha256": hashlib.sha256(history).hexdigest(),
    }
    # Last: the files that train.json describes exist.
    write_atomic(folder / "train.json", json.dumps(sealed(record), indent=1).encode())


def _history_csv(history: History) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["step", "loss", "psnr", "gaussians"])
    for i, (loss, psnr, count) in enumerate(
        zip(history.loss, history.psnr, history.num_gaussians, strict=True)
    ):
        writer.writerow([history.first_step + i, f"{loss:.6g}", f"{psnr:.4f}", int(count)])
    return text.getvalue().encode()


def scene_points(scene: GaussianScene) -> tuple[np.ndarray, np.ndarray]:
    """Returns centers [m] and mean colors (uint8) of the used Gaussians, [n, 3] each."""
    alive = np.asarray(scene.is_alive)
    colors = np.clip(np.asarray(scene.sh)[alive, 0] * SH0 + 0.5, 0.0, 1.0)
    return np.asarray(scene.means)[alive], np.round(255.0 * colors).astype(np.uint8)
