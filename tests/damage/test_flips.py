"""Every file of a run and of its model, cut short and with single bits turned round, one at a time.

Whatever is read back afterwards is what was written, or is refused; a run resumed from the
rest is the undamaged one. With the counts: `pytest -m slow -s tests/damage/test_flips.py`.
"""

import json
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

from r3jax.apps.report.model_report import read_evaluated_model
from r3jax.cli.main import main
from r3jax.exploration import explore
from r3jax.runs.reader import read_run
from r3jax.runs.rows import to_json
from r3jax.runs.settings import open_run_scene, settings_of_run
from r3jax.runs.stored_states import state_tables
from r3jax.splatting.model import find_model
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import empty_scene
from r3jax.splatting.training.checkpoints import read_checkpoint, settings_record
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import scene_extent
from r3jax.splatting.training.train_step import start_state
from r3jax.splatting.views import load_views, split_views
from tests.box_room import write_room
from tests.cli import small_runs

pytestmark = pytest.mark.slow

FLIPS = 6
"""Of every file, and two cuts."""


class Reading:
    """Everything that the package reads back from a run folder, part by part."""

    def __init__(self, run: Path):
        """Reads what does not change: the scene and the plan."""
        self.path, self.recorded = run, read_run(run)
        self.plan = settings_of_run(self.recorded)
        self.simulator = open_run_scene(self.recorded)
        config = find_model(run / "models", run).record["config"]
        views, _ = split_views(len(self.recorded.rows), 4)
        self.views = load_views(self.recorded.frames(), 48).take(views)
        self.config = TrainConfig(iterations=20, num_gaussians=200, capacity=config["capacity"])
        self.like = jax.eval_shape(
            lambda: start_state(empty_scene(self.config.rows, self.config.sh_degree))
        )

    def trace(self) -> object:
        """Header and rows."""
        run = read_run(self.path)
        return repr(run.header), [to_json(row) for row in run.rows]

    def end(self) -> object:
        """How it ended: lost with the last line, and then it says so."""
        run = read_run(self.path)
        return None if run.end is None and "cut off" in run.outcome else run.outcome

    def timings(self) -> object:
        """By-products: a line that is damaged is left out."""
        return [str(line) for line in read_run(self.path).timings]

    def frames(self) -> object:
        """Pixels and poses."""
        return [leaf.tobytes() for f in read_run(self.path).frames() for leaf in jax.tree.leaves(f)]

    def checkpoint(self) -> object:
        """The newest map and grid."""
        return _bytes(read_run(self.path).checkpoint())

    def resumed(self) -> object:
        """The last state of the run that goes on from what is there."""
        run = read_run(self.path)
        result = explore(
            self.simulator,
            self.plan.policy,
            budget=self.plan.budget,
            seed=run.header.seed,
            config=self.plan.config,
            resume=run,
        )
        tables = state_tables(result.state)
        return {f"{t}.{n}": x.tobytes() for t in tables for n, x in tables[t].items()}

    def model(self) -> object:
        """The trained Gaussians."""
        return _bytes(read_scene(self.path / "models" / "last" / "scene.ply"))

    def training(self) -> object:
        """What is known of the training."""
        return repr(find_model(self.path / "models", self.path))

    def training_state(self) -> object:
        """What a resumed training goes on from."""
        folder = self.path / "models" / "last" / "checkpoints"
        settings = settings_record(self.config, self.views, scene_extent(self.views))
        return _bytes(read_checkpoint(folder, settings, self.like))

    def judged(self) -> object:
        """The evaluation that the report shows."""
        return repr(read_evaluated_model(read_run(self.path)))


PARTS = [name for name in vars(Reading) if not name.startswith("_")]


OF_MODELS = ["model", "training", "training_state", "judged"]


def _readers(name: str) -> list[str]:
    """The parts that may depend on a file."""
    if name.startswith(("models/", "report/")):
        return OF_MODELS
    return [part for part in PARTS if part not in OF_MODELS]


def _bytes(tree) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def _agrees(part: str, found: object, whole: object) -> bool:
    if part == "end":
        return found in (None, whole)
    if part == "timings":
        return set(found) <= set(whole)  # pyright: ignore
    if part == "trace":  # cut short: the rows of a run that was cut off
        return found[0] == whole[0] and found[1] == whole[1][: len(found[1])]  # pyright: ignore
    if part == "frames":
        return found == whole[: len(found)]  # pyright: ignore
    return found == whole


def _damaged(data: bytes, rng: np.random.Generator) -> list[tuple[str, bytes]]:
    cases = [("cut", data[: len(data) // 2]), ("cut", data[:-1])] if data else []
    for bit in rng.integers(8 * len(data), size=FLIPS) if data else ():
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        cases.append((f"bit {bit}", bytes(flipped)))
    return cases


@pytest.fixture
def run(tmp_path):
    room = write_room(tmp_path / "room.ply")
    assert small_runs.explore(room, tmp_path, "--budget", "views:6") == 0
    path = tmp_path / "box"
    words = ["--iterations", "20", "--gaussians", "200", "--hold-out", "4", "--resolution", "48"]
    assert main(["train", str(path), *words]) == 0
    assert main(["evaluate", str(path), "--lpips", "none"]) == 0
    return path


def test_damage_is_refused_repaired_or_without_effect(run):
    reading, rng = Reading(run), np.random.default_rng(0)
    whole = {part: getattr(reading, part)() for part in PARTS}
    counts, believed = Counter[str](), []
    for path in sorted(path for path in run.rglob("*") if path.is_file()):
        data = path.read_bytes()
        name = path.relative_to(run).as_posix()
        for how, damaged in _damaged(data, rng):
            path.write_bytes(damaged)
            refused = 0
            for part in _readers(name):
                try:
                    found = getattr(reading, part)()
                except (ValueError, OSError):
                    refused += 1
                    continue
                if not _agrees(part, found, whole[part]):
                    believed.append(f"{name}, {how}: {part}")
            kind = "cuts" if how == "cut" else "flips"
            counts[f"{kind} refused" if refused else f"{kind} without effect"] += 1
        path.write_bytes(data)
    files = sum(path.is_file() for path in run.rglob("*"))
    print("\n" + json.dumps({"files": files, **counts}))
    assert not believed, believed
    assert {part: getattr(reading, part)() for part in PARTS} == whole
