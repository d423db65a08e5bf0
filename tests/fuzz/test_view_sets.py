"""Damaged sets of test views.

Most damage is found by the hash, so the hash of some damaged sets is made right again.

All 2,000 cases: `pytest -m slow tests/fuzz/test_view_sets.py`.
"""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest

from r3jax.evaluation import test_views
from r3jax.evaluation.test_views import ViewSet, read_view_set
from r3jax.geometry.cameras import rigid_error
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.mutate import mutate
from tests.fuzz.tree import Files, pick_up
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    positions = np.array([[0.5, 0.25, 1.0], [1.5, 0.25, 1.0], [1.5, 1.25, 1.0001]])
    view_set = ViewSet("toy", "ab" * 32, (1.0, 1.0, 0.75), 0.3, 12, positions, ("+x", "-y", "-z"))
    with tempfile.TemporaryDirectory() as name:
        test_views._write(Path(name) / "set.json", view_set)
        return [pick_up(Path(name))]


def make(rng: np.random.Generator, files: Files) -> tuple[Files, str]:
    changed, what = mutate(rng, files)
    data = changed.get("set.json")
    if rng.random() < 0.5 and isinstance(data, bytes):
        changed["set.json"] = with_its_hash(data)
    return changed, what


def with_its_hash(data: bytes) -> bytes:
    """The set with the hash of its own content, if it has one."""
    try:
        record = json.loads(data)
        with np.errstate(all="ignore"):
            record["hash"] = test_views._from_record(record).hash
        return json.dumps(record).encode()
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError, AttributeError):
        return data


def read(folder: Path) -> None:
    view_set = read_view_set(folder / "set.json")
    assert len(view_set) == len(view_set.positions) > 0
    assert np.isfinite([*view_set.spacing, view_set.margin]).all()
    assert view_set.max_views is None or view_set.max_views > 0
    for pose in view_set.poses:
        assert rigid_error(pose) is None


READER = Reader(seeds, read, (ValueError, FileNotFoundError), make=make)


def test_damaged_view_sets_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_view_sets(harness):
    """`pytest -m slow tests/fuzz/test_view_sets.py`."""
    harness.check(__name__, CASES_SLOW)
