"""Checkpoints of an exploration: damaged files of Orbax, read without knowing their shapes.

All 2,000 cases: `pytest -m slow tests/fuzz/test_run_checkpoints.py`.
"""

import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest

from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.state import empty_map
from r3jax.runs.header import RunError
from r3jax.runs.stored_states import CheckpointWriter, load_checkpoint, map_tables, read_checkpoint
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files, pick_up, unsealed
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 50
"""In the normal suite: each takes 50 ms."""


def seeds() -> list[Files]:
    grid = empty_grid(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    with tempfile.TemporaryDirectory() as name:
        writer = CheckpointWriter(Path(name))
        writer.save(3, map_tables(empty_map(64), grid))
        writer.close()
        return [unsealed(pick_up(Path(name)))]


def read(folder: Path) -> None:
    tables = load_checkpoint(folder, 3)
    assert all(isinstance(x, np.ndarray) for table in tables.values() for x in table.values())
    step, map_state, grid = read_checkpoint(folder)
    assert step == 3
    for leaf in jax.tree.leaves((map_state, grid)):
        assert not np.isnan(leaf).any()


READER = Reader(seeds, read, (RunError,))


def test_damaged_checkpoints_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_checkpoints(harness):
    """`pytest -m slow tests/fuzz/test_run_checkpoints.py`."""
    harness.check(__name__, CASES_SLOW)
