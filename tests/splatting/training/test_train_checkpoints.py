"""A training that was interrupted goes on as if it had not been."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from r3jax.files import lock_folder
from r3jax.splatting.errors import CheckpointError
from r3jax.splatting.ply import write_scene
from r3jax.splatting.scene import empty_scene
from r3jax.splatting.training.checkpoints import (
    begin_checkpoints,
    read_checkpoint,
    remove_checkpoints,
)
from r3jax.splatting.training.train import fit
from r3jax.splatting.training.train_step import start_state
from tests.splatting.ball import ROOMY, ball_views, config


def interrupt_at(step: int):
    def on_progress(progress):
        if progress.step >= step:
            signal.raise_signal(signal.SIGINT)

    return on_progress


@pytest.fixture(scope="module")
def views():
    return ball_views()


@pytest.fixture(scope="module")
def interrupted(views, tmp_path_factory):
    """A folder with a training that Ctrl-C ended after 20 of 40 steps."""
    folder = tmp_path_factory.mktemp("interrupted")
    result = fit(views, config(), folder=folder, checkpoint_every=12, on_progress=interrupt_at(20))
    assert result.interrupted
    return folder


@pytest.fixture
def folder(interrupted, tmp_path):
    """A copy of it to go on with."""
    return shutil.copytree(interrupted, tmp_path / "copy")


@pytest.mark.parametrize("strategy", ["vanilla", "mcmc"])
def test_resumed_equals_uninterrupted_bit_for_bit(views, tmp_path, strategy):
    settings = config(strategy=strategy, background="random")
    whole = fit(views, settings)
    first = fit(views, settings, folder=tmp_path, on_progress=interrupt_at(17))
    second = fit(views, settings, folder=tmp_path, resume=True)
    assert second.history.first_step == len(first.history.loss) + 1 < 40
    jax.tree.map(np.testing.assert_array_equal, second.scene, whole.scene)
    losses = np.concatenate([first.history.loss, second.history.loss])
    np.testing.assert_array_equal(losses, whole.history.loss)
    assert second.dropped == whole.dropped


def test_the_newest_two_are_kept_and_an_end_is_always_saved(views, interrupted, folder):
    names = lambda: sorted(p.name for p in folder.iterdir() if p.name.isdecimal())
    assert names() == ["0000012", "0000020"]
    result = fit(views, config(), folder=folder, resume=True, checkpoint_every=12)
    assert not result.interrupted
    assert names() == ["0000036", "0000040"]
    again = fit(views, config(), folder=folder, resume=True)
    assert len(again.history.loss) == 0
    jax.tree.map(np.testing.assert_array_equal, again.scene, result.scene)


def test_another_budget_may_resume_but_other_settings_are_named(views, folder):
    changed = config(rate_sh=1e-3, iterations=50)
    with pytest.raises(CheckpointError, match=r"iterations.*40.*50.*rate_sh"):
        fit(views, changed, folder=folder, resume=True)
    other = views.take(np.arange(7))
    with pytest.raises(CheckpointError, match=r"views.*8.*7"):
        fit(other, config(), folder=folder, resume=True)
    fit(views, config(raster=type(ROOMY)(backend="numba")), folder=folder, resume=True)


def test_a_new_training_does_not_bury_an_old_one(views, folder):
    with pytest.raises(CheckpointError, match="overwrite"):
        fit(views, config(), folder=folder)


@pytest.mark.parametrize("how", [{"resume": True}, {"overwrite": True}])
def test_two_processes_cannot_train_in_one_folder(views, folder, how):
    before = sorted(folder.rglob("*"))
    with lock_folder(folder), pytest.raises(CheckpointError):
        fit(views, config(), folder=folder, **how)
    assert sorted(folder.rglob("*")) == before


def test_nothing_to_resume_from(views, tmp_path):
    with pytest.raises(CheckpointError):
        fit(views, config(), folder=tmp_path, resume=True)


def damage(path):
    """Turns one bit of the largest file round."""
    largest = max((p for p in path.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 8
    largest.write_bytes(data)


def test_a_damaged_checkpoint_costs_the_steps_since_the_one_before(views, folder):
    damage(folder / "0000020")
    result = fit(views, config(), folder=folder, resume=True)
    assert result.history.first_step == 13
    jax.tree.map(np.testing.assert_array_equal, result.scene, fit(views, config()).scene)


def test_what_cannot_be_read_is_named(views, folder):
    for name in ("0000012", "0000020"):
        damage(folder / name)
    with pytest.raises(CheckpointError, match=r"0000012.*SHA-256"):
        fit(views, config(), folder=folder, resume=True)


def test_nothing_of_the_user_is_deleted(views, folder, tmp_path):
    mine = [folder / "2019" / "photo", folder / "0000099" / "photo", tmp_path / "victim" / "photo"]
    for path in mine:
        path.parent.mkdir()
        path.touch()
    (folder / "0000098").symlink_to(tmp_path / "victim")
    begin_checkpoints(folder, {}, overwrite=True)
    remove_checkpoints(folder)
    assert all(path.exists() for path in mine)
    assert sorted(path.name for path in folder.iterdir()) == ["0000098", "0000099", "2019"]
    (tmp_path / "link").symlink_to(tmp_path / "victim")
    with pytest.raises(OSError, match="link"):
        fit(views, config(), folder=tmp_path / "link")
    assert mine[2].exists()


def test_a_checkpoint_of_an_earlier_version_is_read(tmp_path):
    """Its arrays were nested, and nothing was hashed."""
    state = start_state(empty_scene(8, 1))
    begin_checkpoints(tmp_path, {"format": 1})
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "0000000", state)
        checkpointer.wait_until_finished()
    back = read_checkpoint(tmp_path, {"format": 1}, state)
    jax.tree.map(np.testing.assert_array_equal, back, state)


@pytest.mark.parametrize("text", ["", "[]", '{"format":'])
def test_settings_that_cannot_be_read_are_named(views, folder, text):
    (folder / "training.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"training\.json"):
        fit(views, config(), folder=folder, resume=True)


def test_settings_are_stored_as_plain_numbers(folder):
    stored = json.loads((folder / "training.json").read_text())
    assert stored["iterations"] == 40
    assert stored["raster.backend"] == "numba"
    assert "raster.max_intersections" not in stored


def test_a_training_of_a_later_version_is_told_as_such(views, folder):
    path = folder / "training.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 2}))
    with pytest.raises(CheckpointError, match="newer"):
        fit(views, config(), folder=folder, resume=True)


def _start(folder):
    command = [sys.executable, "-m", "tests.splatting.training.killed_training", str(folder)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def _saved(folder):
    return {path.name for path in folder.glob("checkpoints/[0-9]*") if path.name.isdigit()}


@pytest.mark.parametrize(
    "kills", [pytest.param(2, marks=pytest.mark.full), pytest.param(30, marks=pytest.mark.slow)]
)
def test_a_training_survives_kills_at_random_moments(views, tmp_path, kills):
    rng, steps = random.Random(kills), []
    for _ in range(kills):
        process = _start(tmp_path)
        before = _saved(tmp_path)
        while process.poll() is None and _saved(tmp_path) <= before:
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, 1.0))
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
        steps.append(max(map(int, _saved(tmp_path))))
    assert steps == sorted(steps)  # what was reached is never lost
    process = _start(tmp_path)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    whole = fit(views, config(background="random"))
    write_scene(tmp_path / "whole.ply", whole.scene)
    assert (tmp_path / "scene.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
