"""Damaged stage configs for Habitat.

All 2,000 cases: `pytest -m slow tests/fuzz/test_stage_configs.py`.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from r3jax.simulators.habitat.habitat_stage import read_stage
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""

NAME = "a.stage_config.json"


def seeds() -> list[Files]:
    axes = {"up": [0, 0, 1], "front": [0.0, 1.0, 0.0]}
    more = {"scale": [1, 1, 1], "origin": [0, 0, 0], "units_to_meters": 1.0, "margin": 0.03}
    config = {"render_asset": "mesh.ply", **axes, **more}
    return [{NAME: json.dumps(config).encode(), "mesh.ply": b"ply\n"}]


def read(folder: Path) -> None:
    stage = read_stage(folder / NAME)
    assert stage.mesh.is_file()
    np.testing.assert_allclose(
        stage.habitat_from_file @ stage.habitat_from_file.T, np.eye(3), atol=1e-5
    )


READER = Reader(seeds, read, (ValueError,))


def test_damaged_stage_configs_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_stage_configs(harness):
    """`pytest -m slow tests/fuzz/test_stage_configs.py`."""
    harness.check(__name__, CASES_SLOW)
