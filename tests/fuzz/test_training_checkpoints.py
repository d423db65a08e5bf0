"""Checkpoints of a training: damaged settings, and damaged files of Orbax.

All 2,000 cases: `pytest -m slow tests/fuzz/test_training_checkpoints.py`.
"""

import functools
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry.cameras import Camera
from r3jax.splatting.errors import CheckpointError
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.checkpoints import (
    begin_checkpoints,
    read_checkpoint,
    save_checkpoint,
    settings_record,
)
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train_step import TrainState, start_state
from r3jax.splatting.views import Views
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files, pick_up, unsealed
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 50
"""In the normal suite: each takes 50 ms."""


@functools.cache
def state() -> TrainState:
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape).astype(np.float32))
    return start_state(GaussianScene(draw(6, 3), draw(6, 4), draw(6, 3), draw(6), draw(6, 4, 3)))


@functools.cache
def settings() -> dict[str, Any]:
    views = Views(
        rgb=jnp.zeros((2, 4, 6, 3), jnp.uint8),
        depth=jnp.ones((2, 4, 6), jnp.float32),
        T_world_camera=jnp.asarray(np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))),
        cameras=jax.tree.map(lambda x: jnp.stack([x, x]), Camera(6, 4, 8.0, 8.0, 3.0, 2.0)),
    )
    return settings_record(TrainConfig(), views, 1.5)


def seeds() -> list[Files]:
    with tempfile.TemporaryDirectory() as name:
        begin_checkpoints(Path(name), settings())
        save_checkpoint(Path(name), state())
        return [unsealed(pick_up(Path(name)))]


def read(folder: Path) -> None:
    restored = read_checkpoint(folder, settings(), state())
    for leaf, wanted in zip(jax.tree.leaves(restored), jax.tree.leaves(state()), strict=True):
        assert leaf.shape == wanted.shape
        assert leaf.dtype == wanted.dtype
        assert np.isfinite(leaf).all()


READER = Reader(seeds, read, (CheckpointError,))


def test_damaged_checkpoints_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_checkpoints(harness):
    """`pytest -m slow tests/fuzz/test_training_checkpoints.py`."""
    harness.check(__name__, CASES_SLOW)
