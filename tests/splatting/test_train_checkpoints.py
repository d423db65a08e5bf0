"""A training that was interrupted goes on as if it had not been."""

import json
import shutil
import signal

import jax
import numpy as np
import pytest

from r3jax.splatting.errors import CheckpointError
from r3jax.splatting.train import fit
from tests.splatting.test_train import ROOMY, config, views  # noqa: F401


def interrupt_at(step: int):
    def on_progress(progress):
        if progress.step >= step:
            signal.raise_signal(signal.SIGINT)

    return on_progress


@pytest.fixture(scope="module")
def interrupted(views, tmp_path_factory):  # noqa: F811
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
def test_resumed_equals_uninterrupted_bit_for_bit(views, tmp_path, strategy):  # noqa: F811
    settings = config(strategy=strategy, background="random")
    whole = fit(views, settings)
    first = fit(views, settings, folder=tmp_path, on_progress=interrupt_at(17))
    second = fit(views, settings, folder=tmp_path, resume=True)
    assert second.history.first_step == len(first.history.loss) + 1 < 40
    jax.tree.map(np.testing.assert_array_equal, second.scene, whole.scene)
    losses = np.concatenate([first.history.loss, second.history.loss])
    np.testing.assert_array_equal(losses, whole.history.loss)
    assert second.dropped == whole.dropped


def test_the_newest_two_are_kept_and_an_end_is_always_saved(views, interrupted, folder):  # noqa: F811
    names = lambda: sorted(p.name for p in folder.iterdir() if p.is_dir())
    assert names() == ["0000012", "0000020"]
    result = fit(views, config(), folder=folder, resume=True, checkpoint_every=12)
    assert not result.interrupted
    assert names() == ["0000036", "0000040"]
    again = fit(views, config(), folder=folder, resume=True)
    assert len(again.history.loss) == 0
    jax.tree.map(np.testing.assert_array_equal, again.scene, result.scene)


def test_another_budget_may_resume_but_other_settings_are_named(views, folder):  # noqa: F811
    changed = config(rate_sh=1e-3, iterations=50)
    with pytest.raises(CheckpointError, match=r"iterations \(stored 40, now 50\), rate_sh"):
        fit(views, changed, folder=folder, resume=True)
    other = views.take(np.arange(7))
    with pytest.raises(CheckpointError, match=r"views \(stored 8, now 7\)"):
        fit(other, config(), folder=folder, resume=True)
    fit(views, config(raster=type(ROOMY)(backend="numba")), folder=folder, resume=True)


def test_a_new_training_does_not_bury_an_old_one(views, folder):  # noqa: F811
    with pytest.raises(CheckpointError, match="resume it, overwrite it, or choose another folder"):
        fit(views, config(), folder=folder)


def test_nothing_to_resume_from(views, tmp_path):  # noqa: F811
    with pytest.raises(CheckpointError, match="no checkpoint to resume from"):
        fit(views, config(), folder=tmp_path, resume=True)


def test_what_cannot_be_read_is_named(views, folder):  # noqa: F811
    newest = folder / "0000020"
    for path in newest.rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(CheckpointError, match="0000020: cannot be read"):
        fit(views, config(), folder=folder, resume=True)
    shutil.rmtree(newest)
    assert not fit(views, config(), folder=folder, resume=True).interrupted


@pytest.mark.parametrize("text", ["", "[]", '{"format":'])
def test_settings_that_cannot_be_read_are_named(views, folder, text):  # noqa: F811
    (folder / "training.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"training\.json: cannot be read"):
        fit(views, config(), folder=folder, resume=True)


def test_settings_are_stored_as_plain_numbers(folder):
    stored = json.loads((folder / "training.json").read_text())
    assert stored["iterations"] == 40
    assert stored["raster.backend"] == "numba"
    assert "raster.max_intersections" not in stored
