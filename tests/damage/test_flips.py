"""Every sealed file cut short and with single bits turned round, one at a time.

Whatever is read back is what was written, or is refused by the reader's own error. What a run costs
that goes on from a damaged file is tested where it resumes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from r3jax.apps.benchmark.record import read_records, write_records
from r3jax.captures.camera_paths import read_camera_path, write_camera_path
from r3jax.errors import InputError
from r3jax.formats.errors import FormatError
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.state import empty_map
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from r3jax.runs.rows import to_json
from r3jax.runs.stored_states import CheckpointWriter, load_checkpoint, map_tables
from r3jax.runs.writer import RunWriter
from r3jax.splatting.errors import CheckpointError, SceneFileError
from r3jax.splatting.ply import read_scene, write_scene
from r3jax.splatting.training import checkpoints as training
from r3jax.splatting.training.train_step import start_state
from tests.evaluation.records import record
from tests.runs.runs import make_header, make_view
from tests.splatting.clouds import random_cloud
from tests.tiers import quick_and_full

FLIPS = 12
"""Of every file, beside two cuts."""


def leaves(tree: Any) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def write_run(folder: Path) -> None:
    with RunWriter(folder, make_header()) as writer:
        for step in range(3):
            writer.add(*make_view(step))
            writer.add_timings(step, {"plan": 0.5})
        writer.finish("budget", "enough")


def rows_of(folder: Path) -> Any:
    run = read_run(folder)
    end = "" if run.end is None else to_json(run.end)
    timings = {str(line) for line in run.timings}
    return run.header, [to_json(row) for row in run.rows], end, timings


def is_part(found: Any, whole: Any) -> bool:
    """A run that was cut off has its first rows and no end; timings are by-products."""
    header, rows, end, timings = found
    is_begun = header == whole[0] and rows == whole[1][: len(rows)]
    return is_begun and end in ("", whole[2]) and timings <= whole[3]


def write_checkpoint(folder: Path) -> None:
    writer = CheckpointWriter(folder)
    writer.save(3, map_tables(empty_map(64), empty_grid(np.array([[0.0] * 3, [1.0] * 3]))))
    writer.close()


def write_training(folder: Path) -> None:
    training.begin_checkpoints(folder, SETTINGS)
    training.save_checkpoint(folder, start_state(random_cloud(0, 6)))


def read_training(folder: Path) -> list[bytes]:
    like = start_state(random_cloud(1, 6))
    return leaves(training.read_checkpoint(folder, SETTINGS, like))


def read_path(folder: Path) -> Any:
    found = read_camera_path(folder / "path.json")
    return np.asarray(found.poses).tolist(), found.lenses


SETTINGS = {"format": training.FORMAT_VERSION, "extent": 1.5}
LENS = Camera.from_fov(48, 36, 60.0)


@dataclass(frozen=True)
class Sealed:
    """Files with seals or hashes."""

    write: Callable[[Path], object]
    read: Callable[[Path], Any]
    error: type[Exception]
    agrees: Callable[[Any, Any], bool] = lambda found, whole: found == whole


TABLE = {
    "run": Sealed(write_run, rows_of, RunError, is_part),
    "images": Sealed(write_run, lambda at: leaves(list(read_run(at).frames())), RunError,
                     lambda found, whole: found == whole[: len(found)]),
    "run checkpoint": Sealed(
        write_checkpoint, lambda at: leaves(load_checkpoint(at, 3)), RunError
    ),
    "training checkpoint": Sealed(write_training, read_training, CheckpointError),
    "splats": Sealed(lambda at: write_scene(at / "scene.ply", random_cloud(0, 6)),
                     lambda at: leaves(read_scene(at / "scene.ply")), SceneFileError),
    "records": Sealed(lambda at: write_records(at / "r.jsonl", [record(seed=s) for s in (0, 1)]),
                      lambda at: read_records(at / "r.jsonl"), InputError,
                      lambda found, whole: found == whole[: len(found)]),
    "camera path": Sealed(
        lambda at: write_camera_path(at / "path.json", np.stack([np.eye(4)] * 2), LENS),
        read_path, FormatError,
    ),
}  # fmt: skip


def damaged(data: bytes, rng: np.random.Generator) -> list[bytes]:
    found = [data[: len(data) // 2], data[:-1]]
    for bit in rng.integers(8 * len(data), size=FLIPS):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        found.append(bytes(flipped))
    return found


@pytest.mark.parametrize("name", quick_and_full(TABLE, ["run", "records", "splats"]))
def test_damage_is_refused_or_without_effect(name, tmp_path):
    sealed, rng = TABLE[name], np.random.default_rng(0)
    sealed.write(tmp_path)
    whole, refusals = sealed.read(tmp_path), 0
    for path in sorted(path for path in tmp_path.rglob("*") if path.is_file()):
        data = path.read_bytes()
        for case in damaged(data, rng) if data else ():
            path.write_bytes(case)
            try:
                found = sealed.read(tmp_path)
            except sealed.error:
                refusals += 1
                continue
            assert sealed.agrees(found, whole), path.name
        path.write_bytes(data)
    assert refusals > FLIPS // 2
