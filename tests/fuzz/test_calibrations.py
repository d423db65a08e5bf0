"""Damaged calibrations of the forecast.

All 2,000 cases: `pytest -m slow tests/fuzz/test_calibrations.py`.
"""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from r3jax.apps.forecast.psnr import STATISTICS, read_calibration
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    return [{"calibration.json": (files("r3jax.apps.forecast") / "calibration.json").read_bytes()}]


def read(folder: Path) -> None:
    calibration = read_calibration(folder / "calibration.json")
    mixture = calibration.model.mixture(np.array([0.0, 1.0]), np.array([0.0, 0.5]))
    assert mixture.shape == (2, len(calibration.model.residuals))
    for name in STATISTICS:
        assert calibration.half_width(name, 0.8) == calibration.half_width(name, 0.8)


READER = Reader(seeds, read, (ValueError, FileNotFoundError))


def test_damaged_calibrations_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_calibrations(harness):
    """`pytest -m slow tests/fuzz/test_calibrations.py`."""
    harness.check(__name__, CASES_SLOW)
